"""Predictions of a mission's path with varied walls, for `lab.report.figures.mission_figure`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dart_flight.config.mission import Mission
from dart_flight.planning.predicted_flight import PredictedFlight, flights_with
from dart_flight.planning.rollout import MIN_FACTOR, UncertaintyDraw, draw_wall


def predict_with_draws(mission: Mission, count: int = 40, seed: int = 1) -> list[PredictedFlight]:
    """Predict the path of a mission for `count` sets of walls that differ at random from the mission's walls.

    The contact coefficients k, f and mu are drawn for every wall and mode. Their relative standard deviation
    is `estimation.walls.spread`, as in the prior of a wall's estimate. If the mission gives a wall an
    uncertainty, the position and direction of this wall are drawn too. Approaches stay as planned.
    """
    rng, spread = np.random.default_rng(seed), mission.vehicle.estimation.walls.spread
    place_rng = np.random.default_rng([seed, 1])  # draws of places must not change those of coefficients
    draws: list[UncertaintyDraw | None] = []
    for _ in range(count):
        wall_factors = {
            (wall.name, mode): _factors(spread * rng.standard_normal(3))
            for wall in mission.walls
            for mode in mission.vehicle.modes
        }
        modes, hits = mission.vehicle.modes, mission.collisions
        factors = {(str(c.index), mode): wall_factors[c.wall.name, mode] for c in hits for mode in modes}
        places = {wall.name: draw_wall(wall, place_rng) for wall in mission.walls if wall.is_uncertain}
        draws.append(UncertaintyDraw(factors, 0.0, 0.0, 0.0, places))
    return flights_with(mission, draws)


def _factors(relative: NDArray[np.float64]) -> tuple[float, float, float]:
    k, f, mu = np.maximum(1.0 + relative, MIN_FACTOR)
    return float(k), float(f), float(mu)
