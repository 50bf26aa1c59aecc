"""Benchmark of stepping a simulation from Python: `DartShuttle-v0`, compared with rotorpy's vehicle.

    python -m tools.bench.stepwise [--rotorpy PYTHON]

PYTHON is the interpreter of a virtual environment with rotorpy. A step here is 0.04 s of flight: 40 steps
of the plant, and 10 of sensors, estimator, autopilot and force estimator. The figures are processor time
without resets, and are in docs/results/stepping.md.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from pathlib import Path

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


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rotorpy", metavar="PYTHON", help="interpreter that has rotorpy")
    parser.add_argument("--steps", type=int, default=STEPS)
    options = parser.parse_args()
    print(f"{'':32s} steps/s  flight s/s")
    for name, seconds in (("DartShuttle-v0", shuttle_seconds), ("Simulation, hovering", hover_seconds)):
        per_s = options.steps / seconds(options.steps)
        print(f"{name:32s} {per_s:7.0f} {per_s * _PERIOD_S:11.1f}")
    if options.rotorpy is not None:
        script = Path(__file__).with_name("rotorpy_steps.py")
        command = [options.rotorpy, str(script), str(options.steps)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        for line in done.stdout.splitlines():
            row = json.loads(line)
            print(f"{row['name']:32s} {row['steps_per_s']:7.0f} {row['flight_s_per_s']:11.1f}")


if __name__ == "__main__":
    main()
