"""Error message for a missing optional package, with the command that installs it."""

from __future__ import annotations

import importlib.util
import platform
import sys
from pathlib import Path
from typing import Final

from dart_flight.config.document import InputError, Key

_CHECKOUT: Final = Path(__file__).resolve().parents[2]
IN_FULL: Final = (
    "sim",
    "identify",
    "report",
    "live",
    "plan",
    "mocap",
    "studio",
)  # extras that `make install` installs


def missing_package(what: str, extra: str, *, source: str = "", key: Key = ()) -> InputError:
    """Return the error that names a missing package and the command that installs it.

    Call this function in the `except` block of the import error. If the package is installed but does not
    load, the message contains the import error.

    Args:
        what: the missing package and its use, such as "a picture needs matplotlib".
        extra: name of the extra in pyproject.toml that installs the package.
        source, key: the input that requires the package.
    """
    error = sys.exception()
    if isinstance(error, ImportError) and not isinstance(error, ModuleNotFoundError):
        return InputError(f"{what}, but it does not load: {error}", source=source, key=key)
    return InputError(f"{what}: {install_command(extra)}", source=source, key=key)


def install_command(extra: str, checkout: Path = _CHECKOUT) -> str:
    """Return the command that installs an extra from pyproject.toml with the versions in constraints.txt.

    `checkout` is the folder of the source code, which an installed wheel lacks.
    """
    if extra == "plan" and platform.machine() == "aarch64" and sys.version_info >= (3, 13):
        if importlib.util.find_spec("casadi") is not None:  # the rest of the extra is there
            return "it has no wheel for this processor with Python 3.13 and newer; use Python 3.12 or 3.11"
    is_checkout = (checkout / "Makefile").is_file() and (checkout / "constraints.txt").is_file()
    if is_checkout and extra in IN_FULL and Path(sys.prefix).resolve() == (checkout / ".venv").resolve():
        where = "" if checkout == Path.cwd().resolve() else f" -C {checkout}"
        return f"make{where} install"
    editable = "-e " if is_checkout else ""
    command = f"{sys.executable} -m pip install -c constraints.txt {editable}'.[{extra}]'"
    return f"{command} in {checkout if is_checkout else 'the checkout of dart-flight'}"
