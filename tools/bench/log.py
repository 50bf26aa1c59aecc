"""Benchmark of the flight log with a simulated flight's records at their original pace.

python -m tools.bench.log
"""

from __future__ import annotations

import tempfile
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

from dart_flight.base.records import Record, TruthContact, TruthSample, World
from dart_flight.config.mission import load_mission
from dart_flight.recording.about import describe_flight
from dart_flight.recording.writer import FlightLog
from dart_flight.run.fast import FastFlight
from tools.bench.processor import thread_seconds

_MISSION = Path(__file__).parents[2] / "missions" / "paper_dual_collision.yaml"
_SLOT_US = 4000  # one IMU sample
_PACED_S = 10.0
_WRITTEN_S = 0.5  # time for writing after the last record


def record_slots() -> list[list[tuple[Record, int]]]:
    """Return the records of a dual collision in slots of 4 ms, without the simulator's truth."""
    slots: list[list[tuple[Record, int]]] = [[]]
    begin: list[int] = []

    def keep(record: Any, number: int) -> None:
        if isinstance(record, TruthSample | TruthContact):
            return
        t_us = getattr(record, "t_us", 0)
        if t_us and not begin:
            begin.append(t_us)
        while t_us and t_us - begin[0] >= _SLOT_US * len(slots):
            slots.append([])
        slots[-1].append((record, number))

    FastFlight(load_mission(_MISSION), 1, observe=keep).run()
    return slots


class _Cost(NamedTuple):
    """Processor seconds of putting the records and of the log's own thread, and the number of records."""

    putting_s: float
    writing_s: float
    records: int


def _thread_of(name: str) -> int:
    """Return the operating system's id of the newest thread with this name."""
    return [t.native_id or 0 for t in threading.enumerate() if t.name == name][-1]


def _put(slots: list[list[tuple[Record, int]]], log: FlightLog, paced: bool) -> _Cost:
    """Put the slots, in real time or at once, and wait until they are written."""
    count, putting, writer = 0, 0.0, _thread_of("flight log")
    written, begin = thread_seconds()[writer], time.monotonic()
    for i, slot in enumerate(slots):
        started = time.thread_time()
        for record, number in slot:
            log.put(record, number)
        putting += time.thread_time() - started
        count += len(slot)
        if paced:
            time.sleep(max(0.0, begin + 1e-6 * _SLOT_US * (i + 1) - time.monotonic()))
    time.sleep(_WRITTEN_S)
    return _Cost(putting, thread_seconds()[writer] - written, count)


def rows() -> list[dict[str, Any]]:
    """Return rows for the benchmark table.

    `log record` is the processor time per record at the pace of a flight, in microseconds, including
    encoding, compression and writing. The baseline puts all records without pauses, with warm caches. `log
    put` is the part of this time that is spent on the core's thread. `log share` is the share of one core at
    250 IMU samples a second, in per cent. `log size` is in megabytes per minute.
    """
    paced = record_slots()[: round(_PACED_S * 1e6 / _SLOT_US)]
    about = describe_flight(load_mission(_MISSION), World.FAST, 1)
    with tempfile.TemporaryDirectory() as folder:
        costs = []
        for name in ("paced", "at once"):
            log = FlightLog(Path(folder) / f"{name}.mcap", about)
            costs.append(_put(paced, log, paced=name == "paced"))
            log.close()
        size = log.path.stat().st_size
    seconds = len(paced) * 1e-6 * _SLOT_US
    flight, at_once = ((cost.putting_s + cost.writing_s) for cost in costs)
    count = costs[0].records
    values = (
        ("log record", 1e6 * flight / count, "us", 1e6 * at_once / count),
        ("log put", 1e6 * costs[0].putting_s / count, "us", 1e6 * costs[1].putting_s / count),
        ("log share", 100.0 * flight / seconds, "%", None),
        ("log size", size / 1e6 * 60.0 / seconds, "MB/min", None),
    )
    return [
        {"name": n, "value": v, "unit": unit, "baseline": b, "ratio": None if b is None else b / v}
        for n, v, unit, b in values
    ]


if __name__ == "__main__":
    for row in rows():
        print(f"{row['name']:12s} {row['value']:8.2f} {row['unit']}")
