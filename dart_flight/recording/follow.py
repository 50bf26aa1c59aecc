"""Reading a flight log while it is being written."""

from __future__ import annotations

import contextlib
import io
import struct
from pathlib import Path

from mcap.exceptions import EndOfFile

from dart_flight.config.document import InputError
from dart_flight.recording.reader import MAGIC, MAX_BYTES, DamagedLogError, LogEntry, read_entries
from dart_flight.recording.writer import part_path

_HEAD = struct.Struct("<BQ")  # the head of an MCAP record: its kind and its length
_READ_BYTES = 8 * 1024 * 1024  # maximum number of bytes in one read


class LogFollower:
    """Reader of a growing log's new records, beginning with the first part; it does not write to the file.

    Attributes:
        about: description of the flight; empty until it has been read.
        ended: whether the writer has finished the log.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.about: dict[str, str] = {}
        self.ended = False
        self._part = 0
        self._next_part()

    def _next_part(self) -> None:
        self._part += 1
        self._offset = len(MAGIC)
        self._topics: dict[int, str] = {}
        self._continued = False

    def read(self) -> list[LogEntry]:
        """Return the records that were added since the last call, in the order written.

        A file that cannot be read, is damaged, or was written by a newer version raises InputError.
        """
        try:
            return self._read()
        except (OSError, DamagedLogError) as error:
            raise InputError(f"cannot follow this log: {error}", source=str(self._path)) from None

    def _read(self) -> list[LogEntry]:
        added, end, entries = io.BytesIO(self._whole_records()), dict[str, str](), list[LogEntry]()
        with contextlib.suppress(EndOfFile):
            for entry in read_entries(added, self.about, end, self._topics, str(self._path), begun=True):
                entries.append(entry)
        if end:
            self._continued = end.get("continued") == "yes"
            self.ended = not self._continued
        return entries

    def _whole_records(self) -> bytes:
        """Return the complete records after the bytes that the previous call returned."""
        if self._continued and part_path(self._path, self._part + 1).exists():
            self._next_part()
        with open(part_path(self._path, self._part), "rb") as file:
            file.seek(self._offset)
            data = file.read(_READ_BYTES)
        end = 0
        while len(data) - end >= _HEAD.size:
            _, length = _HEAD.unpack_from(data, end)
            if length > MAX_BYTES:
                raise DamagedLogError(f"a record of {length} bytes")
            if end + _HEAD.size + length > len(data):
                break
            end += _HEAD.size + length
        self._offset += end
        return data[:end]
