"""A Gymnasium environment on `dart_flight.Simulation` (extra `gym`): visit points between two walls.

The registered id is `DartShuttle-v0`. docs/python.md describes the task.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dart_flight.base.records import Mode
from dart_flight.config.mission import Mission
from dart_flight.lab.api import packaged
from dart_flight.lab.stepwise import FlightSetpoint, SteppedObservation, SteppedSimulation

PLACES_M: Final = ((1.4, 0.0), (-1.4, 0.0), (1.4, 0.0), (-1.4, 0.0), (0.0, 0.0))
_WITHIN_M: Final = 0.15
_MOST_M_S2: Final = 5.0
_PERIOD_S: Final = 0.04
_LONGEST_S: Final = 20.0
_BOUND_M: Final = 3.0
_FULL_FORCE_N: Final = 150.0

Numbers = NDArray[np.float32]


class ShuttleEnv(gymnasium.Env[Numbers, Numbers]):
    """The shuttle between two walls: reach the points in order, quickly; hitting a wall is allowed.

    Action, shape (3,), -1 to 1: acceleration along x and y (times 5 m/s2), and the lock (positive: rigid).
    Observation, shape (10,): position x, y and velocity x, y (mission frame, m and m/s), vector to the next
    point (m), external force x, y (as a fraction of 150 N), mode (1 rigid, 0 flexible or moving), and the
    fraction of points reached. Reward: -0.04 per step, plus 1 for each point. If the vehicle is down, or |x|
    or |y| exceeds 3 m, the reward is reduced by 10 and the episode ends.

    Args:
        mission: vehicle, walls and start; default: the packaged mission `shuttle`.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  (Gymnasium's declaration)

    def __init__(self, mission: Mission | str | Path | None = None) -> None:
        self._simulation = SteppedSimulation(
            mission or packaged("missions", "shuttle.yaml"), period_s=_PERIOD_S
        )
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (10,), np.float32)
        self._reached = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Numbers, dict[str, Any]]:
        """Return to hovering at the start, with new sensor noise; the same seed gives the same episode."""
        super().reset(seed=seed)
        self._reached = 0
        seen = self._simulation.reset(int(self.np_random.integers(1, 2**31)))
        return self._numbers(seen), {}

    def step(self, action: Numbers) -> tuple[Numbers, float, bool, bool, dict[str, Any]]:
        """Apply an action for 0.04 s; the vehicle keeps the mission's altitude."""
        ax, ay, lock = (float(value) for value in np.clip(action, -1.0, 1.0))
        mode = Mode.RIGID if lock > 0.0 else Mode.FLEXIBLE
        altitude_m = self._simulation.mission.altitude_m
        nan = float("nan")
        seen = self._simulation.step(
            FlightSetpoint((nan, nan, altitude_m), None, (_MOST_M_S2 * ax, _MOST_M_S2 * ay, nan), 0.0, mode)
        )
        reward = -_PERIOD_S
        if np.hypot(*(seen.position[:2] - PLACES_M[self._reached])) < _WITHIN_M:
            self._reached += 1
            reward += 1.0
        done = self._reached == len(PLACES_M)
        failed = not done and (seen.is_down or float(np.abs(seen.position[:2]).max()) > _BOUND_M)
        if failed:
            reward -= 10.0
        info = {"time_s": seen.time_s, "contacts": seen.contacts, "reached": self._reached}
        numbers = self._numbers(seen)
        return numbers, reward, done or failed, not done and seen.time_s >= _LONGEST_S, info

    def _numbers(self, seen: SteppedObservation) -> Numbers:
        place = PLACES_M[min(self._reached, len(PLACES_M) - 1)]
        position = seen.position[:2]
        rest = (float(seen.mode is Mode.RIGID), self._reached / len(PLACES_M))
        parts = (position, seen.velocity[:2], place - position, seen.force[:2] / _FULL_FORCE_N, rest)
        return np.concatenate(parts).astype(np.float32)


gymnasium.register("DartShuttle-v0", entry_point="dart_flight.lab.gym_shuttle:ShuttleEnv")
