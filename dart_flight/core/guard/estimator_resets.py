"""Resets of PX4's estimator: ODOMETRY's counter, and the steps of position, velocity and heading with it.

The guard judges the newest; the verdict lists them all.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from dart_flight.base.geometry import Quaternion, Vec3
from dart_flight.base.records import AttitudeSample, ImuSample, OdometrySample
from dart_flight.core.guard.heading_step import HeadingStep

REACH_US: Final = 100_000  # a step this near to the counter's belongs to the reset
_JUMP_REACH_US: Final = 100_000  # odometry further apart says nothing about a jump
_STEPS: Final = 16  # odometry of more than that reach


class EstimatorReset:
    """One reset: the largest steps within 0.1 s of the counter's.

    Attributes:
        t_us: when the counter rose, autopilot time.
        position_m, velocity_m_s: steps beside the motion.
        heading_rad: signed, positive clockwise from above.
    """

    def __init__(self, t_us: int) -> None:
        self.t_us = t_us
        self.position_m = self.velocity_m_s = self.heading_rad = 0.0


class EstimatorResets:
    """Takes the samples of one flight.

    Attributes:
        newest: the last reset; None: none since the counter's first value.
    """

    def __init__(self) -> None:
        self.newest: EstimatorReset | None = None
        self._counter: int | None = None
        self._odometry: OdometrySample | None = None
        self._steps: deque[tuple[int, float, float]] = deque(maxlen=_STEPS)  # stamp, position m, velocity m/s
        self._heading = HeadingStep()
        self._before: Quaternion | None = None  # heading against the gyro, shortly before the newest reset

    def take_imu(self, item: ImuSample) -> None:
        """Take a sample of the IMU."""
        self._heading.take_imu(item)
        self._measure_heading(item.t_us)

    def take_attitude(self, item: AttitudeSample) -> None:
        """Take an attitude."""
        self._heading.take_attitude(item)

    def take_odometry(self, item: OdometrySample) -> tuple[float, float]:
        """Return the steps of position (m) and velocity (m/s) since the sample before, beside the motion."""
        before, self._odometry = self._odometry, item
        if before is None or not 0 < item.t_us - before.t_us <= _JUMP_REACH_US:
            return 0.0, 0.0
        away_m = math.dist(item.position_ned, _carried(before, item))
        faster_m_s = math.dist(item.velocity_ned, before.velocity_ned)
        self._steps.append((item.t_us, away_m, faster_m_s))
        if self.newest is not None:
            self._add_step(self.newest, *self._steps[-1])
        return away_m, faster_m_s

    def take_counter(self, counter: int, now_us: int) -> bool:
        """Return whether the estimator has been reset since the counter before."""
        before, self._counter = self._counter, counter
        if before is None or counter == before:
            return False
        self.newest = EstimatorReset(now_us)
        self._before = self._heading.before
        for step in self._steps:
            self._add_step(self.newest, *step)
        self._measure_heading(now_us)
        return True

    def _add_step(self, reset: EstimatorReset, t_us: int, position_m: float, velocity_m_s: float) -> None:
        if abs(t_us - reset.t_us) <= REACH_US:
            reset.position_m = max(reset.position_m, position_m)
            reset.velocity_m_s = max(reset.velocity_m_s, velocity_m_s)

    def _measure_heading(self, now_us: int) -> None:
        reset, before = self.newest, self._before
        if reset is None or before is None:
            return
        if now_us - reset.t_us > REACH_US:
            self._before = None  # what turns the heading from now on is another matter
            return
        step = self._heading.step_since(before)
        if abs(step) > abs(reset.heading_rad):
            reset.heading_rad = step


def _carried(before: OdometrySample, after: OdometrySample) -> Vec3:
    """Return where the position should be by the mean of the two velocities."""
    dt = (after.t_us - before.t_us) * 1e-6
    p, v, w = before.position_ned, before.velocity_ned, after.velocity_ned
    return (
        p[0] + 0.5 * dt * (v[0] + w[0]),
        p[1] + 0.5 * dt * (v[1] + w[1]),
        p[2] + 0.5 * dt * (v[2] + w[2]),
    )
