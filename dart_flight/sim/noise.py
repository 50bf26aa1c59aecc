"""Normal numbers of the simulated sensors: one sequence per simulated vehicle, the same for the same seed."""

from __future__ import annotations

import math
import random

from dart_flight.base.geometry import Vec3


class GaussianNoise:
    """Independent normal numbers, drawn in pairs from uniform ones (Box and Muller).

    Those of `random.Random.gauss`, written out because this is compiled and that is not (docs/speed.md).

    Args:
        rng: of the uniform numbers; who else draws from it changes the sequence.
    """

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng
        self._uniform = rng.random
        self._kept = 0.0  # the second of a pair, where there is one
        self._has_kept = False

    def one(self, sigma: float) -> float:
        """A number of mean 0 and this standard deviation."""
        if self._has_kept:
            self._has_kept = False
            # As `gauss` has it: a sum with 0.0, which has no negative zero.
            return 0.0 + self._kept * sigma
        angle = self._uniform() * math.tau
        radius = math.sqrt(-2.0 * math.log(1.0 - self._uniform()))
        self._kept, self._has_kept = math.sin(angle) * radius, True
        return 0.0 + math.cos(angle) * radius * sigma

    def three(self, sigma: float) -> Vec3:
        """Three of them: in x, y and z."""
        x = self.one(sigma)
        y = self.one(sigma)
        return (x, y, self.one(sigma))
