"""The sensors' normal numbers are those that `random.Random.gauss` gives, bit for bit."""

from __future__ import annotations

import math
import random

from dart_flight.sim.noise import GaussianNoise


def test_they_are_the_numbers_of_gauss() -> None:
    ours, theirs = GaussianNoise(random.Random(7)), random.Random(7)
    sigmas = [0.3, 0.0, 2.0, 1e-9, 5.0]
    for i in range(1000):
        x, expected = ours.one(sigmas[i % 5]), theirs.gauss(0.0, sigmas[i % 5])
        assert x == expected
        assert math.copysign(1.0, x) == math.copysign(1.0, expected)


def test_three_are_three_in_order() -> None:
    ours, theirs = GaussianNoise(random.Random(3)), random.Random(3)
    ours.one(1.0), theirs.gauss(0.0, 1.0)  # the second of a pair is kept in between
    assert ours.three(0.5) == tuple(theirs.gauss(0.0, 0.5) for _ in range(3))
