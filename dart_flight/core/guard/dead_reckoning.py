"""The vehicle's motion after a wrong reset of PX4's heading, from the IMU alone.

PX4 rotates the accelerometer by its heading. While the heading is wrong, PX4's velocity and position follow
accelerations in a wrong direction. Motion capture corrects this only seconds later. The IMU, integrated from
the state before the reset, is accurate for that time:

    v' = R(q) f + g,    p' = v,    q = D gyro(t)

D is the rotation that `heading_step` defines, at its value before the reset. f is the specific force.
"""

from __future__ import annotations

import math
from typing import Final

from dart_flight.base.geometry import (
    GRAVITY_M_S2,
    Quaternion,
    Vec3,
    add,
    quaternion_multiply,
    rotate,
    scale,
)
from dart_flight.base.records import ImuSample, OdometrySample
from dart_flight.core.guard.heading_step import HEADING_STEP_DEG

WRONG_RAD = math.radians(HEADING_STEP_DEG)
_DETECTED_S: Final = 0.2  # longest time from a reset until a heading step of this reset is detected
# PX4 subtracts its estimated biases from the IMU's readings. A wrong heading disturbs these estimates, so
# PX4's velocity is wrong by up to 0.5 m/s after 2 s.
_LONGEST_S: Final = 2.5
_RESET_M: Final = 0.1
_SAME_M, _SAME_M_S = 0.2, 0.3  # PX4's estimate has recovered if it differs from the integral by less


class DeadReckoning:
    """Motion in local NED, integrated from the state before a reset.

    `rotation` is D (see the module).
    """

    def __init__(self, odometry: OdometrySample, rotation: Quaternion) -> None:
        self.rotation = rotation
        self.heading_was_wrong = False
        self.position_ned, self.velocity_ned = odometry.position_ned, odometry.velocity_ned
        self._since_us = self._t_us = odometry.t_us

    def add_imu(self, item: ImuSample, gyro: Quaternion) -> None:
        """Integrate a sample; `gyro` is the integral of the rates up to the item's stamp."""
        dt_s = (item.t_us - self._t_us) * 1e-6
        if dt_s <= 0.0:
            return
        self._t_us = item.t_us
        fx, fy, fz = rotate(quaternion_multiply(self.rotation, gyro), item.specific_force_frd)
        gained = scale((fx, fy, fz + GRAVITY_M_S2), dt_s)
        self.position_ned = add(self.position_ned, scale(add(self.velocity_ned, scale(gained, 0.5)), dt_s))
        self.velocity_ned = add(self.velocity_ned, gained)

    def is_finished(self, odometry: OdometrySample, error_rad: float, step_m: float) -> bool:
        """Return whether the guard can use PX4's estimate again.

        After a large error PX4's heading recovers first. Then PX4's position and velocity approach the
        integrated ones, or PX4 resets its position to motion capture. `step_m` is the step of PX4's position
        in this sample.
        """
        since_s = (self._t_us - self._since_us) * 1e-6
        if abs(error_rad) > WRONG_RAD:
            self.heading_was_wrong = True
            return since_s > _LONGEST_S
        if not self.heading_was_wrong:
            return since_s > _DETECTED_S
        away_m = math.dist(odometry.position_ned[:2], self.position_ned[:2])
        away_m_s = math.dist(odometry.velocity_ned[:2], self.velocity_ned[:2])
        agrees = away_m < _SAME_M and away_m_s < _SAME_M_S
        return agrees or step_m > _RESET_M or since_s > _LONGEST_S


def horizontal_ned(vector: Vec3, by_rad: float) -> Vec3:
    """Return the horizontal part of a NED vector, rotated clockwise as seen from above."""
    c, s = math.cos(by_rad), math.sin(by_rad)
    return (c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], 0.0)
