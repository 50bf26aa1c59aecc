"""What of an MCAP file a flight log's reader needs: metadata, and the records in chunks.

The library would make an object of every message, and of every entry of the indices that stand between the
chunks; that takes longer than to decode what is in them. So here are the few lines of the format in between.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from typing import Any, BinaryIO

import msgspec
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Metadata
from mcap.stream_reader import get_chunk_data_stream

from dart_flight.recording.encoding import decode
from dart_flight.recording.schema import RECORD_TYPES
from dart_flight.samples import Record

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")  # kind and length of a record
# The writer's chunks are of a megabyte: a damaged length must not make the reader ask for gigabytes.
MOST_BYTES = 64 * 1024 * 1024
_MESSAGE = struct.Struct("<HIQQ")  # channel, number, time logged, time published
DECODERS = {kind.topic: msgspec.json.Decoder(kind) for kind in RECORD_TYPES}


class LogEntry(msgspec.Struct, frozen=True, gc=False):
    """One record of a log and the number of the input it is or follows from."""

    number: int
    record: Record


def parts_of(stream: BinaryIO) -> Iterator[Metadata | Chunk | Footer]:
    """Metadata and chunks of a file from behind its magic number on, in order; last its footer if it has one.

    Raises:
        ValueError: it is cut off within a record, or damaged.
    """
    while head := stream.read(HEAD.size):
        if len(head) < HEAD.size:
            raise ValueError("the file ends here")
        kind, length = HEAD.unpack(head)
        if length > MOST_BYTES:
            raise ValueError(f"a record of {length} bytes")
        content = stream.read(length)
        if len(content) < length:
            raise ValueError("the file ends here")
        if kind == Opcode.METADATA:
            yield Metadata.read(_library_stream(content))
        elif kind == Opcode.CHUNK:
            yield Chunk.read(_library_stream(content))
        elif kind == Opcode.FOOTER:
            yield Footer.read(_library_stream(content))
            return


class ChunkReader:
    """The records in the chunks of one file, each read with the channels that those before it have named."""

    def __init__(self) -> None:
        self._decoders: dict[int, msgspec.json.Decoder[Any]] = {}

    def entries(self, chunk: Chunk) -> Iterator[LogEntry]:
        """The records of a chunk in the order written; its checksum must be right.

        Raises:
            ValueError: it is damaged.
        """
        if chunk.uncompressed_size > MOST_BYTES:
            raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes")
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        data, end = stream.read(size), 0
        while end < size:
            kind, length = HEAD.unpack_from(data, end)
            begin = end + HEAD.size
            end = begin + length
            if kind == Opcode.MESSAGE:
                channel, number, *_ = _MESSAGE.unpack_from(data, begin)
                decoder = self._decoders.get(channel)
                if decoder is not None:
                    yield LogEntry(number, decode(data[begin + _MESSAGE.size : end], decoder))
            elif kind == Opcode.CHANNEL:
                named = Channel.read(_library_stream(data[begin:end]))
                if named.topic in DECODERS:
                    self._decoders[named.id] = DECODERS[named.topic]


def _library_stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(content))
