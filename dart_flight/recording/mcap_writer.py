"""The MCAP library's writer, with fewer calls for each message.

The library makes about twenty calls in Python of every message. In flight there are 1300 messages a second,
and that was a fifth of what the app adds to MAVSDK (docs/latency.md). What is written is the library's, byte
by byte (tests/recording/test_mcap_writer.py); with a version that is built otherwise its own way is taken.
"""

from __future__ import annotations

import struct
from itertools import chain
from typing import IO, Any

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import MessageIndex
from mcap.writer import CompressionType, Writer

_HEAD = struct.Struct("<BQHIQQ")  # of a message: what it is, its length, channel, number, two times
_HEAD_BYTES = 22  # of them counted in the length
_INDEX_HEAD = struct.Struct("<BQHI")


class _Index(MessageIndex):
    """Where a chunk's messages are, packed at once."""

    def write(self, stream: RecordBuilder) -> None:
        size = 16 * len(self.records)
        pairs = struct.pack(f"<{2 * len(self.records)}Q", *chain.from_iterable(self.records))
        stream.write(_INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + size, self.channel_id, size) + pairs)


class McapWriter(Writer):
    """Writes MCAP to a file, in compressed chunks.

    Args:
        file: open for writing bytes.
    """

    def __init__(self, file: IO[bytes]) -> None:
        super().__init__(file, compression=CompressionType.ZSTD)
        # The library has no other door to them.
        self._chunk: Any = getattr(self, "_Writer__chunk_builder", None)
        self._statistics: Any = getattr(self, "_Writer__statistics", None)
        chunk_bytes = getattr(self, "_Writer__chunk_size", None)
        self._known = None not in (self._chunk, self._statistics, chunk_bytes)
        self._chunk_bytes: int = chunk_bytes or 0

    def add_message(
        self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int = 0
    ) -> None:
        """As the library's."""
        if not self._known:
            super().add_message(channel_id, log_time, data, publish_time, sequence)
            return
        chunk, whole = self._chunk, self._statistics
        if not chunk.num_messages or log_time < chunk.message_start_time:
            chunk.message_start_time = log_time
        chunk.message_end_time = max(chunk.message_end_time, log_time)
        if not whole.message_count or log_time < whole.message_start_time:
            whole.message_start_time = log_time
        whole.message_end_time = max(whole.message_end_time, log_time)
        chunk.num_messages += 1
        whole.message_count += 1
        whole.channel_message_counts[channel_id] += 1
        records = chunk.record_writer
        offset = records.count
        index = chunk.message_indices.get(channel_id)
        if index is None:
            index = chunk.message_indices[channel_id] = _Index(channel_id, [])
        index.records.append((log_time, offset))
        size = _HEAD_BYTES + len(data)
        message = _HEAD.pack(Opcode.MESSAGE, size, channel_id, sequence, log_time, publish_time) + data
        records.write(message)
        if offset + len(message) > self._chunk_bytes:
            self.flush()  # type: ignore[no-untyped-call]
