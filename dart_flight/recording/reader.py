"""Reads a flight log back into records, also one that was cut off."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
from mcap.records import Channel, Chunk, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk

from dart_flight.config.document import InputError
from dart_flight.recording.writer import FORMAT_VERSION, RECORD_TYPES
from dart_flight.samples import Record

_BY_TOPIC = {kind.topic: kind for kind in RECORD_TYPES}


class LogEntry(msgspec.Struct, frozen=True):
    """One record of a log and the number of the input it is or follows from."""

    number: int
    record: Record


class Log(msgspec.Struct):
    """A log read whole.

    Attributes:
        about: what describes the flight (mission, configuration, world, seed, software).
        entries: records in the order written.
        complete: False where the file was cut off.
    """

    about: dict[str, str]
    entries: list[LogEntry]
    complete: bool


def read_log(path: str | Path) -> Log:
    """Read a flight log, up to where it was cut.

    Raises:
        InputError: not a flight log, or written by a newer version.
    """
    log = Log({}, [], False)
    source = str(path)
    try:
        with open(path, "rb") as stream:
            if not stream.read(8).startswith(b"\x89MCAP0\r\n"):
                raise InputError("not a flight log (no MCAP file)", source=source)
            stream.seek(0)
            for entry in _entries(StreamReader(stream, emit_chunks=True), log, source):
                log.entries.append(entry)
        log.complete = True
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"cannot read: {error.strerror or error}", source=source) from None
    except Exception:
        # Cut off or damaged here, for which the library raises many kinds of errors; the rest is good.
        log.complete = False
    if not log.about and log.complete:
        raise InputError("not a flight log of dart-flight", source=source)
    return log


def _entries(reader: StreamReader, log: Log, source: str) -> Iterator[LogEntry]:
    topics: dict[int, str] = {}
    decoders = {kind.topic: msgspec.json.Decoder(kind) for kind in RECORD_TYPES}
    for record in reader.records:
        if isinstance(record, Metadata) and record.name == "dart_flight":
            log.about.update(record.metadata)
            version = record.metadata.get("format_version", "0")
            if not version.isdigit() or int(version) > FORMAT_VERSION:
                raise InputError(
                    f"log format {version} is newer than this program knows ({FORMAT_VERSION}); "
                    "update dart-flight",
                    source=source,
                )
        if not isinstance(record, Chunk):
            continue
        for inner in breakup_chunk(record, validate_crc=True):
            if isinstance(inner, Channel):
                topics[inner.id] = inner.topic
            elif isinstance(inner, Message) and topics.get(inner.channel_id) in _BY_TOPIC:
                yield LogEntry(inner.sequence, decoders[topics[inner.channel_id]].decode(inner.data))


__all__ = ["Log", "LogEntry", "read_log"]
