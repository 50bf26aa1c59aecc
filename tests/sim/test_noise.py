"""The sensors' noise equals that of `random.Random.gauss`, bit for bit."""

from __future__ import annotations

import math
import random

from dart_flight.sim.noise import GaussianNoise


def test_single_values_equal_those_of_random_gauss() -> None:
    sensor_noise, reference = GaussianNoise(random.Random(7)), random.Random(7)
    sigmas = [0.3, 0.0, 2.0, 1e-9, 5.0]
    for i in range(1000):
        x, expected = sensor_noise.one(sigmas[i % 5]), reference.gauss(0.0, sigmas[i % 5])
        assert x == expected
        assert math.copysign(1.0, x) == math.copysign(1.0, expected)


def test_three_values_at_once_equal_three_single_values() -> None:
    sensor_noise, reference = GaussianNoise(random.Random(3)), random.Random(3)
    sensor_noise.one(1.0), reference.gauss(0.0, 1.0)  # the second value of the pair stays stored
    assert sensor_noise.three(0.5) == tuple(reference.gauss(0.0, 0.5) for _ in range(3))
