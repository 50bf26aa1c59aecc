"""Reading flight logs into records, including logs that were cut off."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final

import msgspec
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk

from dart_flight.base.records import Record, World
from dart_flight.config.document import InputError, open_file
from dart_flight.config.file_kinds import FileKind, refuse_other_kind
from dart_flight.recording.encoding import decode
from dart_flight.recording.schema import RECORD_TYPES
from dart_flight.recording.writer import ABOUT, END, FORMAT_VERSION, part_path

if TYPE_CHECKING:
    from dart_flight.recording.topics import Topic, Topics

IN_MEMORY: Final = "<memory>"  # the source of a log that has no file
# The writer's chunks have at most one megabyte. Without a limit, a damaged length could allocate gigabytes.
MAX_BYTES = 64 * 1024 * 1024
MAGIC = b"\x89MCAP0\r\n"
# Exceptions that the libraries raise for damaged bytes.
_DAMAGES = (McapError, zstandard.ZstdError, struct.error, msgspec.MsgspecError, ValueError, OverflowError)
DECODERS = {kind.topic: msgspec.json.Decoder(kind) for kind in RECORD_TYPES}


class MissingDataError(InputError):
    """The flight log lacks the required data: the flight ended early, or the log was cut near its start.

    If several logs are given, a log without the data is skipped, and a message reports this.
    """


class DamagedLogError(Exception):
    """A damaged log; the records before the damage are valid."""


class LogEntry(msgspec.Struct, frozen=True, gc=False):
    """One record of a log, with the number of the input, or of the input that caused the record."""

    number: int
    record: Record


class Log(msgspec.Struct, dict=True):
    """A complete log in memory; `log["/estimate/force"]` returns a channel as arrays (`recording.topics`).

    Attributes:
        source: the file, or `IN_MEMORY`.
        about: description of the flight (`recording.about`).
        end: data that is known only at the flight's end, such as `lost`, the number of unwritten records.
        entries: records in the order written.
        complete: whether all parts of the log exist and the last part has its closing description.
    """

    source: str
    about: dict[str, str]
    end: dict[str, str]
    entries: list[LogEntry]
    complete: bool

    @property
    def seed(self) -> int | None:
        """Seed of a simulated flight."""
        text = self.about.get("seed", "")
        return int(text) if text.isdigit() else None

    @property
    def world(self) -> World | None:
        """World of the flight, or None if the log was cut before the description of the flight."""
        name = self.about.get("world", "")
        return World(name) if name in set(World) else None

    @cached_property
    def arrays(self) -> Topics:
        """The records as arrays, by channel; built once."""
        from dart_flight.recording.topics import Topics  # noqa: PLC0415  logging needs no NumPy

        return Topics(entry.record for entry in self.entries)

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of the channels that have records."""
        return self.arrays.names

    def __getitem__(self, topic: str) -> Topic:
        """Return the records of a channel as arrays; without records, the arrays have length 0.

        Raises:
            KeyError: there is no such channel; the message suggests the nearest name.
        """
        return self.arrays[topic]

    def __contains__(self, topic: object) -> bool:
        return topic in self.topics

    def __iter__(self) -> Iterator[str]:
        return iter(self.topics)


def read_log(path: str | Path) -> Log:
    """Read a flight log with all its parts; if the log was cut off, read up to the cut.

    Raises:
        InputError: the file is not a flight log, or was written by a newer version.
    """
    log = Log(str(path), {}, {}, [], complete=True)
    part = 1
    while log.complete:
        here = part_path(Path(path), part)
        if part > 1 and not here.exists():
            log.complete = False
            break
        log.end = {}
        _read_part(here, log)
        if log.end.get("continued") != "yes":
            break
        part += 1
    return log


