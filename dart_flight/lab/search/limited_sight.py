"""Plans for a wall that the vehicle detects only when the wall is near.

Until the detection, and during the reaction time, the vehicle cruises straight towards the wall. A flight
without a hit cruises at the highest speed from which it can stop (`safe_speed_m_s`). A colliding flight
cruises at the highest speed from which a feasible hit exists. After the reaction, both flights continue to
the goal as fast as possible.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
import numpy as np

from dart_flight.base.geometry import Vec2
from dart_flight.lab.search.optimal_trajectory import (
    POLISHED,
    Cruise,
    HalfPlane,
    Hit,
    HitLimits,
    Part,
    Problem,
    solve,
)
from dart_flight.lab.search.plan import MotionLimits, Plan
from dart_flight.lab.search.routes import room_of
from dart_flight.lab.search.scenario import Scenario, SightSpec

_BEFORE_WALL_M = 0.02  # distance kept when stopping before a wall that must not be touched
_STEP_M_S = 0.05  # step between the cruise speeds that are tried
_AT_LIMIT = 0.998  # fraction of a limit used for cruising, because the solver needs some room


def safe_speed_m_s(limits: MotionLimits, room_m: float, reaction_s: float) -> float:
    """Return the highest speed at which the vehicle needs at most `room_m` to react and stop."""
    a, j = limits.acceleration_m_s2, limits.jerk_m_s3 or math.inf

    def needs_m(v: float) -> float:
        braking_s = v / a + a / j if v > a * a / j else 2.0 * math.sqrt(v / j)
        return v * (0.5 * braking_s + reaction_s)

    speeds = np.linspace(0.0, limits.speed_m_s, 10_001)
    return float(speeds[np.searchsorted([needs_m(v) for v in speeds], room_m, side="right") - 1])


def plan_limited_sight(
    scenario: Scenario, sight: SightSpec, progress: Callable[[int, int], None]
) -> tuple[Plan | None, Plan | None, int]:
    """Return the fastest flights without and with a hit, and the number of computed flights.

    The scenario has one wall, in front of the start.

    Args:
        progress: called with the number of computed flights and the number of flights to compute.
    """
    limits = MotionLimits.from_scenario(scenario)
    (wall,) = scenario.walls.values()
    safe_m_s = safe_speed_m_s(limits, sight.distance_m - _BEFORE_WALL_M, sight.reaction_s)
    free = _flight(scenario, sight, safe_m_s, None)
    colliding, computed = None, 1
    for speed in np.arange(_AT_LIMIT * limits.speed_m_s, safe_m_s, -_STEP_M_S):
        progress(computed, computed + 1)
        computed += 1
        hit = Hit(wall, scenario.first_mode, None, wall.foot(scenario.start))
        colliding = _flight(scenario, sight, float(speed), hit)
        if colliding is not None:
            break
    return free, colliding, computed


def _flight(scenario: Scenario, sight: SightSpec, speed_m_s: float, hit: Hit | None) -> Plan | None:
    """Return the fastest flight that cruises at `speed_m_s` until the reaction ends."""
    (wall,) = scenario.walls.values()
    (nx, ny), (x, y) = wall.normal, wall.foot(scenario.start)
    begins_m = sight.distance_m - sight.reaction_s * speed_m_s  # distance at which the reaction ends
    seen: Vec2 = (x + begins_m * nx, y + begins_m * ny)
    off_m = 0.0 if hit else _BEFORE_WALL_M
    keep = (*room_of(scenario), HalfPlane(wall.normal, nx * x + ny * y + off_m))
    parts = (Part(Cruise(seen, (-speed_m_s * nx, -speed_m_s * ny)), keep), Part(hit, keep), Part(None, keep))
    # The cruise speed also limits the phase in which the vehicle accelerates to the cruise.
    limits = msgspec.structs.replace(MotionLimits.from_scenario(scenario), speed_m_s=speed_m_s / _AT_LIMIT)
    problem = Problem(
        scenario.vehicle,
        scenario.start,
        scenario.goal.position_m,
        parts if hit else (parts[0], parts[2]),
        limits,
        HitLimits.from_scenario(scenario),
        scenario.vehicle.flying.replan_within_s,
    )
    found = solve(problem, POLISHED)
    return found and msgspec.structs.replace(found, cruise_m_s=speed_m_s)
