"""How the vehicle turns, from the gyro, and what an IMU beside the centre of mass feels of it.

    specific force at the centre = reading - alpha x r - w x (w x r)

with r the IMU's place, w the rate and alpha its change, body FRD. The rate's change from sample to sample is
the mean of alpha over the tick, as a reading is the mean of the specific force over it.
"""

from __future__ import annotations

from typing import Final

from dart_flight.base.geometry import Vec3
from dart_flight.base.records import ImuSample

_LONGEST_GAP_S: Final = 0.1  # further apart two rates say nothing of the acceleration between them


class AngularMotion:
    """Rate and angular acceleration of the newest tick.

    Attributes:
        known: whether there was a sample shortly before the newest one.
        rate: mean over the tick, rad/s, FRD.
        acceleration: likewise, rad/s2, FRD; zero where not known.
        dt_s: between the two samples.
    """

    def __init__(self) -> None:
        self.known = False
        self.rate: Vec3 = (0.0, 0.0, 0.0)
        self.acceleration: Vec3 = (0.0, 0.0, 0.0)
        self.dt_s = 0.0
        self._t_us = 0
        self._last: Vec3 = (0.0, 0.0, 0.0)

    def update(self, imu: ImuSample) -> None:
        """The next sample."""
        old, new = self._last, imu.rate_frd
        dt_s = self.dt_s = (imu.t_us - self._t_us) * 1e-6
        self._last, self._t_us = new, imu.t_us
        self.known = 0.0 < dt_s <= _LONGEST_GAP_S
        if not self.known:
            self.rate, self.acceleration = new, (0.0, 0.0, 0.0)
            return
        share = 1.0 / dt_s
        self.rate = (0.5 * (new[0] + old[0]), 0.5 * (new[1] + old[1]), 0.5 * (new[2] + old[2]))
        self.acceleration = (
            (new[0] - old[0]) * share,
            (new[1] - old[1]) * share,
            (new[2] - old[2]) * share,
        )

    def at_centre(self, specific_force: Vec3, at: Vec3) -> Vec3:
        """The specific force at the centre of mass from the reading of an IMU at `at`, m/s2, FRD."""
        wx, wy, wz = self.rate
        ax, ay, az = self.acceleration
        x, y, z = at
        # w x (w x r) = w (w . r) - r (w . w)
        along, square = wx * x + wy * y + wz * z, wx * wx + wy * wy + wz * wz
        return (
            specific_force[0] - (ay * z - az * y) - (wx * along - x * square),
            specific_force[1] - (az * x - ax * z) - (wy * along - y * square),
            specific_force[2] - (ax * y - ay * x) - (wz * along - z * square),
        )
