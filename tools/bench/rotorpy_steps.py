"""Speed of rotorpy's Gymnasium environment, for `tools.bench.stepwise`; its interpreter has rotorpy.

    PYTHON tools/bench/rotorpy_steps.py STEPS

It prints one JSON object for each rate of the environment: the steps and the simulated seconds per second.
This file imports nothing of this program.
"""

import importlib
import importlib.metadata
import json
import sys
import time

RATES_HZ = (100, 25)  # the environment's default, and the period of `DartShuttle-v0`


def main(steps: int) -> None:
    """Step with velocity commands near zero, which keep the vehicle within its bounds."""
    environments = importlib.import_module("rotorpy.learning.quadrotor_environments")
    version = importlib.metadata.version("rotorpy")
    for rate_hz in RATES_HZ:
        environment = environments.QuadrotorEnv(control_mode="cmd_vel", sim_rate=rate_hz, max_time=10.0)
        environment.action_space.seed(1)
        environment.reset(seed=1)
        spent_s = 0.0
        for _ in range(steps):
            action = 0.3 * environment.action_space.sample()
            begin = time.process_time()
            _, _, terminated, truncated, _ = environment.step(action)
            spent_s += time.process_time() - begin
            if terminated or truncated:
                environment.reset()
        figures = {"steps_per_s": steps / spent_s, "flight_s_per_s": steps / rate_hz / spent_s}
        print(json.dumps({"name": f"rotorpy {version}, {rate_hz} Hz", **figures}))


if __name__ == "__main__":
    main(int(sys.argv[1]))
