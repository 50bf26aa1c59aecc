"""A mission's planned path where its walls are not what the table says."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dart_flight.config.mission import Mission
from dart_flight.planning.predicted_flight import PredictedFlight, flights_with
from dart_flight.planning.rollout import MIN_FACTOR, UncertaintyDraw, drawn_wall


def predict_with_draws(mission: Mission, count: int = 40, seed: int = 1) -> list[PredictedFlight]:
    """The planned path with other walls: k, f and mu of every wall and mode, and where the walls stand.

    The coefficients are drawn about the table's with the relative standard deviation
    `estimation.walls.spread`, what is believed of a wall before it is met; places and directions with a
    wall's own figures, where it has some. Approaches stay as planned.

    Args:
        mission: whose approaches, modes and gains are flown.
        count: how many draws.
        seed: of the draws.
    """
    rng, spread = np.random.default_rng(seed), mission.vehicle.estimation.walls.spread
    of_places = np.random.default_rng([seed, 1])  # the coefficients are the same, whatever is known of places
    draws: list[UncertaintyDraw | None] = []
    for _ in range(count):
        of_wall = {
            (wall.name, mode): _factors(spread * rng.standard_normal(3))
            for wall in mission.walls
            for mode in mission.vehicle.modes
        }
        modes, hits = mission.vehicle.modes, mission.collisions
        factors = {(str(c.index), mode): of_wall[c.wall.name, mode] for c in hits for mode in modes}
        places = {wall.name: drawn_wall(wall, of_places) for wall in mission.walls if wall.is_uncertain}
        draws.append(UncertaintyDraw(factors, 0.0, 0.0, 0.0, places))
    return flights_with(mission, draws)


def _factors(relative: NDArray[np.float64]) -> tuple[float, float, float]:
    k, f, mu = np.maximum(1.0 + relative, MIN_FACTOR)
    return float(k), float(f), float(mu)