def _read_part(path: Path, log: Log) -> None:
    source = str(path)
    found = dict[str, str]()
    try:
        with open_file(path) as stream:
            start = stream.read(len(MAGIC))
            if not MAGIC.startswith(start):
                refuse_other_kind(path, FileKind.FLIGHT_LOG)
                raise InputError("not a flight log: the file has no MCAP header", source=source)
            stream.seek(0)
            for entry in read_entries(stream, found, log.end, {}, source):
                log.entries.append(entry)
    except OSError as error:
        raise InputError(f"cannot read: {error.strerror or error}", source=source) from None
    except (EndOfFile, DamagedLogError):
        log.complete = False
    log.about.update(found)
    if not found and log.complete:
        raise InputError("this MCAP file is not a flight log of dart-flight", source=source)


def read_entries(
    stream: IO[bytes],
    about: dict[str, str],
    end: dict[str, str],
    topics: dict[int, str],
    source: str,
    begun: bool = False,
) -> Iterator[LogEntry]:
    """Yield the records of one part of a log, and store the other contents in the dictionaries.

    Args:
        about, end: receive the descriptions from the start and from the end of the flight.
        topics: receives the channels by number.
        begun: whether the stream continues a part that was read before, and therefore has no file header.

    Raises:
        InputError: the log was written by a newer version.
        EndOfFile: the log is cut off here, or still grows.
        DamagedLogError: the log is damaged here.
    """
    with _convert_damage():
        yield from _read_entries(stream, about, end, topics, source, begun)


@contextlib.contextmanager
def _convert_damage() -> Iterator[None]:
    try:
        yield
    except (EndOfFile, InputError):
        raise
    except _DAMAGES as error:
        raise DamagedLogError(str(error)) from error


def _read_entries(
    stream: IO[bytes],
    about: dict[str, str],
    end: dict[str, str],
    topics: dict[int, str],
    source: str,
    begun: bool,
) -> Iterator[LogEntry]:
    limited: Any = _LimitedStream(stream)
    reader = StreamReader(limited, skip_magic=begun, emit_chunks=True, record_size_limit=MAX_BYTES)
    for record in reader.records:
        if isinstance(record, Metadata) and record.name == ABOUT:
            _check_version(record.metadata, source)
            about.update(record.metadata)
        elif isinstance(record, Metadata) and record.name == END:
            end.update(record.metadata)
        elif isinstance(record, Chunk) and about:
            size = max(record.uncompressed_size, _claimed_bytes(record))
            if size > MAX_BYTES:
                raise ValueError(f"a chunk of {size} bytes")
            yield from _entries_in(record, topics)


class _LimitedStream:
    """A stream that refuses a damaged length inside a record, which would allocate gigabytes."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream

    def read(self, size: int = -1) -> bytes:
        """Return up to `size` bytes.

        Raises:
            ValueError: the size is larger than any content of a log.
        """
        if size > MAX_BYTES:
            raise ValueError(f"a length of {size} bytes")
        return self._stream.read(size)


def _claimed_bytes(chunk: Chunk) -> int:
    """Return the size that a chunk's compressed data claim, which the library would allocate."""
    return zstandard.frame_content_size(chunk.data) if chunk.compression == "zstd" else 0


def _entries_in(chunk: Chunk, topics: dict[int, str]) -> Iterator[LogEntry]:
    for inner in breakup_chunk(chunk, validate_crc=True):
        if isinstance(inner, Channel):
            topics[inner.id] = inner.topic
        elif isinstance(inner, Message) and topics.get(inner.channel_id) in DECODERS:
            yield LogEntry(inner.sequence, decode(inner.data, DECODERS[topics[inner.channel_id]]))


def _check_version(about: dict[str, str], source: str) -> None:
    version = about.get("format_version", "")
    if not version.isdigit():
        raise InputError(f"log format {version!r} is not a number", source=source)
    if int(version) > FORMAT_VERSION:
        raise InputError(
            f"dart-flight {about.get('software', '?')} wrote this log in format {version}, but this program "
            f"reads only formats up to {FORMAT_VERSION}: update dart-flight",
            source=source,
        )
