"""Approaches to walls: straight runs with smooth speed, probes, and checks of their free space.

A reference is position, velocity and acceleration in the mission frame as functions of time. PX4 receives the
reference as feed-forward, so PX4's P-PID cascade only corrects errors.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

from dart_flight.base.arithmetic import Number, hypot, maximum, sqrt, where
from dart_flight.base.geometry import Vec2, Vec3, distance2
from dart_flight.base.walls import Post, Wall
from dart_flight.config.mission import Collision, Mission
from dart_flight.config.mission_file import TrajectoryPieces
from dart_flight.config.probes import Probe
from dart_flight.config.vehicle import Flying
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.core.mission.wall_uncertainty import position_margin_m, spans_with_margin

# Speed follows 3 s^2 - 2 s^3: the peak acceleration is 1.5 times the mean, and the length is half the final
# speed times the duration.
PEAK_OVER_MEAN = 1.5
_RAMP_JERK = 6.0  # peak jerk = 6 speed / duration^2
CLEARANCE_M = 0.15
ON_PLANE_M = 1e-6  # rounding tolerance of an impact on its wall's plane
_TRAJECTORY_STEP_S = 0.02  # sampling step of trajectories; too short to pass through a wall unnoticed
_ON_RAY_M = 1e-6  # a start within this distance counts as on the ray of its approach


class NoApproachError(ValueError):
    """Error: there is no room for a run-up, or an obstacle blocks it."""


class RunUp(NamedTuple):
    """An approach: begin, direction, speed and duration of the ramp, as numbers or arrays."""

    begin: tuple[Number, Number]
    direction: tuple[Number, Number]
    speed_m_s: Number
    ramp_s: Number


def run_up(
    start: Vec2,
    impact: tuple[Number, Number],
    velocity: tuple[Number, Number],
    flying: Flying,
    wall: Wall,
) -> RunUp:
    """Return the run-up to an impact on the wall's plane; `velocity` is in the mission frame.

    The approach follows a ray that ends at the impact. If the mission's start lies on this ray and is far
    enough from the wall, the run-up begins there. Otherwise the run-up begins on the ray, as far from the
    wall as acceleration and steady run require. This distance counts from a plane that lies three standard
    deviations in front of the wall.
    """
    vx, vy = velocity
    speed = hypot(vx, vy)
    direction = (vx / speed, vy / speed)
    ramp_s = PEAK_OVER_MEAN * speed / flying.acceleration_m_s2
    if flying.jerk_m_s3 is not None:
        ramp_s = maximum(ramp_s, sqrt(_RAMP_JERK * speed / flying.jerk_m_s3))
    closing = -(vx * wall.normal[0] + vy * wall.normal[1])
    nearer_m = position_margin_m(wall, impact) * speed / closing
    needed = 0.5 * speed * ramp_s + speed * flying.steady_run_s + nearer_m
    from_start = hypot(start[0] - impact[0], start[1] - impact[1])
    ray_end = (start[0] + direction[0] * from_start, start[1] + direction[1] * from_start)
    on_ray = hypot(ray_end[0] - impact[0], ray_end[1] - impact[1]) < _ON_RAY_M
    from_there = (from_start >= needed) & on_ray
    begin = (
        where(from_there, start[0], impact[0] - direction[0] * needed),
        where(from_there, start[1], impact[1] - direction[1] * needed),
    )
    return RunUp(begin, direction, speed, ramp_s)


def impact_time_s(length_m: Number, speed_m_s: Number, ramp_s: Number) -> Number:
    return ramp_s + (length_m - 0.5 * speed_m_s * ramp_s) / speed_m_s


def is_blocked(
    wall: Wall,
    a: tuple[Number, Number],
    b: tuple[Number, Number],
    end_clearance_m: float = CLEARANCE_M,
    begin_clearance_m: float = CLEARANCE_M,
) -> Number:
    """Return whether a segment crosses a wall, or begins too close to the wall's plane.

    A segment that passes the wall's end must keep the distance `end_margin_m` from this end.
    `end_clearance_m` and `begin_clearance_m` are the required distances of `b` and `a` from the plane.
    """
    crosses, place = wall.crossing(a, b, begin_clearance_m, end_clearance_m)
    too_close = abs(wall.signed_distance(a)) < begin_clearance_m
    return (crosses | too_close) & spans_with_margin(wall, place)


def is_blocked_by_post(mission: Mission, post: Post, a: Vec2, b: Vec2) -> bool:
    """Return whether a segment is too close to a post for a vehicle with any heading."""
    return post.distance_to_segment(a, b) < post.radius_m + mission.vehicle.airframe.corner_m + CLEARANCE_M


def segments_to_impact(
    start: Vec2, begin: tuple[Number, Number], impact: tuple[Number, Number], wall: Wall, first: bool
) -> Callable[[Wall], list[tuple[tuple[Number, Number], tuple[Number, Number], float]]]:
    """Return a function that lists the segments before an impact; no obstacle may block these segments.

    The function's argument is the obstacle, a wall. Each segment is (a, b, required clearance at b).

    Args:
        start: previous resting position, from which the vehicle flies to the run-up point.
        begin, impact: ends of the run-up.
        wall: the wall to be hit; the run-up ends on its plane.
        first: whether `start` is known; if so, the segment from `start` is listed too.
    """

    def against(other: Wall) -> list[tuple[tuple[Number, Number], tuple[Number, Number], float]]:
        legs = [(begin, impact, -ON_PLANE_M if other == wall else CLEARANCE_M)]
        return [*legs, (start, begin, CLEARANCE_M)] if first else legs

    return against


def plan_approach(mission: Mission, collision: Collision) -> Trajectory:
    """Return the approach of a collision: the mission's trajectory, a probe, or a run-up.

    The approach ends at the impact. A probe ends where the vehicle stops searching for the wall. If the
    run-up leaves the bounds or an obstacle blocks the run-up, raise NoApproachError.
    """
    assert collision.impact_point is not None
    altitude_m = mission.altitude_at(collision.index - 1)
    if collision.probe is not None:
        approach = _probe_trajectory(mission, collision.probe, altitude_m)
    elif collision.trajectory is not None:
        return Trajectory.from_mission(collision.trajectory, altitude_m)
    else:
        vx, vy, _ = collision.approach_velocity()
        begin, direction, speed, ramp_s = run_up(
            mission.start, collision.impact_point, (vx, vy), mission.vehicle.flying, collision.wall
        )
        steady_s = impact_time_s(distance2(begin, collision.impact_point), speed, ramp_s) - ramp_s
        velocity = (speed * direction[0], speed * direction[1])
        approach = Trajectory.run_up(begin, velocity, ramp_s, steady_s, altitude_m)
    _check_room(mission, collision, approach.begin[:2])
    return approach


def _probe_trajectory(mission: Mission, probe: Probe, altitude_m: float) -> Trajectory:
    """Return a leg from rest to rest at the probe's speed; both ends have the speed ramp of a run-up."""
    way_m = distance2(probe.begin, probe.end)
    a_m_s2 = mission.vehicle.flying.acceleration_m_s2
    speed = min(probe.speed_m_s, math.sqrt(way_m * a_m_s2 / PEAK_OVER_MEAN))
    ramp_s = PEAK_OVER_MEAN * speed / a_m_s2
    steady_s = max(1e-3, way_m / speed - ramp_s)
    # Coefficients of the third and fourth power of time.
    up, down = speed / ramp_s**2, -0.5 * speed / ramp_s**3
    parts = (
        (0.0, 0.0, 0.0, up, down, 0.0),
        (0.5 * speed * ramp_s, speed, 0.0, 0.0, 0.0, 0.0),
        (way_m - 0.5 * speed * ramp_s, speed, 0.0, -up, -down, 0.0),
    )
    axes = []
    for begin, end in zip(probe.begin, probe.end, strict=True):
        d = (end - begin) / way_m
        axes.append(tuple(begin * (k == 0) + d * c for piece in parts for k, c in enumerate(piece)))
    return Trajectory.level(axes[0], axes[1], altitude_m, (ramp_s, steady_s, ramp_s))


