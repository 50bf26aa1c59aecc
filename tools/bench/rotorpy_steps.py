"""Speed of rotorpy's vehicle, for `tools.bench.stepwise`; run by an interpreter that has rotorpy.

    PYTHON tools/bench/rotorpy_steps.py STEPS

It prints one JSON object for each period, with the steps and the simulated seconds per second. This file
imports nothing of this program.
"""

import importlib
import importlib.metadata
import json
import random
import sys
import time

PERIODS_S = (0.01, 0.04)  # the period of rotorpy's examples, and that of `DartShuttle-v0`


def main(steps: int) -> None:
    """Step one vehicle with velocity commands."""
    vehicles = importlib.import_module("rotorpy.vehicles.multirotor")
    parameters = importlib.import_module("rotorpy.vehicles.crazyflie_params").quad_params
    numpy = importlib.import_module("numpy")
    version = importlib.metadata.version("rotorpy")
    rng = random.Random(1)
    for period_s in PERIODS_S:
        vehicle = vehicles.Multirotor(parameters, control_abstraction="cmd_vel")
        state, spent_s = vehicle.initial_state, 0.0
        for _ in range(steps):
            command = {"cmd_v": numpy.array([rng.uniform(-0.5, 0.5) for _ in range(3)])}
            begin = time.process_time()
            state = vehicle.step(state, command, period_s)
            spent_s += time.process_time() - begin
        figures = {"steps_per_s": steps / spent_s, "flight_s_per_s": steps * period_s / spent_s}
        speed_m_s = float(numpy.linalg.norm(state["v"]))
        print(json.dumps({"name": f"rotorpy {version}, {period_s:g} s", "speed_m_s": speed_m_s, **figures}))


if __name__ == "__main__":
    main(int(sys.argv[1]))
