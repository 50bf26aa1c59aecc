"""Benchmark of stepping a simulation from Python: `DartShuttle-v0`, compared with rotorpy's vehicle.

    ROTORPY=PYTHON python -m tools.bench stepwise

PYTHON is the interpreter of a virtual environment with rotorpy. Without it, rotorpy is left out. A step here
is 0.04 s of flight: 40 steps of the plant, and 10 of sensors, estimator, autopilot and force estimator. The
figures are processor time without resets, and are in docs/results/stepping.md.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from pathlib import Path
from typing import Any

from dart_flight.base.records import Mode
from dart_flight.lab.api import packaged
from dart_flight.lab.gym_shuttle import ShuttleEnv
from dart_flight.lab.stepwise import FlightSetpoint, SteppedSimulation

STEPS = 1500
_PERIOD_S = 0.04
_ACTION_SHARE = 0.3  # share of the largest acceleration; small, so that episodes do not end early


def shuttle_seconds(steps: int) -> float:
    """Return the processor time of this number of environment steps, seconds."""
    environment, spent_s = ShuttleEnv(), 0.0
    environment.action_space.seed(1)
    environment.reset(seed=1)
    for _ in range(steps):
        action = _ACTION_SHARE * environment.action_space.sample()
        begin = time.process_time()
        _, _, terminated, truncated, _ = environment.step(action)
        spent_s += time.process_time() - begin
        if terminated or truncated:
            environment.reset()
    return spent_s


def hover_seconds(steps: int) -> float:
    """Return the processor seconds of steps of a hovering `SteppedSimulation`."""
    simulation = SteppedSimulation(packaged("missions", "shuttle.yaml"), period_s=_PERIOD_S)
    setpoint = FlightSetpoint(position_mission=(0.0, 0.0, 1.0), mode=Mode.RIGID)
    begin = time.process_time()
    for _ in range(steps):
        simulation.step(setpoint)
    return time.process_time() - begin


def rows(steps: int = STEPS) -> list[dict[str, Any]]:
    """Return rows for the benchmark table: seconds of flight per second, and steps per second."""
    found = []
    for name, seconds in (("`DartShuttle-v0`", shuttle_seconds), ("`Simulation`, hovering", hover_seconds)):
        per_s = steps / seconds(steps)
        found += _rows_of(f"{name}, {_PERIOD_S:g} s", per_s, per_s * _PERIOD_S)
    if rotorpy := os.environ.get("ROTORPY"):
        script = Path(__file__).with_name("rotorpy_steps.py")
        done = subprocess.run(
            [rotorpy, str(script), str(steps)], stdout=subprocess.PIPE, text=True, check=True
        )
        for row in map(json.loads, done.stdout.splitlines()):
            found += _rows_of(row["name"], row["steps_per_s"], row["flight_s_per_s"])
    return found


def _rows_of(name: str, steps_per_s: float, flight_s_per_s: float) -> list[dict[str, Any]]:
    figures = ((f"{name} a step", steps_per_s, "steps/s"), (f"{name}, flight", flight_s_per_s, "s/s"))
    return [{"name": n, "value": v, "unit": u, "baseline": None, "ratio": None} for n, v, u in figures]


if __name__ == "__main__":
    for each in rows():
        print(each)
