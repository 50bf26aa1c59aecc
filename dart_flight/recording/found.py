"""Finding flight logs among files and folders named on the command line."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from dart_flight.config.document import InputError
from dart_flight.recording.reader import MissingDataError

LOG_NAME = "flight.mcap"
PX4_LOG = "px4.ulg"  # PX4's own log, in the same folder, if PX4 flew
T = TypeVar("T")


def find_logs(paths: Iterable[str | Path]) -> list[Path]:
    """Return each named file as it is, and the flight logs below each folder, sorted by name.

    Raises:
        InputError: there is no flight log below a folder.
    """
    found: list[Path] = []
    for path in map(Path, paths):
        if not path.is_dir():
            found.append(path)
            continue
        below = sorted(path.rglob(LOG_NAME))
        if not below:
            raise InputError(f"no flight log ({LOG_NAME}) below this folder", source=str(path))
        found += below
    return list(dict.fromkeys(found))


def px4_logs_in(paths: Iterable[str | Path]) -> list[Path]:
    """Return the PX4 logs that belong to the paths, in order.

    For a flight log, the PX4 logs next to this log are returned. For a folder, the PX4 logs below the folder
    are returned. Any other file is returned unchanged.

    Raises:
        InputError: there is no PX4 log next to a flight log or below a folder.
    """
    found: list[Path] = []
    for path in map(Path, paths):
        flight = path.name == LOG_NAME
        if not flight and not path.is_dir():
            found.append(path)
            continue
        below = sorted((path.parent if flight else path).rglob(PX4_LOG))
        if not below:
            raise InputError(
                f"no PX4 log ({PX4_LOG}) in this folder; download it with `dart-flight px4-log`",
                source=str(path),
            )
        found += below
    return list(dict.fromkeys(found))


def read_each(paths: Iterable[Path], read: Callable[[Path], T], left_out: Callable[[str], None]) -> list[T]:
    """Return the result of `read` for every log that has the wanted data.

    Args:
        paths: the logs.
        read: raises `MissingDataError` for a log that lacks the wanted data.
        left_out: receives one line for each omitted log.

    Raises:
        MissingDataError: there are logs, but no log has the wanted data.
        InputError: `read` raises this error for another reason.
    """
    results: list[T] = []
    empty: list[MissingDataError] = []
    for path in paths:
        try:
            results.append(read(path))
        except MissingDataError as error:
            empty.append(error)
    if empty and not results:
        raise empty[0]
    for one in empty:
        left_out(f"skipped: {one.one_line()}")
    return results
