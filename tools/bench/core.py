"""Benchmark of the flight core: one step per input of a flight; and of whole simulated flights.

python -m tools.bench.core
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from typing import Any

from dart_flight.config.mission import load_mission
from dart_flight.core.flight_core import FlightCore
from dart_flight.samples import ImuSample, Input, World
from dart_flight.worlds.fast import FastFlight
from dart_flight.worlds.flight_record import FlightRecord

_MISSIONS = Path(__file__).parents[2] / "missions"
_DUAL = _MISSIONS / "dual_collision.yaml"
_REPEATS = 3
_FLIGHTS = 10  # of each mission, seeds from 1 on


def recorded_inputs() -> list[Input]:
    """Every input of a simulated dual collision."""
    inputs: list[Input] = []
    flight = FastFlight(load_mission(_DUAL), 1)
    step = flight.core.step

    def keep(item: Input) -> Any:
        inputs.append(item)
        return step(item)

    flight.core.step = keep  # type: ignore[method-assign]
    flight.run()
    return inputs


def fast_flights(mission_file: Path) -> tuple[float, float]:
    """Medians over flights without a log: processor seconds of a flight, and its simulated seconds."""
    mission = load_mission(mission_file)
    took, flown = [], []
    for seed in range(1, _FLIGHTS + 1):
        record = FlightRecord(mission, World.FAST, seed, None)
        begin = time.process_time()
        flight = FastFlight(mission, seed, observe=record)
        flight.run()
        record.build()
        took.append(time.process_time() - begin)
        flown.append(flight.autopilot.now_s)
    return statistics.median(took), statistics.median(flown)


def rows() -> list[dict[str, Any]]:
    """Rows for the benchmark table.

    `core step`: mean processor time of one step over a whole flight's inputs, microseconds; `core step imu`
    over its IMU samples alone, which carry the estimate, the detector and the pulse fit. `fast flight` of a
    mission: processor time of one flight with its verdict, without a log, seconds; the baseline is its
    simulated time, so that the ratio says how many times real time that is.
    """
    inputs = recorded_inputs()
    every, imu = float("inf"), float("inf")
    for _ in range(_REPEATS):
        core = FlightCore(load_mission(_DUAL))
        imu_s, imu_count = 0.0, 0
        begin = time.process_time()
        for item in inputs:
            if isinstance(item, ImuSample):
                start = time.process_time()
                core.step(item)
                imu_s += time.process_time() - start
                imu_count += 1
            else:
                core.step(item)
        every = min(every, (time.process_time() - begin) / len(inputs))
        imu = min(imu, imu_s / imu_count)
    flights = [_flight_row(name) for name in ("dual_collision", "single_wall")]
    return [_row("core step", every * 1e6), _row("core step imu", imu * 1e6), *flights]


def _flight_row(mission: str) -> dict[str, Any]:
    took_s, flown_s = fast_flights(_MISSIONS / f"{mission}.yaml")
    return {
        "name": f"fast flight {mission}",
        "value": took_s,
        "unit": "s",
        "baseline": flown_s,
        "ratio": flown_s / took_s,
    }


def _row(name: str, value_us: float) -> dict[str, Any]:
    return {"name": name, "value": value_us, "unit": "us", "baseline": None, "ratio": None}


if __name__ == "__main__":
    for row in rows():
        print(row)
