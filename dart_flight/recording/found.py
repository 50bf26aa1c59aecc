"""The search for flight logs in files and folders; the functions raise InputError if there are none."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from dart_flight.config.document import InputError
from dart_flight.recording.reader import MissingDataError

LOG_NAME = "flight.mcap"
PX4_LOG = "px4.ulg"  # PX4's own log, in the same folder as the flight's log, if PX4 flew
T = TypeVar("T")


def find_logs(paths: Iterable[str | Path]) -> list[Path]:
    """Return each named file as it is, and the flight logs below each folder, sorted by name."""
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
    """Return the PX4 logs next to a flight log or below a folder; any other file is returned unchanged."""
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
    """Return the result of `read` for every log that has the required data.

    `read` raises `MissingDataError` for a log without the data, and `left_out` receives one line about this
    log. If no log has the data, the error of the first log is raised.
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
