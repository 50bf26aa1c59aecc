"""Resets of PX4's estimator. ODOMETRY's counter gives a reset's time, jumps of the estimate give its size.

The guard evaluates the newest reset; the verdict lists all resets.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from dart_flight.base.geometry import Quaternion, Vec3
from dart_flight.base.records import AttitudeSample, ImuSample, OdometrySample
from dart_flight.core.guard.dead_reckoning import WRONG_RAD, DeadReckoning
from dart_flight.core.guard.heading_step import HeadingStep

REACH_US: Final = 100_000  # largest time between a reset's step and the counter's change
_JUMP_REACH_US: Final = 100_000  # two odometry samples that are farther apart in time are not compared
_STEPS: Final = 16  # number of odometry samples kept; they cover more than `REACH_US`


class EstimatorReset:
    """One reset, with the largest steps of the estimate within 0.1 s before or after the counter's change.

    Attributes:
        t_us: autopilot time at which the counter rose.
        position_m, velocity_m_s: largest differences between an odometry sample and its prediction from the
            previous sample.
        heading_rad: largest step of the heading, positive clockwise seen from above.
    """

    def __init__(self, t_us: int) -> None:
        self.t_us = t_us
        self.position_m = self.velocity_m_s = self.heading_rad = 0.0


class EstimatorResets:
    """Detector of the estimator resets in one flight.

    `newest` is the last reset, or None if the counter has not changed.
    """

    def __init__(self) -> None:
        self.newest: EstimatorReset | None = None
        self._counter: int | None = None
        self._odometry: OdometrySample | None = None
        self._steps: deque[tuple[int, float, float]] = deque(maxlen=_STEPS)  # stamp, position m, velocity m/s
        self._heading = HeadingStep()
        self._before: Quaternion | None = None  # `HeadingStep.before` at the newest reset
        self._rotation: Quaternion | None = None  # `before` at the reset that caused the heading error
        self._reckoned: DeadReckoning | None = None  # the motion since that reset

    def add_imu(self, item: ImuSample) -> None:
        self._heading.add_imu(item)
        if self._before is not None or self._rotation is not None:
            self._measure_heading(item.t_us)
        if self._reckoned is not None:
            self._reckoned.add_imu(item, self._heading.gyro)

    def add_attitude(self, item: AttitudeSample) -> None:
        self._heading.add_attitude(item)

    def add_odometry(self, item: OdometrySample) -> tuple[float, float]:
        """Return the differences in position (m) and velocity (m/s) from the extrapolated previous sample."""
        before, self._odometry = self._odometry, item
        if before is None or not 0 < item.t_us - before.t_us <= _JUMP_REACH_US:
            return 0.0, 0.0
        away_m = math.dist(item.position_ned, _extrapolate(before, item))
        if self._reckoned is not None and self._reckoned.is_finished(item, self.heading_error_rad, away_m):
            if not self._reckoned.heading_was_wrong:
                self._rotation = None  # with an older rotation, gyro drift looks like an error
            self._reckoned = None
        faster_m_s = math.dist(item.velocity_ned, before.velocity_ned)
        self._steps.append((item.t_us, away_m, faster_m_s))
        if self.newest is not None:
            self._add_step(self.newest, *self._steps[-1])
        return away_m, faster_m_s

    def update_counter(self, counter: int, now_us: int, aligning: bool = False) -> bool:
        """Return whether the reset counter has changed since the last call.

        If PX4 may be `aligning` its heading, the heading before the reset is not assumed to be true.
        """
        before, self._counter = self._counter, counter
        if before is None or counter == before:
            return False
        self.newest = EstimatorReset(now_us)
        self._before = self._heading.before
        if aligning:
            self._rotation = self._reckoned = None
        elif self._reckoned is None and abs(self.heading_error_rad) <= WRONG_RAD:
            self._rotation = self._before
            if self._before is not None and self._odometry is not None:
                self._reckoned = DeadReckoning(self._odometry, self._before)
        for step in self._steps:
            self._add_step(self.newest, *step)
        self._measure_heading(now_us)
        return True

    @property
    def heading_error_rad(self) -> float:
        """PX4's heading minus the true heading, which is the heading before a reset plus the gyro's integral.

        The error is 0 if the heading did not step at the reset, or if the integral of the gyro has
        been interrupted since then.
        """
        return 0.0 if self._rotation is None else self._heading.step_since(self._rotation)

    @property
    def reckoned(self) -> DeadReckoning | None:
        """The motion by dead reckoning, from a wrong reset of the heading until PX4's estimate recovers."""
        reckoned = self._reckoned
        return None if reckoned is None or not reckoned.heading_was_wrong else reckoned

    def _add_step(self, reset: EstimatorReset, t_us: int, position_m: float, velocity_m_s: float) -> None:
        if abs(t_us - reset.t_us) <= REACH_US:
            reset.position_m = max(reset.position_m, position_m)
            reset.velocity_m_s = max(reset.velocity_m_s, velocity_m_s)

    def _measure_heading(self, now_us: int) -> None:
        if self._heading.before is None:  # a gap in the rates interrupted the integral
            self._before = self._rotation = self._reckoned = None
            return
        reset, before = self.newest, self._before
        if reset is None or before is None:
            return
        if now_us - reset.t_us > REACH_US:  # later steps of the heading do not belong to this reset
            self._before = None
            return
        step = self._heading.step_since(before)
        if abs(step) > abs(reset.heading_rad):
            reset.heading_rad = step


def _extrapolate(before: OdometrySample, after: OdometrySample) -> Vec3:
    """Predict the position at `after` from the position at `before` and the mean of both velocities."""
    dt = (after.t_us - before.t_us) * 1e-6
    p, v, w = before.position_ned, before.velocity_ned, after.velocity_ned
    return (
        p[0] + 0.5 * dt * (v[0] + w[0]),
        p[1] + 0.5 * dt * (v[1] + w[1]),
        p[2] + 0.5 * dt * (v[2] + w[2]),
    )
