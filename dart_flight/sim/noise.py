"""Normally distributed noise of the simulated sensors: one reproducible sequence per simulated vehicle."""

from __future__ import annotations

import math
import random

from dart_flight.base.geometry import Vec3


class GaussianNoise:
    """Independent normal random numbers, computed in pairs from uniform random numbers (Box and Muller).

    The values equal those of `random.Random.gauss`, but this class is compiled (docs/speed.md). Other users
    of `rng` change the sequence.
    """

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng
        self._uniform = rng.random
        self._kept = 0.0  # the second number of a pair, if available
        self._has_kept = False

    def one(self, sigma: float) -> float:
        if self._has_kept:
            self._has_kept = False
            # Adding 0.0 turns -0.0 into 0.0, as `gauss` does.
            return 0.0 + self._kept * sigma
        angle = self._uniform() * math.tau
        radius = math.sqrt(-2.0 * math.log(1.0 - self._uniform()))
        self._kept, self._has_kept = math.sin(angle) * radius, True
        return 0.0 + math.cos(angle) * radius * sigma

    def three(self, sigma: float) -> Vec3:
        x = self.one(sigma)
        y = self.one(sigma)
        return (x, y, self.one(sigma))
