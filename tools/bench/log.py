"""Cost of the flight log: a simulated flight's records, put at the pace at which they came.

python -m tools.bench.log
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

from dart_flight.config.mission import load_mission
from dart_flight.recording.about import describe_flight
from dart_flight.recording.writer import FlightLog
from dart_flight.samples import Record, TruthContact, TruthSample, World
from dart_flight.worlds.fast import FastFlight

_MISSION = Path(__file__).parents[2] / "missions" / "dual_collision.yaml"
_SLOT_US = 4000  # one IMU sample
_PACED_S = 10.0


def recorded() -> list[list[tuple[Record, int]]]:
    """The records of a dual collision but for the simulator's truth, by slots of 4 ms."""
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


def _pace(slots: list[list[tuple[Record, int]]], log: FlightLog | None) -> tuple[float, int]:
    """Put the slots in real time; processor seconds of the whole process and the number of records."""
    count = 0
    cpu, begin = time.process_time(), time.monotonic()
    for i, slot in enumerate(slots):
        for record, number in slot:
            count += 1
            if log is not None:
                log.put(record, number)
        time.sleep(max(0.0, begin + 1e-6 * _SLOT_US * (i + 1) - time.monotonic()))
    return time.process_time() - cpu, count


def rows() -> list[dict[str, Any]]:
    """Rows for the benchmark table.

    `log record`: processor time per record, encoding, compression and writing included, microseconds.
    `log share`: of one core at 250 IMU samples a second, per cent. `log size`: megabytes per minute. There is
    no baseline.
    """
    slots = recorded()
    paced = slots[: round(_PACED_S * 1e6 / _SLOT_US)]
    mission = load_mission(_MISSION)
    with tempfile.TemporaryDirectory() as folder:
        log = FlightLog(Path(folder) / "flight.mcap", describe_flight(mission, World.FAST, 1))
        with_log, count = _pace(paced, log)
        log.close()
        size = log.path.stat().st_size
    without, _ = _pace(paced, None)
    cpu_s = max(with_log - without, 0.0)
    seconds = len(paced) * 1e-6 * _SLOT_US
    values = (
        ("log record", 1e6 * cpu_s / count, "us"),
        ("log share", 100.0 * cpu_s / seconds, "%"),
        ("log size", size / 1e6 * 60.0 / seconds, "MB/min"),
    )
    return [{"name": n, "value": v, "unit": u, "baseline": None, "ratio": None} for n, v, u in values]


if __name__ == "__main__":
    for row in rows():
        print(f"{row['name']:12s} {row['value']:8.2f} {row['unit']}")
