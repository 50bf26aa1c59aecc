"""A flight log read while it is being written."""

from __future__ import annotations

import io
import struct
from pathlib import Path

from mcap.exceptions import EndOfFile
from mcap.records import Chunk, Metadata
from mcap.stream_reader import StreamReader

from dart_flight.recording.reader import MAGIC, MOST_BYTES, LogEntry, entries_in
from dart_flight.recording.writer import ABOUT, END, part_path

_HEAD = struct.Struct("<BQ")  # MCAP: kind and length of a record
_READ_BYTES = 8 * 1024 * 1024  # at once


class LogFollower:
    """Reads what has been added to a growing log; touches nothing but the file.

    Args:
        path: its first part.

    Attributes:
        about: what describes the flight, once that was read.
        ended: the writer has finished the log.
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
        """The records that have come since the last call, in the order written; empty where none have.

        Raises:
            OSError: the file cannot be read.
            ValueError: it is damaged.
        """
        data = self._whole_records()
        entries: list[LogEntry] = []
        if data:
            reader = StreamReader(
                io.BytesIO(data), skip_magic=True, emit_chunks=True, record_size_limit=MOST_BYTES
            )
            try:
                for record in reader.records:
                    self._take(record, entries)
            except EndOfFile:
                pass
        return entries

    def _take(self, record: object, entries: list[LogEntry]) -> None:
        if isinstance(record, Metadata) and record.name == ABOUT:
            self.about.update(record.metadata)
        elif isinstance(record, Metadata) and record.name == END:
            if record.metadata.get("continued") == "yes":
                self._continued = True
            else:
                self.ended = True
        elif isinstance(record, Chunk):
            entries += entries_in(record, self._topics)

    def _whole_records(self) -> bytes:
        """Bytes from where the last call ended to the end of the last whole record."""
        if self._continued and part_path(self._path, self._part + 1).exists():
            self._next_part()
        with open(part_path(self._path, self._part), "rb") as file:
            file.seek(self._offset)
            data = file.read(_READ_BYTES)
        end = 0
        while len(data) - end >= _HEAD.size:
            _, length = _HEAD.unpack_from(data, end)
            if length > MOST_BYTES:
                raise ValueError(f"a record of {length} bytes")
            if end + _HEAD.size + length > len(data):
                break
            end += _HEAD.size + length
        self._offset += end
        return data[:end]
