"""Estimate of the time offset between PX4's position estimate and the IMU.

PX4 assumes that a motion-capture pose is EKF2_EV_DELAY old. If this assumption is wrong by d, PX4's position
estimate is early or late by d. After an acceleration, the estimated velocity then exceeds the IMU's by about
d times the acceleration. This error appears about 0.45 s later, because PX4's filter processes delayed
samples and its output follows slowly. A regression of the error on that acceleration yields d.

    e = v_odometry - integral of the specific force and gravity,   z = acceleration from 0.6 s to 0.3 s ago
    d = covariance of e and z / variance of z

Accelerometer bias and attitude errors make e drift. The same high-pass filter is applied to e and z. The
filter turns a steady drift into a constant, which does not affect a covariance.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from dart_flight.base.geometry import GRAVITY_M_S2, Vec3

Momenta = deque[tuple[int, float, float, float]]

_STEP_US: Final = 50_000  # step: longer than an IMU tick, shorter than the estimate's oscillations
_NEAR, _FAR = 6, 12  # z is the mean acceleration between these numbers of steps ago: 0.3 s and 0.6 s
_HIGH_PASS_S: Final = 0.5
_MEMORY_S: Final = 4.0  # time constant of covariance and variance, about the duration of one manoeuvre
_JUMP_M_S: Final = 0.15  # a larger change in one step is an estimator reset, which other rules detect
# Two filters lie between a pose and the output, so the regression yields only this fraction of the delay.
_SHARE: Final = 0.75
# Minimum variance of z in `figures`, (m/s2)^2 s, and minimum correlation. Pose fusion corrects accelerometer
# noise late. This looks like a lagging estimate, with correlations up to 0.7 (docs/results/px4_versions.md).
_LITTLE_MOTION, _LITTLE_AHEAD = 0.1, 0.75
_MOTION, _AHEAD, _BEHIND = 0.2, 0.6, 0.8


class PositionDelay:
    """Estimator of PX4's position delay: a regression of PX4's velocity error on past acceleration.

    After a disturbance, no samples are compared for `window_s`.

    Attributes:
        due_us: stamp from which the next odometry sample is compared.
        figures: covariance of e and z, variance of z, and variance of e, each multiplied by the averaging
            time, seconds.
        ahead_s: lead of the position estimate over the IMU, seconds. The lead is negative if the estimate is
            behind, and None if acceleration or correlation is too small.
    """

    def __init__(self, mass_kg: float, window_s: float) -> None:
        self._per_mass, self._window_us = 1.0 / mass_kg, round(window_s * 1e6)
        self.ahead_s: float | None = None
        self.due_us = self._quiet_us = 0
        self._waiting: tuple[int, Vec3] | None = None  # an odometry sample newer than the IMU's samples
        self._past: deque[tuple[int, float, float, float]] = deque(maxlen=_FAR + 1)  # momentum at every step
        self._velocity: Vec3 = (0.0, 0.0, 0.0)  # velocity from odometry at the last step
        self._high_e: Vec3 = (0.0, 0.0, 0.0)
        self._high_z: Vec3 = (0.0, 0.0, 0.0)
        self._z: Vec3 | None = None
        self._sums, self._weight = (_Sums(), _Sums(), _Sums()), 0.0
        self.figures = (0.0, 0.0, 0.0)

    def disturb(self, t_us: int) -> None:
        """Suspend the comparison for `window_s`, because a contact disturbs PX4's estimate."""
        self._quiet_us = t_us + self._window_us

    def compare_odometry(self, t_us: int, velocity_mission: Vec3, momenta: Momenta) -> None:
        """Compare an odometry sample with the IMU's momenta, once these have reached its stamp.

        The stamps must increase and be at least `due_us`.
        """
        waiting = self._waiting or (t_us, velocity_mission)
        if waiting[0] > momenta[-1][0]:
            self._waiting = waiting
            return
        self._waiting = None
        self.due_us = max(self.due_us, waiting[0] - _STEP_US) + _STEP_US
        self._compare(*waiting, momenta)

    def _compare(self, t_us: int, velocity: Vec3, momenta: Momenta) -> None:
        past, now = self._past, _momentum_at(t_us, momenta)
        if t_us < self._quiet_us or now is None:
            self._restart()
            return
        (x, y, z), self._velocity = self._velocity, velocity
        if past and momenta[0][0] <= past[-1][0]:  # the IMU has had no gap since the last step
            last, per = past[-1], self._per_mass
            dt_s = (t_us - last[0]) * 1e-6
            change = (
                velocity[0] - x - per * (now[1] - last[1]),
                velocity[1] - y - per * (now[2] - last[2]),
                velocity[2] - z - per * (now[3] - last[3]) + GRAVITY_M_S2 * dt_s,
            )
            if max(map(abs, change)) <= _JUMP_M_S:
                past.append(now)
                self._follow(change, dt_s)
                return
        self._restart()
        past.append(now)

    def _restart(self) -> None:
        """Restart the filters, but keep the sums of the regression."""
        self._past.clear()
        self._high_e = self._high_z = (0.0, 0.0, 0.0)
        self._z = None

    def _follow(self, change: Vec3, dt_s: float) -> None:
        """Update filters and sums with the change of the velocity error during one step."""
        keep, high = 1.0 - dt_s / _HIGH_PASS_S, self._high_e
        e = self._high_e = (
            keep * (high[0] + change[0]),
            keep * (high[1] + change[1]),
            keep * (high[2] + change[2]),
        )
        past = self._past
        if len(past) <= _FAR:
            return
        far, near = past[0], past[_FAR - _NEAR]
        per = 1e6 * self._per_mass / (near[0] - far[0])
        now = (per * (near[1] - far[1]), per * (near[2] - far[2]), per * (near[3] - far[3]))
        before, self._z = self._z, now
        if before is None:
            return
        high = self._high_z
        z = self._high_z = (
            keep * (high[0] + now[0] - before[0]),
            keep * (high[1] + now[1] - before[1]),
            keep * (high[2] + now[2] - before[2]),
        )
        kept = 1.0 - dt_s / _MEMORY_S
        self._weight = weight = kept * self._weight + dt_s
        ez = zz = ee = 0.0
        for sums, a, b in zip(self._sums, e, z, strict=True):
            sums.add(kept, dt_s, a, b)
            ez += sums.ez - sums.e * sums.z / weight
            zz += sums.zz - sums.z * sums.z / weight
            ee += sums.ee - sums.e * sums.e / weight
        self.figures = (ez, zz, ee)
        needed = _BEHIND if ez < 0.0 else _AHEAD if zz > _MOTION else _LITTLE_AHEAD
        moved = zz > (_MOTION if ez < 0.0 else _LITTLE_MOTION)
        sure = moved and ez * ez > needed * needed * zz * ee
        self.ahead_s = ez / (_SHARE * zz) if sure else None


class _Sums:
    """Exponentially weighted sums of one axis."""

    __slots__ = ("e", "ee", "ez", "z", "zz")

    def __init__(self) -> None:
        self.e = self.z = self.ee = self.ez = self.zz = 0.0

    def add(self, kept: float, dt_s: float, e: float, z: float) -> None:
        self.e = kept * self.e + dt_s * e
        self.z = kept * self.z + dt_s * z
        self.ee = kept * self.ee + dt_s * e * e
        self.ez = kept * self.ez + dt_s * e * z
        self.zz = kept * self.zz + dt_s * z * z


def _momentum_at(t_us: int, momenta: Momenta) -> tuple[int, float, float, float] | None:
    """Return the momentum interpolated at a stamp, or None if the samples begin later."""
    later = momenta[-1]
    for one in reversed(momenta):
        if one[0] <= t_us:
            share = (t_us - one[0]) / (later[0] - one[0]) if later[0] > one[0] else 0.0
            return (
                t_us,
                one[1] + share * (later[1] - one[1]),
                one[2] + share * (later[2] - one[2]),
                one[3] + share * (later[3] - one[3]),
            )
        later = one
    return None
