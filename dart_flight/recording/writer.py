"""The flight log: MCAP with JSON messages and their JSON Schemas, which Foxglove opens directly.

Each record type has a channel (`topic` in `base.records`). The inputs of the core are numbered. If a message
contains an input, its sequence number is this input's number. Any other message has the number of the input
that caused the record. A replay feeds the inputs in the order of their numbers. Log times are on the
autopilot's clock. `ClockOffset` relates this clock to the host's monotonic clock, and the description of the
flight relates the monotonic clock to the calendar.

A separate thread encodes and writes the records in small chunks, so a killed process loses at most the last
0.2 s of records. Once a second the thread syncs the chunks to the disk, because a crash of the vehicle may
disconnect the battery. A file that reaches `part_bytes` is finished, and the next file (`flight.part2.mcap`,
...) begins. After `most_parts` files, only decisions are recorded and telemetry is discarded.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections import deque
from pathlib import Path

import msgspec
from mcap.writer import CompressionType, Writer

from dart_flight import __version__
from dart_flight.base.records import Record
from dart_flight.recording.encoding import encode
from dart_flight.recording.schema import RECORD_TYPES, schema

FORMAT_VERSION = 1
PROFILE = "dart-flight"
ABOUT, END = "dart_flight", "dart_flight_end"  # names of the metadata records at the log's start and end
PART_BYTES = 64 * 1024 * 1024  # about ten minutes of a flight (docs/log.md)
MAX_PARTS = 16
BYTES_PER_S = 150_000  # per second of flight, rounded up from a measured 8.7 MB per minute (docs/log.md)

_FLUSH_S = 0.15  # period of flushes; each flush ends a chunk, and a killed process loses one period's records
_SYNC_S = 1.0
_MAX_WAITING = 200_000  # maximum number of queued records; two minutes of flight without the disk


class LogPart:
    """One MCAP file of a log; every file contains the description of the flight and the list of channels."""

    def __init__(self, path: Path, about: dict[str, str], number: int) -> None:
        self._file = open(path, "xb")  # noqa: SIM115
        self._writer = Writer(self._file, compression=CompressionType.ZSTD)
        self._writer.start(profile=PROFILE, library=f"dart-flight {__version__}")
        self._writer.add_metadata(
            ABOUT, {**about, "format_version": str(FORMAT_VERSION), "part": str(number)}
        )
        self._channels = {kind: self._register(kind) for kind in RECORD_TYPES}
        self._file.flush()

    def _register(self, kind: type[Record]) -> int:
        text = msgspec.json.encode(schema(kind))
        number = self._writer.register_schema(kind.__name__, "jsonschema", text)
        return self._writer.register_channel(kind.topic, "json", number)

    @property
    def size_bytes(self) -> int:
        return self._file.tell()

    def write(self, record: Record, time_us: int, number: int) -> None:
        """Add a record at an autopilot time, with the number as in `FlightLog.put`."""
        time_ns = time_us * 1000 if time_us > 0 else 0  # a faulty clock may be negative, an MCAP time may not
        channel = self._channels[type(record)]
        self._writer.add_message(channel, time_ns, encode(record), time_ns, number & 0xFFFFFFFF)

    def flush(self) -> None:
        # Otherwise the library ends a chunk only at 1 MB, and a killed process would lose seconds of records.
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._file.flush()

    def sync(self) -> None:
        os.fsync(self._file.fileno())

    def finish(self, end: dict[str, str]) -> None:
        """Write `end` as the last metadata record, then the index."""
        self._writer.add_metadata(END, end)
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        self.sync()

    def close(self) -> None:
        self._file.close()


class FlightLog:
    """Writer of one flight's log.

    `put` never blocks and never raises. Records that the disk rejects are counted in `lost`, and the flight
    continues.

    Args:
        path: the first file, which must not exist yet.
        part_bytes: size after which the next file begins.
        most_parts: number of files that contain telemetry. One more file contains only decisions.

    Attributes:
        failure: reason why the log stopped before the flight ended, or None.
        patience_s: timeout of each of the two waits for the disk in `close`.
    """

    def __init__(
        self,
        path: Path,
        about: dict[str, str],
        *,
        part_bytes: int = PART_BYTES,
        most_parts: int = MAX_PARTS,
    ) -> None:
        self.path = path
        self.patience_s = 5.0
        self.lost = 0
        self.failure: str | None = None
        self._about, self._part_bytes, self._most_parts = about, part_bytes, most_parts
        self._parts = 1
        self._waiting: deque[tuple[Record, int]] = deque()
        self._part = LogPart(path, about, 1)
        self._time_us = 0
        self._synced_s = 0.0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="flight log", daemon=True)
        self._thread.start()

    @property
    def shortfall(self) -> str | None:
        """Description of the missing part of the log, or None if the log is complete."""
        if self.failure is not None:
            return f"{self.failure}, {self.lost} records lost"
        return f"{self.lost} records lost" if self.lost else None

    def put(self, record: Record, number: int) -> None:
        """Queue a record with the number of the recorded input, or of the input that caused the record."""
        if len(self._waiting) >= _MAX_WAITING:
            self.lost += 1
            return
        self._waiting.append((record, number))

    def close(self) -> None:
        """Write the queued records and finish the file with its index.

        If the disk does not respond, the file stays incomplete and can be read up to its last whole chunk.
        """
        self._closing.set()
        for _ in range(2):  # if the process was suspended, the first wait may end immediately
            self._thread.join(self.patience_s)
        if self._thread.is_alive():  # the thread may be writing a record, so do not write the index
            self.failure = "the disk does not respond"
            return
        if self.failure is None:
            try:
                self._part.finish({"lost": str(self.lost)})
            except OSError as error:
                self.failure = error.strerror or str(error)
        with contextlib.suppress(OSError):
            self._part.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            self._closing.wait(_FLUSH_S)
            self._drain()
        self._drain()

    def _drain(self) -> None:
        wrote = False
        try:
            while self._waiting:
                record, number = self._waiting.popleft()
                if self.failure is not None:
                    self.lost += 1
                    continue
                self._write(record, number)
                wrote = True
            if wrote:
                self._part.flush()
                self._rotate()
                now = time.monotonic()
                if now - self._synced_s >= _SYNC_S:
                    self._synced_s = now
                    self._part.sync()
        except OSError as error:
            self._fail(error.strerror or str(error))
        except Exception as error:
            # An unwritable record stops the log, not the flight.
            self._fail(f"a record cannot be written: {type(error).__name__}: {error}")

    def _fail(self, why: str) -> None:
        self.failure = why
        self.lost += 1

    def _write(self, record: Record, number: int) -> None:
        if self._parts > self._most_parts and record.frequent:
            self.lost += 1
            return
        t_us = getattr(record, "t_us", 0)
        if t_us:
            self._time_us = t_us  # a record without autopilot time gets the time of the previous record
        self._part.write(record, self._time_us, number)

    def _rotate(self) -> None:
        if self._part.size_bytes < self._part_bytes or self._parts > self._most_parts:
            return
        self._part.finish({"lost": str(self.lost), "continued": "yes"})
        self._part.close()
        self._parts += 1
        self._part = LogPart(part_path(self.path, self._parts), self._about, self._parts)


def part_path(first: Path, number: int) -> Path:
    """Return flight.mcap, flight.part2.mcap, ..."""
    return first if number == 1 else first.with_suffix(f".part{number}{first.suffix}")


def new_flight_folder(root: Path, name: str) -> Path:
    """Create root/<date>T<time>-<name>, with a number appended if this folder exists."""
    stamp = time.strftime("%Y%m%dT%H%M%S")
    slug = "".join(c if c.isalnum() else "-" for c in name)
    for attempt in range(1000):
        folder = root / (f"{stamp}-{slug}" if attempt == 0 else f"{stamp}-{slug}-{attempt}")
        try:
            folder.mkdir(parents=True, exist_ok=False)
        except FileExistsError:
            continue
        return folder
    raise OSError(f"no free folder name below {root}")
