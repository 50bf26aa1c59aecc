"""Run-up and approach of every candidate at once: the same rules as `plan_approach`, vectorised."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_flight.config.scenario import Scenario
from dart_flight.core.mission.approach import CLEARANCE_M, ON_PLANE_M, PEAK_OVER_MEAN
from dart_flight.geometry import Vec2, Wall
from dart_flight.planning.constraints import Constraints, Refusal

Array = NDArray[np.float64]
Codes = NDArray[np.int8]

_REST_SPEED = 1.875  # of a rest-to-rest transit: peak over mean speed ...
_REST_ACCELERATION = 5.774  # ... and peak acceleration times T^2 over the way (`planning.approach.Transit`)


class ApproachGrid(NamedTuple):
    """Approaches of the first collision; arrays that broadcast with the velocities.

    Attributes:
        codes: refusals, 0 where the approach can be flown.
        impact_x, impact_y: where the plane is met.
        begin_x, begin_y: run-up point.
        impact_s: from the start of the run-up to the plane.
        transit_s: from `start` to the run-up point.
    """

    codes: Codes
    impact_x: Array
    impact_y: Array
    begin_x: Array
    begin_y: Array
    impact_s: Array
    transit_s: Array


def approach_grid(
    scenario: Scenario, wall: Wall, normal: Array, tangential: Array, constraints: Constraints | None
) -> ApproachGrid:
    """Approaches to a wall at given velocities in its collision frame (m/s, normal < 0).

    Without constraints nothing is refused.
    """
    flying, (sx, sy) = scenario.vehicle.flying, scenario.start
    (nx, ny), (tx, ty) = wall.normal, wall.tangent
    vx, vy = nx * normal + tx * tangential, ny * normal + ty * tangential
    speed = np.hypot(vx, vy)
    until = wall.signed_distance(scenario.start) / -normal
    impact_x, impact_y = sx + vx * until, sy + vy * until
    ramp = PEAK_OVER_MEAN * speed / flying.acceleration_m_s2
    needed = 0.5 * speed * ramp + speed * flying.steady_run_s
    from_start = speed * until
    length = np.where(from_start >= needed, from_start, needed)
    begin_x = np.where(from_start >= needed, sx, impact_x - vx / speed * needed)
    begin_y = np.where(from_start >= needed, sy, impact_y - vy / speed * needed)
    way = np.hypot(begin_x - sx, begin_y - sy)
    transit = np.maximum(
        _REST_SPEED * way / flying.transit_speed_m_s,
        np.sqrt(_REST_ACCELERATION * way / flying.acceleration_m_s2),
    )
    codes = np.zeros(impact_x.shape, dtype=np.int8)
    grid = ApproachGrid(
        codes,
        impact_x,
        impact_y,
        begin_x,
        begin_y,
        0.5 * ramp + length / speed,
        np.where(way > 0.0, transit, 0.0),
    )
    if constraints is None:
        return grid
    mark = constraints.mark
    mark(codes, _blocked(scenario, wall, grid), Refusal.RUN_UP_BLOCKED)
    b = scenario.bounds
    for x, y in ((impact_x, impact_y), (begin_x, begin_y)):
        outside = (x < b.x[0]) | (x > b.x[1]) | (y < b.y[0]) | (y > b.y[1])
        mark(codes, outside, Refusal.RUN_UP_ROOM)
    along = tx * (impact_x - wall.point[0]) + ty * (impact_y - wall.point[1])
    beyond = (np.abs(along) > 0.5 * wall.length_m) | (until + 0.0 * speed <= 0.0)
    mark(codes, beyond, Refusal.BEYOND_WALL)
    mark(codes, speed > scenario.limits.speed_m_s, Refusal.APPROACH_SPEED)
    return grid


def _blocked(scenario: Scenario, target: Wall, grid: ApproachGrid) -> NDArray[np.bool_]:
    """Whether a wall stands in the way from the start to the run-up point, or from there to the impact."""
    blocked = np.zeros(grid.codes.shape, dtype=bool)
    begin, impact = (grid.begin_x, grid.begin_y), (grid.impact_x, grid.impact_y)
    start = (np.full_like(begin[0], scenario.start[0]), np.full_like(begin[1], scenario.start[1]))
    for wall in scenario.walls.values():
        for a, b in ((begin, impact), (start, begin)):
            end = -ON_PLANE_M if wall is target and b is impact else CLEARANCE_M
            here = _distance(wall, a)
            da, db = here - CLEARANCE_M, _distance(wall, b) - end
            crosses = (da * db < 0.0) | ((da < 0.0) & (here > -CLEARANCE_M))
            gap = da - db
            share = np.where(gap != 0.0, da / np.where(gap != 0.0, gap, 1.0), 0.0)
            x, y = a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])
            tx, ty = wall.tangent
            spans = np.abs(tx * (x - wall.point[0]) + ty * (y - wall.point[1])) <= 0.5 * wall.length_m
            blocked |= crosses & spans
    return blocked


def straight_is_blocked(scenario: Scenario, a: Vec2, b: Vec2) -> str | None:
    """Name of a wall that stands between two points, or None."""
    for wall in scenario.walls.values():
        da, db = wall.signed_distance(a), wall.signed_distance(b)
        if da * db < 0.0:
            share = da / (da - db)
            if wall.spans((a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]))):
                return wall.name
    return None


def _distance(wall: Wall, p: tuple[Array, Array]) -> Array:
    return wall.normal[0] * (p[0] - wall.point[0]) + wall.normal[1] * (p[1] - wall.point[1])
