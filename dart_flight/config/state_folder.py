"""The folder for an account's data that must outlive a process.

`$DART_FLIGHT_STATE_DIR` names the folder; the default is in the XDG state folder.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

from dart_flight.config.document import InputError, write_problem

REMEDY = "set DART_FLIGHT_STATE_DIR to a local disk"


def state_dir() -> Path:
    """Return `$DART_FLIGHT_STATE_DIR`, `$XDG_STATE_HOME/dart-flight` or `~/.local/state/dart-flight`.

    Raises: InputError: neither variable is set, and this account has no home folder.
    """
    named = os.environ.get("DART_FLIGHT_STATE_DIR")
    if named:
        return Path(named)
    xdg = os.environ.get("XDG_STATE_HOME")
    try:
        return (Path(xdg) if xdg else Path.home() / ".local" / "state") / "dart-flight"
    except RuntimeError:
        raise InputError(
            "this account has no home folder for the program's state: set DART_FLIGHT_STATE_DIR "
            "to a folder that you can write to"
        ) from None


def ensure_folder(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot("use the state folder", folder, error, "set DART_FLIGHT_STATE_DIR") from None
    return folder


def cannot(do: str, path: Path, error: OSError, remedy: str = REMEDY) -> InputError:
    """Return the error for a file that cannot be used.

    Args:
        do: the failed action, such as `write`.
        remedy: advice for the operator if the file's permissions are not the reason.
    """
    advice = "" if error.errno in (errno.EACCES, errno.EPERM) else f"; {remedy}"
    return InputError(f"cannot {do}: {write_problem(path, error)}{advice}", source=str(path))
