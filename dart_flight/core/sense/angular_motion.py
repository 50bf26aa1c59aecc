"""Angular rate and acceleration from the gyro, and the correction for an IMU away from the centre of mass.

    specific force at the centre = reading - alpha x r - w x (w x r)

Here r is the position of the IMU, w is the angular rate and alpha is the angular acceleration, all in body
FRD. A tick is the time between two successive samples. The change of w over a tick gives the mean of alpha. A
reading is the mean specific force over the same tick. The force and torque estimators use this module.
"""

from __future__ import annotations

from typing import Final

from dart_flight.base.geometry import Vec3
from dart_flight.base.records import ImuSample

_LONGEST_GAP_S: Final = 0.1  # longest time between two rates that yield an acceleration


class AngularMotion:
    """Angular rate and acceleration over the newest tick.

    Attributes:
        known: whether the newest sample follows the previous sample without a gap.
        rate: mean rate over the tick, rad/s, FRD.
        acceleration: mean angular acceleration over the tick, rad/s2, FRD; zero if not known.
        dt_s: time between the newest two samples.
    """

    def __init__(self) -> None:
        self.known = False
        self.rate: Vec3 = (0.0, 0.0, 0.0)
        self.acceleration: Vec3 = (0.0, 0.0, 0.0)
        self.dt_s = 0.0
        self._t_us = 0
        self._last: Vec3 = (0.0, 0.0, 0.0)

    def update(self, imu: ImuSample) -> None:
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
        """Return the specific force at the centre of mass, m/s2, FRD, from a reading at position `at`."""
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