def _check_room(mission: Mission, collision: Collision, begin: Vec2) -> None:
    impact = collision.impact_point
    assert impact is not None
    excess = mission.bounds.excess2(begin)
    if excess > 0.0:
        speed_m_s = math.hypot(*collision.approach_velocity())
        raise NoApproachError(
            f"the run-up to wall {collision.wall.name} at {speed_m_s:.2f} m/s starts at "
            f"({begin[0]:.2f}, {begin[1]:.2f}), {excess:.2f} m outside bounds_m; lower the approach speed, "
            "move the impact along the wall, or move start back along the line of the approach"
        )
    excess = mission.bounds.excess2(impact)
    if excess > 0.0:
        raise NoApproachError(
            f"the impact at ({impact[0]:.2f}, {impact[1]:.2f}) is {excess:.2f} m outside bounds_m"
        )
    before = mission.place_before(collision.index - 1)
    legs = segments_to_impact(before or mission.start, begin, impact, collision.wall, before is not None)
    for wall in mission.walls:
        if any(is_blocked(wall, *leg) for leg in legs(wall)):
            raise NoApproachError(f"wall {wall.name} blocks the run-up")
    for post in mission.posts:
        if post.name != collision.wall.name and is_blocked_by_post(mission, post, begin, impact):
            raise NoApproachError(f"post {post.name} blocks the run-up")
        if before is not None and is_blocked_by_post(mission, post, before, begin):
            raise NoApproachError(f"post {post.name} blocks the path to the run-up")


