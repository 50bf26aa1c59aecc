"""The flight log: MCAP with JSON messages and their JSON Schemas, so that Foxglove opens it as it is.

One channel per record type (`topic` in `samples`). A message's sequence number is the number of the input
it is or follows from: a replay feeds inputs in that order. Log time is the autopilot's clock. Records are
encoded and written by a thread of their own in small chunks, so that a killed process loses at most 0.2 s.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

import msgspec
from mcap.writer import CompressionType, Writer

from dart_flight import __version__
from dart_flight.samples import (
    ActuatorSample,
    AttitudeSample,
    AttitudeTargetSample,
    ClockOffset,
    CommandResult,
    ContactEnd,
    EscSample,
    ForceEstimate,
    GoalPassed,
    GuardEvent,
    ImpactOnset,
    ImpactPeak,
    ImuSample,
    LockCommand,
    LockPermission,
    LockState,
    MissionEnd,
    OdometrySample,
    OperatorRequest,
    PhaseChange,
    Record,
    SetPoint,
    SetPointSent,
    Silence,
    StatusSample,
    StatusText,
    Tick,
    TruthContact,
    TruthSample,
    VehicleCommand,
)

FORMAT_VERSION = 1
PROFILE = "dart-flight"
_FLUSH_S = 0.05
_MOST_WAITING = 200_000  # records; about two minutes of a flight while the disk does not answer

RECORD_TYPES: tuple[type[Record], ...] = (
    ImuSample,
    AttitudeSample,
    OdometrySample,
    ActuatorSample,
    AttitudeTargetSample,
    EscSample,
    StatusSample,
    StatusText,
    LockState,
    CommandResult,
    OperatorRequest,
    ClockOffset,
    Tick,
    SetPoint,
    VehicleCommand,
    LockCommand,
    LockPermission,
    Silence,
    ForceEstimate,
    ImpactOnset,
    ImpactPeak,
    ContactEnd,
    PhaseChange,
    GuardEvent,
    GoalPassed,
    MissionEnd,
    TruthSample,
    TruthContact,
    SetPointSent,
)


class FlightLog:
    """Writes one flight.

    `put` never blocks and never raises; what the disk refuses is counted in `lost`, the flight goes on.

    Args:
        path: the file, which must not exist.
        about: what describes the flight: mission and configuration text, world, seed, host.

    Raises:
        OSError: the file cannot be created.
    """

    def __init__(self, path: Path, about: dict[str, str]) -> None:
        self.path = path
        self.lost = 0
        self.failure: str | None = None
        self._waiting: deque[tuple[Record, int]] = deque()
        self._file = open(path, "xb")  # noqa: SIM115
        self._writer = Writer(self._file, compression=CompressionType.ZSTD)
        self._writer.start(profile=PROFILE, library=f"dart-flight {__version__}")
        self._writer.add_metadata(
            "dart_flight", {"format_version": str(FORMAT_VERSION), "software": __version__, **about}
        )
        self._channels = {kind: self._register(kind) for kind in RECORD_TYPES}
        self._encoder = msgspec.json.Encoder()
        self._time_us = 0
        self._closing = threading.Event()
        self._flush_now()
        self._thread = threading.Thread(target=self._run, name="flight log", daemon=True)
        self._thread.start()

    def put(self, record: Record, number: int) -> None:
        """Queue a record; `number` is that of the input it is or follows from."""
        if len(self._waiting) >= _MOST_WAITING:
            self.lost += 1
            return
        self._waiting.append((record, number))

    def close(self) -> None:
        """Write what is queued, finish the file with its index."""
        self._closing.set()
        self._thread.join(timeout=10.0)
        with contextlib.suppress(OSError):
            if self.failure is None:
                self._writer.finish()  # type: ignore[no-untyped-call]
        with contextlib.suppress(OSError):
            self._file.close()

    def _register(self, kind: type[Record]) -> int:
        schema = self._writer.register_schema(
            kind.__name__, "jsonschema", msgspec.json.encode(_flat_schema(kind))
        )
        return self._writer.register_channel(kind.topic, "json", schema)

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
                self._flush_now()
        except OSError as error:
            # A full disk stops the log, not the flight.
            self.failure = error.strerror or str(error)
            self.lost += 1

    def _write(self, record: Record, number: int) -> None:
        t_us = getattr(record, "t_us", 0)
        if t_us:
            self._time_us = t_us  # records without autopilot time are logged at that of the one before
        self._writer.add_message(
            channel_id=self._channels[type(record)],
            log_time=self._time_us * 1000,
            publish_time=self._time_us * 1000,
            data=self._encoder.encode(record),
            sequence=number & 0xFFFFFFFF,
        )

    def _flush_now(self) -> None:
        # The library ends a chunk only by its size; waiting for a megabyte would cost a killed flight many
        # seconds. Its private method is the one way to end a chunk by time (tests hold us to it).
        getattr(self._writer, "_Writer__finalize_chunk")()  # noqa: B009
        self._file.flush()


def _flat_schema(kind: type[Record]) -> dict[str, Any]:
    """JSON Schema of a record with its definitions inlined: Foxglove does not follow references."""
    schema, components = msgspec.json.schema_components([kind], ref_template="{name}")

    def inline(node: Any) -> Any:
        if isinstance(node, dict):
            if "$ref" in node:
                return inline(components[node["$ref"]])
            if "enum" in node:
                return {"type": "string"}
            if "prefixItems" in node:  # a vector: Foxglove knows arrays with one kind of item
                return {"type": "array", "items": inline(node["prefixItems"][0])}
            if "anyOf" in node:  # a value that may be missing
                some = [part for part in node["anyOf"] if part.get("type") != "null"]
                return inline(some[0])
            return {key: inline(value) for key, value in node.items()}
        if isinstance(node, list):
            return [inline(part) for part in node]
        return node

    flat: dict[str, Any] = inline(schema[0])
    flat["title"] = kind.__name__
    flat["description"] = " ".join((kind.__doc__ or "").split())
    return flat


def new_flight_folder(root: Path, name: str) -> Path:
    """A fresh folder for one flight: root/<date>T<time>-<name>, with a number where that exists.

    Raises:
        OSError: it cannot be made.
    """
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
