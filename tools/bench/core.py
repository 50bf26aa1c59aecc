"""Benchmark of the flight core: one step per input of a flight, and a whole simulated flight."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from dart_flight.config.mission import load_mission
from dart_flight.core.flight_core import FlightCore
from dart_flight.samples import ImuSample, Input
from dart_flight.worlds.fast import FastFlight

_MISSION = Path(__file__).parents[2] / "missions" / "dual_collision.yaml"
_REPEATS = 3


def recorded_inputs() -> tuple[list[Input], float, float]:
    """Every input of a simulated dual collision, its simulated time and the time it took, s."""
    inputs: list[Input] = []
    flight = FastFlight(load_mission(_MISSION), 1)
    step = flight.core.step

    def keep(item: Input) -> Any:
        inputs.append(item)
        return step(item)

    flight.core.step = keep  # type: ignore[method-assign]
    begin = time.process_time()
    flight.run()
    return inputs, flight.autopilot.now_s, time.process_time() - begin


def rows() -> list[dict[str, Any]]:
    """Rows for the benchmark table.

    `core step`: mean processor time of one step over a whole flight's inputs, microseconds; `core step imu`
    over its IMU samples alone, which carry the estimate, the detector and the pulse fit. `fast flight
    real-time factor`: simulated seconds per second of processor time of the whole fast world; its baseline
    is real time.
    """
    inputs, simulated_s, took_s = recorded_inputs()
    every, imu = float("inf"), float("inf")
    for _ in range(_REPEATS):
        core = FlightCore(load_mission(_MISSION))
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
    factor = simulated_s / took_s
    return [
        _row("core step", every * 1e6),
        _row("core step imu", imu * 1e6),
        {
            "name": "fast flight real-time factor",
            "value": factor,
            "unit": "x",
            "baseline": 1.0,
            "ratio": factor,
        },
    ]


def _row(name: str, value_us: float) -> dict[str, Any]:
    return {"name": name, "value": value_us, "unit": "us", "baseline": None, "ratio": None}


if __name__ == "__main__":
    for row in rows():
        print(row)
