"""The type of all trajectories: a position, with three derivatives, as a function of time.

Trajectories are fed forward to PX4, so PX4's P-PID cascade only corrects errors. Executive, planner and
report use trajectories. The name of each constructor states the source of the trajectory.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum

import msgspec

from dart_flight.base.arithmetic import Number, maximum, sqrt, sum_in_order
from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.records import PlanAnswer
from dart_flight.config.mission_file import TrajectoryPieces
from dart_flight.config.vehicle import Flying

_MIN_TRANSIT_S = 0.1
_AT_REST_M_S, _LEVEL_M_S2 = 0.01, 0.01  # a trajectory that ends below these limits ends at rest or level
# Coefficients from rest to rest over a distance of 1 in a time of 1, constant term first.
_REST_TO_REST = (0.0, 0.0, 0.0, 10.0, -15.0, 6.0)


class TrajectoryPoint(msgspec.Struct, frozen=True, gc=False):
    """Position (m), velocity (m/s), acceleration (m/s2) and jerk (m/s3) in the mission frame."""

    position: Vec3
    velocity: Vec3
    acceleration: Vec3
    jerk: Vec3 = (0.0, 0.0, 0.0)


class AfterEnd(StrEnum):
    """Motion after the end of a trajectory."""

    HOLD = "hold"  # the vehicle rests at the end
    CONTINUE = "continue"  # the vehicle flies straight on at the final velocity, as if through a wall


def transit_time_s(
    way_m: Number, speed_m_s: float, acceleration_m_s2: float, jerk_m_s3: float | None = None
) -> Number:
    """Return the duration of the fastest rest-to-rest quintic over a distance, within the limits.

    A quintic over a distance d in a time T has the peak speed 1.875 d/T, acceleration 5.774 d/T^2 and jerk 60
    d/T^3.
    """
    time_s = maximum(1.875 * way_m / speed_m_s, sqrt(5.774 * way_m / acceleration_m_s2))
    if jerk_m_s3 is None:
        return time_s
    return maximum(time_s, (60.0 * way_m / jerk_m_s3) ** (1.0 / 3.0))


class Trajectory(msgspec.Struct, frozen=True):
    """Piecewise quintic polynomial for each axis.

    Attributes:
        x, y, z: six polynomial coefficients for each piece, constant term first; mission frame, metres. The
            variable of the polynomials is the time since the beginning of the piece, s.
        pieces_s: duration of each piece.
        duration_s: total duration.
    """

    x: tuple[float, ...]
    y: tuple[float, ...]
    z: tuple[float, ...]
    pieces_s: tuple[float, ...]
    duration_s: float
    after: AfterEnd = AfterEnd.CONTINUE

    @classmethod
    def level(
        cls,
        x: Sequence[float],
        y: Sequence[float],
        altitude_m: float,
        pieces_s: Sequence[float],
        duration_s: float | None = None,
    ) -> Trajectory:
        """Return a trajectory at constant altitude; after its end the last velocity continues."""
        z = (altitude_m, 0.0, 0.0, 0.0, 0.0, 0.0) * len(pieces_s)
        lasts_s = sum_in_order(pieces_s) if duration_s is None else duration_s
        return cls(tuple(x), tuple(y), z, tuple(pieces_s), lasts_s)

    @classmethod
    def rest_to_rest(
        cls,
        begin: Vec3,
        end: Vec3,
        speed_m_s: float,
        flying: Flying,
        climb_speed_m_s: float = math.inf,
    ) -> Trajectory:
        """Return the fastest smooth straight flight between two points at rest, mission frame, metres.

        `climb_speed_m_s` limits the vertical part of the speed; `flying` has the limits of acceleration and
        jerk.
        """
        distance_m, acceleration_m_s2 = math.dist(begin, end), flying.acceleration_m_s2
        duration = transit_time_s(distance_m, speed_m_s, acceleration_m_s2, flying.jerk_m_s3)
        climb = abs(end[2] - begin[2])
        if climb > 0.0:
            duration = max(duration, transit_time_s(climb, climb_speed_m_s, acceleration_m_s2))
        duration = max(duration, _MIN_TRANSIT_S)
        shares = [c / duration**k for k, c in enumerate(_REST_TO_REST)]
        x, y, z = ((a, *((b - a) * s for s in shares[1:])) for a, b in zip(begin, end, strict=True))
        return cls(x, y, z, (duration,), duration, AfterEnd.HOLD)

    @classmethod
    def run_up(
        cls, begin: Vec2, velocity: Vec2, ramp_s: float, steady_s: float, altitude_m: float
    ) -> Trajectory:
        """Return a trajectory that accelerates from rest, then runs steadily and continues through the wall.

        The speed grows to `velocity` (mission frame) as 3 s^2 - 2 s^3, where s is the elapsed fraction of the
        ramp.
        """
        axes = []
        for place, v in zip(begin, velocity, strict=True):
            ramp = (place, 0.0, 0.0, v / ramp_s**2, -0.5 * v / ramp_s**3, 0.0)
            axes.append((*ramp, place + 0.5 * v * ramp_s, v, 0.0, 0.0, 0.0, 0.0))
        return cls.level(axes[0], axes[1], altitude_m, (ramp_s, max(0.0, steady_s)))

    @classmethod
    def from_mission(cls, written: TrajectoryPieces, altitude_m: float) -> Trajectory:
        """Return a trajectory of a mission file, which has constant jerk in each piece."""
        xs: list[float] = []
        ys: list[float] = []
        for (_, (x, y), (vx, vy), (ax, ay)), (_, jx, jy) in zip(
            written.states(), written.pieces, strict=False
        ):
            xs += (x, vx, 0.5 * ax, jx / 6.0, 0.0, 0.0)
            ys += (y, vy, 0.5 * ay, jy / 6.0, 0.0, 0.0)
        return cls.level(xs, ys, altitude_m, [piece[0] for piece in written.pieces], written.duration_s)

    @classmethod
    def from_plan(cls, answer: PlanAnswer, altitude_m: float) -> Trajectory:
        pieces_s = answer.pieces_s or (answer.duration_s,)
        return cls.level(answer.x_mission, answer.y_mission, altitude_m, pieces_s, answer.duration_s)

    @property
    def begin(self) -> Vec3:
        return (self.x[0], self.y[0], self.z[0])

    @property
    def goes_straight_on(self) -> bool:
        """Whether the trajectory is one polynomial, followed by straight flight without acceleration."""
        if self.after is AfterEnd.HOLD or len(self.pieces_s) > 1:
            return False
        end = self.at(self.duration_s)
        return math.hypot(*end.velocity) > _AT_REST_M_S and math.hypot(*end.acceleration) < _LEVEL_M_S2

    def at(self, t_s: float) -> TrajectoryPoint:
        first, since = self._piece_at(max(0.0, min(t_s, self.duration_s)))
        px, vx, ax, jx = _derivatives(self.x[first : first + 6], since)
        py, vy, ay, jy = _derivatives(self.y[first : first + 6], since)
        pz, vz, az, jz = _derivatives(self.z[first : first + 6], since)
        beyond = t_s - self.duration_s
        if beyond <= 0.0:
            return TrajectoryPoint((px, py, pz), (vx, vy, vz), (ax, ay, az), (jx, jy, jz))
        still = (0.0, 0.0, 0.0)
        if self.after is AfterEnd.HOLD:
            return TrajectoryPoint((px, py, pz), still, still)
        return TrajectoryPoint((px + vx * beyond, py + vy * beyond, pz + vz * beyond), (vx, vy, vz), still)

    def _piece_at(self, t_s: float) -> tuple[int, float]:
        """Return the index of the first coefficient of the piece at `t_s`, and the time in this piece."""
        begin = 0.0
        for i, duration in enumerate(self.pieces_s[:-1]):
            if t_s < begin + duration:
                return 6 * i, t_s - begin
            begin += duration
        return 6 * (len(self.pieces_s) - 1), t_s - begin


def _derivatives(coefficients: tuple[float, ...], t: float) -> tuple[float, float, float, float]:
    """Return a polynomial and its first three derivatives, by Horner's scheme."""
    value = slope = half = sixth = 0.0
    for c in reversed(coefficients):
        sixth = sixth * t + half
        half = half * t + slope
        slope = slope * t + value
        value = value * t + c
    return value, slope, 2.0 * half, 6.0 * sixth
