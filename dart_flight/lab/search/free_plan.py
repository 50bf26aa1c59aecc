"""The flight without a collision, as quick as the same limits allow: what a colliding plan has to beat.

Along a straight way the time is the optimum, from Ruckig (time-optimal with bounded speed, acceleration and
jerk). Round walls the way is the shortest polyline past their ends, flown through its corners at the best
velocities found, each leg again by Ruckig with the limits split between its two axes; how much of that time
may be in vain is told: `gap_s`, its time less that of the straightened polyline, which nothing beats.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Iterator, Sequence

import msgspec

from dart_flight.base.geometry import GRAVITY_M_S2, Vec2, distance2
from dart_flight.config.document import InputError
from dart_flight.core.mission.approach import CLEARANCE_M, is_blocked
from dart_flight.core.mission.wall_uncertainty import end_margin_m
from dart_flight.lab.search.scenario import Scenario

_AXIS = math.sqrt(0.5)  # of a limit on a vector's length, for each of two axes
_SPEEDS = 12  # tried at a corner, up to the limit
_TURNS_DEG = (-20.0, 0.0, 20.0)  # of the velocity at a corner, from the bisector
_SWEEPS = 3  # over all corners
_PAST_END_M = 0.01  # beyond the margin, so that a way along it is no way through


class MotionLimits(msgspec.Struct, frozen=True):
    """What a trajectory keeps to; `jerk_m_s3` None: any."""

    speed_m_s: float
    acceleration_m_s2: float
    jerk_m_s3: float | None
    tilt_deg: float


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
    return MotionLimits(speed, flying.acceleration_m_s2, flying.jerk_m_s3, min(tilt, px4.mpc_tiltmax_air))


def plan_free(scenario: Scenario) -> FreePlan:
    """The free plan of a scenario.

    Raises:
        InputError: Ruckig is not installed.
    """
    limits = limits_of(scenario)
    corners = _shortest_way(scenario)
    if corners is None:
        return FreePlan(None, 0.0, 0.0, (), limits)
    length = sum(distance2(a, b) for a, b in itertools.pairwise(corners))
    least_s = straight_time_s(length, limits)
    time_s = least_s if len(corners) == 2 else _through(corners, limits)
    return FreePlan(time_s, time_s - least_s, length, tuple(corners[1:-1]), limits)


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
        raise InputError("the free plan needs ruckig: pip install 'dart-flight[plan]'") from None
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


def _through(corners: Sequence[Vec2], limits: MotionLimits) -> float:
    """Time through all corners at the best velocities there that a coarse search finds, one at a time."""
    velocities: list[Vec2] = [(0.0, 0.0)] * len(corners)

    def leg(k: int) -> float:
        return _leg_s(corners[k], velocities[k], corners[k + 1], velocities[k + 1], limits, _AXIS)

    for _ in range(_SWEEPS):
        for k in range(1, len(corners) - 1):
            tried = []
            for velocity in _corner_velocities(corners[k - 1], corners[k], corners[k + 1], limits):
                velocities[k] = velocity
                tried.append((leg(k - 1) + leg(k), velocity))
            velocities[k] = min(tried)[1]
    return sum(leg(k) for k in range(len(corners) - 1))


def _corner_velocities(a: Vec2, b: Vec2, c: Vec2, limits: MotionLimits) -> Iterator[Vec2]:
    before, after = math.atan2(b[1] - a[1], b[0] - a[0]), math.atan2(c[1] - b[1], c[0] - b[0])
    half = 0.5 * math.remainder(after - before, math.tau)
    for k, turn in itertools.product(range(_SPEEDS), _TURNS_DEG):
        speed, heading = _AXIS * limits.speed_m_s * k / _SPEEDS, before + half + math.radians(turn)
        yield (speed * math.cos(heading), speed * math.sin(heading))


def _shortest_way(scenario: Scenario) -> list[Vec2] | None:
    """Corners of the shortest way from start to goal past the ends of walls; None: there is none."""
    walls, bounds = list(scenario.walls.values()), scenario.bounds
    places: list[Vec2] = [scenario.start, scenario.goal.position_m]
    for wall in walls:
        (tx, ty), (nx, ny), reach = wall.tangent, wall.normal, 0.5 * wall.length_m
        # Round an end by a corner before the wall or behind it, as far from its plane as a way keeps.
        for side, face in itertools.product((-1.0, 1.0), (-1.0, 1.0)):
            end = (wall.point[0] + side * reach * tx, wall.point[1] + side * reach * ty)
            past, off = side * (end_margin_m(wall, end) + _PAST_END_M), face * (CLEARANCE_M + _PAST_END_M)
            x, y = end[0] + past * tx + off * nx, end[1] + past * ty + off * ny
            if bounds.x[0] <= x <= bounds.x[1] and bounds.y[0] <= y <= bounds.y[1]:
                places.append((x, y))
    best, queue = {0: 0.0}, [(0.0, 0)]
    came: dict[int, int] = {}
    while queue:
        length, here = heapq.heappop(queue)
        if here == 1:
            break
        for there in range(1, len(places)):
            a, b = places[here], places[there]
            further = length + distance2(a, b)
            if further < best.get(there, math.inf) and not any(is_blocked(w, a, b) for w in walls):
                best[there], came[there] = further, here
                heapq.heappush(queue, (further, there))
    if 1 not in came:
        return None
    way = [1]
    while way[-1] != 0:
        way.append(came[way[-1]])
    return [places[k] for k in reversed(way)]
