"""References that the vehicle follows between contacts: straight runs with smooth speed.

A reference is position, velocity and acceleration in the mission frame as functions of time, fed forward to
PX4 so that its P-PID cascade has only errors to remove.
"""

from __future__ import annotations

import math

import msgspec

from dart_flight.config.mission import Collision, Mission
from dart_flight.config.vehicle import Flying
from dart_flight.geometry import Vec2, Vec3, distance2

# Speed follows 3 s^2 - 2 s^3: the peak acceleration is 1.5 times the mean, the way half of speed times time.
PEAK_OVER_MEAN = 1.5
CLEARANCE_M = 0.15
ON_PLANE_M = 1e-6  # an impact lies on its wall's plane but for rounding


class ReferencePoint(msgspec.Struct, frozen=True, gc=False):
    """Position (m), velocity (m/s), acceleration (m/s2) and jerk (m/s3) in the mission frame."""

    position: Vec3
    velocity: Vec3
    acceleration: Vec3
    jerk: Vec3 = (0.0, 0.0, 0.0)


class Approach(msgspec.Struct, frozen=True):
    """Run-up and constant-velocity approach to the point of impact.

    Attributes:
        begin: run-up point, at rest.
        impact: where the vehicle's centre meets the plane.
        direction: unit vector from begin to impact.
        speed_m_s: speed at the impact.
        ramp_s: duration of the acceleration from rest.
        altitude_m: constant height.
    """

    begin: Vec2
    impact: Vec2
    direction: Vec2
    speed_m_s: float
    ramp_s: float
    altitude_m: float

    @property
    def length_m(self) -> float:
        """Way from the run-up point to the plane."""
        return distance2(self.begin, self.impact)

    @property
    def impact_s(self) -> float:
        """Time of the impact after the start of the run-up."""
        return self.ramp_s + (self.length_m - 0.5 * self.speed_m_s * self.ramp_s) / self.speed_m_s

    def at(self, t_s: float) -> ReferencePoint:
        """The reference `t_s` seconds after the start of the run-up; it goes on through the wall."""
        tau = max(0.0, min(1.0, t_s / self.ramp_s))
        v, big = self.speed_m_s, self.ramp_s
        speed = v * tau * tau * (3.0 - 2.0 * tau)
        acceleration = v / big * 6.0 * tau * (1.0 - tau)
        jerk = v / (big * big) * 6.0 * (1.0 - 2.0 * tau) if 0.0 <= t_s <= big else 0.0
        way = v * big * tau * tau * tau * (1.0 - 0.5 * tau) + v * max(0.0, t_s - big)
        dx, dy = self.direction
        return ReferencePoint(
            (self.begin[0] + dx * way, self.begin[1] + dy * way, self.altitude_m),
            (dx * speed, dy * speed, 0.0),
            (dx * acceleration, dy * acceleration, 0.0),
            (dx * jerk, dy * jerk, 0.0),
        )


class NoApproachError(ValueError):
    """There is no room for the run-up, or something is in its way."""


def plan_approach(mission: Mission, collision: Collision) -> Approach:
    """The run-up and approach of a collision that has one.

    The run-up starts at the mission's start where that lies on the ray and is far enough from the wall,
    otherwise as far back along the ray as the acceleration and the steady run need.

    Raises:
        NoApproachError: the run-up leaves the bounds, or a wall is in its way.
    """
    assert collision.approach_m_s is not None
    assert collision.impact_point is not None
    flying = mission.vehicle.flying
    velocity = collision.approach_velocity()
    speed = math.hypot(velocity[0], velocity[1])
    direction = (velocity[0] / speed, velocity[1] / speed)
    ramp_s = PEAK_OVER_MEAN * speed / flying.acceleration_m_s2
    needed = 0.5 * speed * ramp_s + speed * flying.steady_run_s
    impact = collision.impact_point
    from_start = distance2(mission.start, impact)
    ray_end = (mission.start[0] + direction[0] * from_start, mission.start[1] + direction[1] * from_start)
    if from_start >= needed and distance2(ray_end, impact) < 1e-6:
        begin = mission.start
    else:
        begin = (impact[0] - direction[0] * needed, impact[1] - direction[1] * needed)
    approach = Approach(begin, impact, direction, speed, ramp_s, mission.altitude_m)
    _check_room(mission, collision, approach)
    return approach


