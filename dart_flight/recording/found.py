"""Flight logs that a person names: files, or folders of flights."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from dart_flight.config.document import InputError
from dart_flight.recording.reader import NothingInItError

LOG_NAME = "flight.mcap"
PX4_LOG = "px4.ulg"  # beside it, where PX4 flew: its own log
T = TypeVar("T")


def logs_in(paths: Iterable[str | Path]) -> list[Path]:
    """Every file as it is; of every folder the flight logs below it, by name.

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


def from_each(paths: Iterable[Path], read: Callable[[Path], T], left_out: Callable[[str], None]) -> list[T]:
    """What `read` makes of every log; of several those without what is wanted are left out.

    Args:
        paths: the logs.
        read: raises `NothingInItError` for a log of a flight that ended before what is wanted.
        left_out: takes a line for each that is left out.

    Raises:
        InputError: as `read`; `NothingInItError` where nothing remains.
    """
    results: list[T] = []
    empty: list[NothingInItError] = []
    for path in paths:
        try:
            results.append(read(path))
        except NothingInItError as error:
            empty.append(error)
    if empty and not results:
        raise empty[0]
    for one in empty:
        left_out(f"left out: {one.one_line()}")
    return results
