"""Detection of steps in PX4's heading, by comparing PX4's attitude with the integrated gyro rates.

    step = vertical part of  D(t) conj(D(t - 0.1 s)),  D(t) = attitude(t) conj(gyro(t))

Here gyro(t) is the rate integrated from an arbitrary start. D is the rotation from the frame of that integral
to NED. A rotation of the vehicle, however fast, does not change D; a reset of the heading does.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from dart_flight.base.geometry import (
    IDENTITY,
    Quaternion,
    Vec3,
    advance_attitude,
    integrate_rate,
    quaternion_conjugate,
    quaternion_multiply,
    wrap_angle,
)
from dart_flight.base.records import AttitudeSample, ImuSample

# [ours] With motion capture, PX4's heading stays within 2 degrees during and after impacts.
HEADING_STEP_DEG: Final = 5.0
_BEFORE_US: Final = 100_000
_GAP_US: Final = 20_000  # a longer gap between two rates makes the integral invalid


class HeadingStep:
    """Detector of heading changes that the gyro did not measure, over the last 0.1 s."""

    def __init__(self) -> None:
        self.gyro: Quaternion = IDENTITY
        self._imu_us: int | None = None
        self._rate: Vec3 = (0.0, 0.0, 0.0)
        self._waiting: AttitudeSample | None = None  # attitude that is newer than the newest rate
        self._turns: deque[tuple[int, Quaternion]] = deque()  # stamps and D of the last 0.1 s

    def add_imu(self, item: ImuSample) -> None:
        """Integrate the rate of `item`. The rate is the mean over the tick before the item's stamp."""
        before_us, self._imu_us, self._rate = self._imu_us, item.t_us, item.rate_frd
        if before_us is None or not 0 < item.t_us - before_us <= _GAP_US:
            self._turns.clear()
            self.gyro, self._waiting = IDENTITY, None
            return
        dt_s = (item.t_us - before_us) * 1e-6
        self.gyro = integrate_rate(self.gyro, item.rate_frd, dt_s)
        if self._waiting is not None and self._waiting.t_us <= item.t_us:
            self._compare(self._waiting, item.t_us)
            self._waiting = None

    def add_attitude(self, item: AttitudeSample) -> None:
        """Compare an attitude with the gyro's integral, once the IMU samples have reached its stamp."""
        if self._imu_us is None:
            return
        if item.t_us > self._imu_us:
            self._waiting = item
        elif self._imu_us - item.t_us <= _GAP_US:
            self._compare(item, self._imu_us)

    @property
    def before(self) -> Quaternion | None:
        """The oldest rotation D (see the module) of the last 0.1 s, or None if there is none."""
        return self._turns[0][1] if self._turns else None

    def step_since(self, before: Quaternion) -> float:
        """Return the heading's step since the rotation `before`, rad, positive clockwise seen from above.

        `self.before` must not be None.
        """
        w, _, _, z = quaternion_multiply(self._turns[-1][1], quaternion_conjugate(before))
        return wrap_angle(2.0 * math.atan2(z, w))

    def _compare(self, item: AttitudeSample, imu_us: int) -> None:
        then = self.gyro
        if imu_us != item.t_us:
            then = advance_attitude(then, self._rate, (item.t_us - imu_us) * 1e-6)
        self._turns.append((item.t_us, quaternion_multiply(item.q_frd_to_ned, quaternion_conjugate(then))))
        while self._turns[0][0] < item.t_us - _BEFORE_US:
            self._turns.popleft()
