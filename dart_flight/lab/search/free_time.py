"""The time of the fastest flight without a collision, for comparison with colliding plans.

Along a straight line, Ruckig finds the optimum (time-optimal with bounded speed, acceleration and jerk).
Around walls, the plan is the fastest flight past the corners of the shortest polyline (`optimal_trajectory`).
A straight flight over the length of the shortest path around the walls gives a lower bound on this time.
`gap_s` is the plan's time minus this lower bound.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

from dart_flight.base.geometry import Vec2, distance2
from dart_flight.config.packages import missing_package
from dart_flight.lab.search.optimal_trajectory import HitLimits, Part, Problem, RouteCorner, solve
from dart_flight.lab.search.plan import FreeTime, MotionLimits
from dart_flight.lab.search.routes import Obstacles, least_length_m, regions, shortest_path
from dart_flight.lab.search.scenario import Scenario

_AXIS = math.sqrt(0.5)  # fraction of a vector's limit available to each of two axes
_NO_HITS = HitLimits(math.inf, None, None, None, 0.0)


def least_free_time(scenario: Scenario) -> FreeTime:
    limits = MotionLimits.from_scenario(scenario)
    obstacles, goal = Obstacles.from_scenario(scenario), scenario.goal.position_m
    corners = shortest_path(scenario.start, goal, obstacles)
    if corners is None:
        return FreeTime(None, 0.0, 0.0, (), limits)
    length = sum(distance2(a, b) for a, b in itertools.pairwise(corners))
    least_s = straight_time_s(least_length_m(scenario.start, goal, obstacles), limits)
    time_s = least_s if len(corners) == 2 else _time_past_corners_s(scenario, corners, obstacles, limits)
    gap_s = 0.0 if time_s is None else time_s - least_s
    return FreeTime(time_s, gap_s, length, tuple(corners[1:-1]), limits)


def _time_past_corners_s(
    scenario: Scenario, corners: list[Vec2], obstacles: Obstacles, limits: MotionLimits
) -> float | None:
    """Return the shortest time past the corners; None if the solver fails."""
    goal = scenario.goal.position_m
    parts = [Part(RouteCorner(b), regions(a, b, obstacles)) for a, b in itertools.pairwise(corners)]
    parts[-1] = parts[-1]._replace(to=None)
    found = solve(Problem(scenario.vehicle, scenario.start, goal, tuple(parts), limits, _NO_HITS, 0.0))
    return None if found is None else found.time_to_goal_s


def straight_time_s(length_m: float, limits: MotionLimits) -> float:
    """Return the shortest time along a straight line from rest to rest."""
    return _leg_s((0.0,), (0.0,), (length_m,), (0.0,), limits, 1.0)


def rest_at_s(place: Vec2, velocity: Vec2, goal: Vec2, limits: MotionLimits) -> float:
    """Return the time from passing a goal at some velocity until the vehicle rests at the goal.

    Each axis gets 1/sqrt(2) of the limits, so that the total stays within the limits. The result may
    therefore be too long, but is never too short. A velocity above the speed limit is reduced to the limit.
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
    """Return the shortest time between two states with zero acceleration; infinite if no motion is found."""
    try:
        import ruckig  # noqa: PLC0415  (an extra)
    except ImportError:
        raise missing_package("the plan without a collision needs ruckig", "plan") from None
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