class TransitSegment(NamedTuple):
    """A straight segment from rest to rest that the mission file specifies.

    Attributes:
        name: description of the segment's end.
        begin: mission frame, metres; None if the segment begins where a recovery ends.
        end: mission frame, metres.
        speed_m_s: largest speed.
    """

    name: str
    begin: Vec3 | None
    end: Vec3
    speed_m_s: float


def transit_segments(mission: Mission) -> list[TransitSegment]:
    """Return the segments to the waypoints, and to the goal if no recovery or trajectory leads there."""
    found: list[TransitSegment] = []
    here: Vec3 | None = (*mission.start, mission.altitude_m)
    flown = 0
    for waypoint in mission.waypoints:
        if waypoint.after != flown:
            here, flown = None, waypoint.after
        if waypoint.position is not None:
            found.append(TransitSegment(waypoint.name, here, waypoint.position, waypoint.speed_m_s))
            here = waypoint.position
    if not mission.recovers_to_goal and mission.goal_trajectory is None:
        goal = (*mission.goal.position_m, mission.altitude_at(len(mission.collisions)))
        begin = here if flown == len(mission.collisions) else None
        found.append(TransitSegment("the goal", begin, goal, mission.vehicle.flying.transit_speed_m_s))
    return found


def plan_transit(mission: Mission, leg: TransitSegment, begin: Vec3) -> Trajectory:
    flying = mission.vehicle.flying
    return Trajectory.rest_to_rest(begin, leg.end, leg.speed_m_s, flying, flying.climb_speed_m_s)


def check_segments_clear(mission: Mission) -> None:
    """Raise NoApproachError if a wall blocks a leg with known ends, or a trajectory leaves the bounds."""
    for collision in mission.collisions:
        if collision.trajectory is not None:
            _check_trajectory_clear(mission, collision.trajectory, f"wall {collision.wall.name}")
    if mission.goal_trajectory is not None:
        _check_trajectory_clear(mission, mission.goal_trajectory, "the goal")
    for leg in transit_segments(mission):
        for wall in mission.walls:
            if leg.begin is not None and is_blocked(wall, leg.begin[:2], leg.end[:2]):
                raise NoApproachError(f"wall {wall.name} blocks the path to {leg.name}")
        for post in mission.posts:
            if leg.begin is not None and is_blocked_by_post(mission, post, leg.begin[:2], leg.end[:2]):
                raise NoApproachError(f"post {post.name} blocks the path to {leg.name}")


def _check_trajectory_clear(mission: Mission, written: TrajectoryPieces, leads_to: str) -> None:
    trajectory = Trajectory.from_mission(written, mission.altitude_m)
    count = max(2, math.ceil(trajectory.duration_s / _TRAJECTORY_STEP_S))
    places = [trajectory.at(trajectory.duration_s * k / count).position[:2] for k in range(count + 1)]
    for a, b in itertools.pairwise(places):
        excess = mission.bounds.excess2(b)
        if excess > 0.0:
            raise NoApproachError(f"the trajectory to {leads_to} leads {excess:.2f} m outside bounds_m")
        for wall in mission.flat_walls:
            # A trajectory after a contact begins slightly behind the plane of the wall.
            if wall.signed_distance(a) >= 0.0 > wall.signed_distance(b) and wall.end_distance_m(b) > 0.0:
                raise NoApproachError(f"wall {wall.name} blocks the trajectory to {leads_to}")


def standoff_point(mission: Mission, collision: Collision, begin: Vec2, impact: Vec2) -> Vec2:
    """Return the stopping point of a rehearsal: on the line to the impact, `standoff_m` before the plane.

    The distance counts from a plane that lies three standard deviations in front of the wall.
    """
    standoff = (mission.standoff_m or 0.0) + float(position_margin_m(collision.wall, impact))
    here, there = collision.wall.signed_distance(begin), collision.wall.signed_distance(impact)
    if here - there < 1e-6 or here <= standoff:
        return begin
    share = (here - standoff) / (here - there)
    return (begin[0] + share * (impact[0] - begin[0]), begin[1] + share * (impact[1] - begin[1]))
