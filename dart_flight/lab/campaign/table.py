"""The table of a campaign: a CSV file that survives Ctrl-C, SIGKILL, power loss and a full disk.

Every row is written with one call and flushed to the disk about once a second. A full disk or a power loss
may leave an incomplete last row. A resumed campaign removes this row and repeats its flight.
"""

from __future__ import annotations

import csv
import io
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType

from dart_flight.base.errors import FlightError
from dart_flight.config.document import InputError, open_file, write_problem
from dart_flight.config.held_files import lock_file
from dart_flight.lab.campaign.campaign_spec import Item, Point
from dart_flight.lab.campaign.flight_job import line_of

_SYNC_S = 1.0


class Table:
    """The table of a campaign; only this process may append rows.

    A missing file is created with its header. A file of another campaign and a file system without locks are
    rejected.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self.path = path
        header = line_of(columns)
        self._synced_s = time.monotonic()
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise FlightError(f"cannot write {path}: {write_problem(path, error)}") from None
        try:
            self._lock()
            self._length = _complete_length(path)
            os.ftruncate(self._file, self._length)
            if not self._length:
                self.append(header)
            elif path.read_bytes()[: len(header)] != header:
                raise InputError(
                    "the columns of this table differ from those of the campaign", source=str(path), line=1
                )
        except BaseException:
            os.close(self._file)
            raise

    def _lock(self) -> None:
        if not lock_file(self._file, self.path, "set --out to a local disk"):
            raise FlightError(f"{self.path} is being written by another campaign")

    def __enter__(self) -> Table:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._file)

    def append(self, line: bytes) -> None:
        """Append a row; if the disk rejects it, remove the part written and raise a FlightError."""
        try:
            written = os.write(self._file, line)
            if written < len(line):
                # If the disk accepted only a part, the write of the rest raises an error with the reason.
                os.write(self._file, line[written:])
        except OSError as error:
            os.ftruncate(self._file, self._length)
            raise FlightError(
                f"cannot write {self.path}: {error.strerror}; completed rows are kept; continue with --resume"
            ) from None
        self._length += len(line)
        now = time.monotonic()
        if now - self._synced_s >= _SYNC_S:
            self._synced_s = now
            self.sync()

    def sync(self) -> None:
        os.fsync(self._file)


def _complete_length(path: Path) -> int:
    """Return the length of the file in bytes, without an incomplete last line."""
    data = path.read_bytes()
    # After a power loss, data that was not flushed may read as zeros.
    zeros = data.find(b"\0")
    return data.rfind(b"\n", 0, zeros if zeros >= 0 else None) + 1


def rows_in(path: Path) -> Iterator[dict[str, str]]:
    try:
        with io.TextIOWrapper(open_file(path), encoding="utf-8", newline="") as file:
            reader = csv.reader(file)
            columns = next(reader, [])
            for cells in reader:
                if len(cells) != len(columns):
                    raise InputError(
                        f"this line has {len(cells)} cells, the header has {len(columns)}",
                        source=str(path),
                        line=reader.line_num,
                    )
                yield dict(zip(columns, cells, strict=True))
    except OSError as error:
        raise InputError(f"cannot read: {error.strerror}", source=str(path)) from None
    except UnicodeDecodeError:
        raise InputError("not UTF-8 text", source=str(path)) from None


def flown_in(path: Path, keys: Sequence[str], points: Sequence[Point]) -> set[Item]:
    """Return the flights that have a row; reject duplicates and rows of other campaigns' flights."""
    numbers = {(point.path, *point.values): point.number for point in points}
    found: set[Item] = set()
    for line, row in enumerate(rows_in(path), start=2):
        number = numbers.get((row["mission"], *(row[key] for key in keys)))
        if number is None or not row["seed"].isdigit():
            raise InputError("this row belongs to no flight of this campaign", source=str(path), line=line)
        item = Item(number, int(row["seed"]))
        if item in found:
            raise InputError("duplicate row for this flight", source=str(path), line=line)
        found.add(item)
    return found
