"""A flight log read while it is being written."""

from __future__ import annotations

import io
from pathlib import Path

from mcap.records import Chunk, Metadata

from dart_flight.recording.mcap_records import HEAD, MAGIC, MOST_BYTES, ChunkReader, LogEntry, parts_of
from dart_flight.recording.writer import ABOUT, END, part_path

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
        self._chunks = ChunkReader()
        self._continued = False

    def read(self) -> list[LogEntry]:
        """The records that have come since the last call, in the order written; empty where none have.

        Raises:
            OSError: the file cannot be read.
            ValueError: it is damaged.
        """
        entries: list[LogEntry] = []
        for part in parts_of(io.BytesIO(self._whole_records())):
            if isinstance(part, Chunk):
                entries += self._chunks.entries(part)
            elif isinstance(part, Metadata):
                self._take(part)
        return entries

    def _take(self, metadata: Metadata) -> None:
        if metadata.name == ABOUT:
            self.about.update(metadata.metadata)
        elif metadata.name == END:
            if metadata.metadata.get("continued") == "yes":
                self._continued = True
            else:
                self.ended = True

    def _whole_records(self) -> bytes:
        """Bytes from where the last call ended to the end of the last whole record."""
        if self._continued and part_path(self._path, self._part + 1).exists():
            self._next_part()
        with open(part_path(self._path, self._part), "rb") as file:
            file.seek(self._offset)
            data = file.read(_READ_BYTES)
        end = 0
        while len(data) - end >= HEAD.size:
            _, length = HEAD.unpack_from(data, end)
            if length > MOST_BYTES:
                raise ValueError(f"a record of {length} bytes")
            if end + HEAD.size + length > len(data):
                break
            end += HEAD.size + length
        self._offset += end
        return data[:end]
