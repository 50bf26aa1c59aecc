"""Trajectories that are flown as references: position, velocity, acceleration and jerk as functions of time.

They are fed forward to PX4, so that its P-PID cascade has only errors to remove.
"""

from __future__ import annotations

import math

import msgspec

from dart_flight.base.geometry import Vec3
from dart_flight.config.mission_file import TrajectoryPieces
from dart_flight.config.vehicle import Flying
from dart_flight.core.mission.arithmetic import Number, maximum, sqrt

_MIN_TRANSIT_S = 0.1


class TrajectoryPoint(msgspec.Struct, frozen=True, gc=False):
    """Position (m), velocity (m/s), acceleration (m/s2) and jerk (m/s3) in the mission frame."""

    position: Vec3
    velocity: Vec3
    acceleration: Vec3
    jerk: Vec3 = (0.0, 0.0, 0.0)


def transit_time_s(
    way_m: Number, speed_m_s: float, acceleration_m_s2: float, jerk_m_s3: float | None = None
) -> Number:
    """Of the quickest smooth flight from rest to rest over a distance within the limits.

    Quintic over d: peak speed 1.875 d/T, peak acceleration 5.774 d/T^2, peak jerk 60 d/T^3.
    """
    time_s = maximum(1.875 * way_m / speed_m_s, sqrt(5.774 * way_m / acceleration_m_s2))
    if jerk_m_s3 is None:
        return time_s
    return maximum(time_s, (60.0 * way_m / jerk_m_s3) ** (1.0 / 3.0))


class TransitTrajectory(msgspec.Struct, frozen=True):
    """Straight flight from rest to rest at a limited speed and acceleration."""

    begin: Vec3
    end: Vec3
    duration_s: float

    @classmethod
    def between(
        cls,
        begin: Vec3,
        end: Vec3,
        speed_m_s: float,
        flying: Flying,
        climb_speed_m_s: float = math.inf,
    ) -> TransitTrajectory:
        """The quickest smooth transit within the limits, of which one is on its vertical part."""
        distance_m, acceleration_m_s2 = math.dist(begin, end), flying.acceleration_m_s2
        duration = transit_time_s(distance_m, speed_m_s, acceleration_m_s2, flying.jerk_m_s3)
        climb = abs(end[2] - begin[2])
        if climb > 0.0:
            duration = max(duration, transit_time_s(climb, climb_speed_m_s, acceleration_m_s2))
        return cls(begin, end, max(duration, _MIN_TRANSIT_S))

    def at(self, t_s: float) -> TrajectoryPoint:
        """The reference `t_s` seconds after the start; it stays at the end."""
        big = self.duration_s
        s = max(0.0, min(1.0, t_s / big))
        share = s * s * s * (10.0 + s * (-15.0 + 6.0 * s))
        speed = 30.0 * s * s * (1.0 - s) * (1.0 - s) / big
        acceleration = 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / (big * big)
        d = (self.end[0] - self.begin[0], self.end[1] - self.begin[1], self.end[2] - self.begin[2])
        b = self.begin
        return TrajectoryPoint(
            (b[0] + d[0] * share, b[1] + d[1] * share, b[2] + d[2] * share),
            (d[0] * speed, d[1] * speed, d[2] * speed),
            (d[0] * acceleration, d[1] * acceleration, d[2] * acceleration),
        )


class PlannedTrajectory(msgspec.Struct, frozen=True):
    """A trajectory of polynomials of fifth order per axis, one after the other, then straight on or at rest.

    Planned in flight, or written in the mission (`from_pieces`).

    Attributes:
        x, y: coefficients in the seconds since a polynomial's beginning, constant term first, six for each;
            mission frame, metres.
        duration_s: of all polynomials; afterwards the velocity of their end is kept.
        altitude_m: constant height.
        pieces_s: duration of each, where there are several.
    """

    x: tuple[float, ...]
    y: tuple[float, ...]
    duration_s: float
    altitude_m: float
    pieces_s: tuple[float, ...] = ()

    @classmethod
    def from_pieces(cls, written: TrajectoryPieces, altitude_m: float) -> PlannedTrajectory:
        """A trajectory as a mission file says it: constant jerk in each piece."""
        xs: list[float] = []
        ys: list[float] = []
        for (_, (x, y), (vx, vy), (ax, ay)), (_, jx, jy) in zip(
            written.states(), written.pieces, strict=False
        ):
            xs += (x, vx, 0.5 * ax, jx / 6.0, 0.0, 0.0)
            ys += (y, vy, 0.5 * ay, jy / 6.0, 0.0, 0.0)
        durations = tuple(piece[0] for piece in written.pieces)
        return cls(tuple(xs), tuple(ys), written.duration_s, altitude_m, durations)

    def at(self, t_s: float) -> TrajectoryPoint:
        """The reference `t_s` seconds after the beginning."""
        inside = max(0.0, min(t_s, self.duration_s))
        first, since = self._piece_at(inside)
        x, y = self.x[first : first + 6], self.y[first : first + 6]
        (px, vx, ax, jx), (py, vy, ay, jy) = _derivatives(x, since), _derivatives(y, since)
        beyond = max(0.0, t_s - self.duration_s)
        if beyond > 0.0:
            ax = ay = jx = jy = 0.0
        return TrajectoryPoint(
            (px + vx * beyond, py + vy * beyond, self.altitude_m),
            (vx, vy, 0.0),
            (ax, ay, 0.0),
            (jx, jy, 0.0),
        )

    def _piece_at(self, t_s: float) -> tuple[int, float]:
        """The first coefficient of the polynomial that holds at a time, and the time since its beginning."""
        begin = 0.0
        for i, duration in enumerate(self.pieces_s[:-1]):
            if t_s < begin + duration:
                return 6 * i, t_s - begin
            begin += duration
        return 6 * max(0, len(self.pieces_s) - 1), t_s - begin


def _derivatives(coefficients: tuple[float, ...], t: float) -> tuple[float, float, float, float]:
    """A polynomial and its first three derivatives, by Horner's scheme."""
    value = slope = half = sixth = 0.0
    for c in reversed(coefficients):
        sixth = sixth * t + half
        half = half * t + slope
        slope = slope * t + value
        value = value * t + c
    return value, slope, 2.0 * half, 6.0 * sixth
