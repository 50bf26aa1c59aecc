"""Wind over the plant: a steady part and horizontal gusts (first-order Gauss-Markov)."""

from __future__ import annotations

import math
import random
from typing import Final

from dart_flight.config.vehicle import Simulation
from dart_flight.sim.noise import GaussianNoise
from dart_flight.sim.plant import Plant

GUST_TIME_S: Final = 2.0  # correlation time: gusts in a room last longer than a contact


class Wind:
    """The wind on the plant; call `step` every `tick_s`. The gusts do not affect the sensors' noise."""

    def __init__(self, simulation: Simulation, seed: int, tick_s: float) -> None:
        self._steady, self._sigma = simulation.wind_north_east_m_s, simulation.gust_m_s
        self._decay = math.exp(-tick_s / GUST_TIME_S)
        self._kick = math.sqrt(1.0 - self._decay * self._decay)
        self._noise = GaussianNoise(random.Random(seed ^ 0x57494E44))
        self._gust = [self._noise.one(self._sigma), self._noise.one(self._sigma)]

    def step(self, plant: Plant) -> None:
        if self._sigma > 0.0:
            for i in range(2):
                self._gust[i] = self._decay * self._gust[i] + self._kick * self._noise.one(self._sigma)
        plant.wind_ned = (self._steady[0] + self._gust[0], self._steady[1] + self._gust[1], 0.0)