def _check_room(mission: Mission, collision: Collision, approach: Approach) -> None:
    begin = approach.begin
    excess = mission.bounds.excess2(begin)
    if excess > 0.0:
        raise NoApproachError(
            f"the run-up to wall {collision.wall.name} at {approach.speed_m_s:.2f} m/s starts at "
            f"({begin[0]:.2f}, {begin[1]:.2f}), {excess:.2f} m outside bounds_m; approach slower or from "
            "further along the wall, or move start back along the ray"
        )
    excess = mission.bounds.excess2(approach.impact)
    if excess > 0.0:
        raise NoApproachError(
            f"the impact at ({approach.impact[0]:.2f}, {approach.impact[1]:.2f}) is {excess:.2f} m outside "
            "bounds_m"
        )
    legs: list[tuple[Vec2, Vec2]] = [(begin, approach.impact)]
    if collision.index == 1:
        legs.append((mission.start, begin))
    for wall in mission.walls:
        for a, b in legs:
            end_clearance = -ON_PLANE_M if wall == collision.wall and b == approach.impact else CLEARANCE_M
            da, db = wall.signed_distance(a) - CLEARANCE_M, wall.signed_distance(b) - end_clearance
            if da * db < 0.0 or (da < 0.0 and wall.signed_distance(a) > -CLEARANCE_M):
                share = da / (da - db) if da != db else 0.0
                crossing = (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]))
                if wall.spans(crossing):
                    raise NoApproachError(f"wall {wall.name} is in the way of the run-up")


def stop_before(mission: Mission, collision: Collision, begin: Vec2, impact: Vec2) -> Vec2:
    """Where a rehearsal stops: on the line from `begin` to `impact`, `standoff_m` before the wall's plane."""
    standoff = mission.standoff_m or 0.0
    here, there = collision.wall.signed_distance(begin), collision.wall.signed_distance(impact)
    if here - there < 1e-6 or here <= standoff:
        return begin
    share = (here - standoff) / (here - there)
    return (begin[0] + share * (impact[0] - begin[0]), begin[1] + share * (impact[1] - begin[1]))


class Transit(msgspec.Struct, frozen=True):
    """Straight flight from rest to rest at a limited speed and acceleration."""

    begin: Vec3
    end: Vec3
    duration_s: float

    @classmethod
    def between(cls, begin: Vec3, end: Vec3, speed_m_s: float, acceleration_m_s2: float) -> Transit:
        """The quickest smooth transit within the limits."""
        way = math.dist(begin, end)
        # Quintic rest-to-rest: peak speed 1.875 way/T, peak acceleration 5.774 way/T^2.
        duration = max(1.875 * way / speed_m_s, math.sqrt(5.774 * way / acceleration_m_s2), 0.1)
        return cls(begin, end, duration)

    def at(self, t_s: float) -> ReferencePoint:
        """The reference `t_s` seconds after the start; it stays at the end."""
        big = self.duration_s
        s = max(0.0, min(1.0, t_s / big))
        way = s * s * s * (10.0 + s * (-15.0 + 6.0 * s))
        speed = 30.0 * s * s * (1.0 - s) * (1.0 - s) / big
        acceleration = 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / (big * big)
        d = (self.end[0] - self.begin[0], self.end[1] - self.begin[1], self.end[2] - self.begin[2])
        b = self.begin
        return ReferencePoint(
            (b[0] + d[0] * way, b[1] + d[1] * way, b[2] + d[2] * way),
            (d[0] * speed, d[1] * speed, d[2] * speed),
            (d[0] * acceleration, d[1] * acceleration, d[2] * acceleration),
        )


def transit_to(begin: Vec3, end: Vec3, flying: Flying) -> Transit:
    """A transit within the configured speed and acceleration."""
    return Transit.between(begin, end, flying.transit_speed_m_s, flying.acceleration_m_s2)
