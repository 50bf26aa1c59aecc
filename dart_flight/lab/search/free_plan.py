"""The flight without a collision, as quick as the same limits allow: what a colliding plan has to beat.

Along a straight way the time is the optimum, from Ruckig (time-optimal with bounded speed, acceleration and
jerk). Round walls it is the quickest past the corners of the shortest polyline (`optimal_trajectory`), and
how much of that time may be in vain is told: `gap_s`, its time less that of the shortest way round the walls'
edges, straightened, which nothing beats.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import msgspec

from dart_flight.base.geometry import GRAVITY_M_S2, Vec2, distance2
from dart_flight.config.packages import missing_package
from dart_flight.lab.search.optimal_trajectory import (
    HitLimits,
    MotionLimits,
    Part,
    Problem,
    RouteCorner,
    solve,
)
from dart_flight.lab.search.routes import Obstacles, least_length_m, regions, shortest_path
from dart_flight.lab.search.scenario import Scenario

_AXIS = math.sqrt(0.5)  # of a limit on a vector's length, for each of two axes
_SPEED_USED = 0.95  # of the limit: what the flight that follows is off by is left to it
_NO_HITS = HitLimits(math.inf, None, None, None, 0.0)


class FreePlan(msgspec.Struct, frozen=True):
    """The quickest flight from start to goal that touches nothing, from rest to rest.

    Attributes:
        time_s: None where there is no way.
        gap_s: how much quicker it could be at most; 0: it is the optimum.
        length_m: of its polyline.
        via: its corners, mission frame.
        limits: what it keeps to.
    """

    time_s: float | None
    gap_s: float
    length_m: float
    via: tuple[Vec2, ...]
    limits: MotionLimits


def limits_of(scenario: Scenario) -> MotionLimits:
    """The limits of a scenario as its flights keep to them."""
    flying, px4 = scenario.vehicle.flying, scenario.vehicle.px4
    tilt = math.degrees(math.atan2(flying.acceleration_m_s2, GRAVITY_M_S2))
    speed = scenario.limits.speed_m_s
    if scenario.limits.acceleration_m_s2 is None:
        speed = min(speed, flying.transit_speed_m_s)
    return MotionLimits(
        _SPEED_USED * speed, flying.acceleration_m_s2, flying.jerk_m_s3, min(tilt, px4.mpc_tiltmax_air)
    )


def plan_free(scenario: Scenario) -> FreePlan:
    """The free plan of a scenario.

    Raises:
        InputError: Ruckig is not installed.
    """
    limits = limits_of(scenario)
    among, goal = Obstacles.of(scenario), scenario.goal.position_m
    corners = shortest_path(scenario.start, goal, among)
    if corners is None:
        return FreePlan(None, 0.0, 0.0, (), limits)
    length = sum(distance2(a, b) for a, b in itertools.pairwise(corners))
    least_s = straight_time_s(least_length_m(scenario.start, goal, among), limits)
    time_s = least_s if len(corners) == 2 else _round_s(scenario, corners, among, limits)
    gap_s = 0.0 if time_s is None else time_s - least_s
    return FreePlan(time_s, gap_s, length, tuple(corners[1:-1]), limits)


def _round_s(scenario: Scenario, corners: list[Vec2], among: Obstacles, limits: MotionLimits) -> float | None:
    """The quickest past the corners; None where the solver finds no way."""
    goal = scenario.goal.position_m
    parts = [Part(RouteCorner(b), regions(a, b, among)) for a, b in itertools.pairwise(corners)]
    parts[-1] = parts[-1]._replace(to=None)
    found = solve(Problem(scenario.vehicle, scenario.start, goal, tuple(parts), limits, _NO_HITS, 0.0))
    return None if found is None else found.time_s


def straight_time_s(length_m: float, limits: MotionLimits) -> float:
    """The shortest time over a straight way from rest to rest.

    Raises:
        InputError: Ruckig is not installed.
    """
    return _leg_s((0.0,), (0.0,), (length_m,), (0.0,), limits, 1.0)


def rest_at_s(place: Vec2, velocity: Vec2, goal: Vec2, limits: MotionLimits) -> float:
    """Time from passing a goal at some velocity until the vehicle rests there.

    The limits are split between the axes, against the colliding plan. A speed above them is taken as them.
    """
    speed = math.hypot(*velocity)
    most = _AXIS * limits.speed_m_s
    slower = min(1.0, most / speed) if speed > 0.0 else 1.0
    vx, vy = velocity
    return _leg_s(place, (slower * vx, slower * vy), goal, (0.0, 0.0), limits, _AXIS)


def _leg_s(
    begin: Sequence[float],
    v_begin: Sequence[float],
    end: Sequence[float],
    v_end: Sequence[float],
    limits: MotionLimits,
    share: float,
) -> float:
    """Shortest time between two states without acceleration, seconds; infinite where there is none."""
    try:
        import ruckig  # noqa: PLC0415  (an extra)
    except ImportError:
        raise missing_package("the free plan needs ruckig", "plan") from None
    count = len(begin)
    wanted = ruckig.InputParameter(count)
    wanted.current_position, wanted.current_velocity = list(begin), list(v_begin)
    wanted.target_position, wanted.target_velocity = list(end), list(v_end)
    wanted.max_velocity = [share * limits.speed_m_s] * count
    wanted.max_acceleration = [share * limits.acceleration_m_s2] * count
    if limits.jerk_m_s3 is not None:
        wanted.max_jerk = [share * limits.jerk_m_s3] * count
    found = ruckig.Trajectory(count)
    try:
        result = ruckig.Ruckig(count).calculate(wanted, found)
    except ruckig.RuckigError:
        return math.inf
    return float(found.duration) if result in (ruckig.Result.Working, ruckig.Result.Finished) else math.inf
