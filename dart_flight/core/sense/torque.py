"""Estimator of the external torque about the centre of mass (docs/torque.md).

    torque = J alpha + w x J w - motors

Here w is the gyro's rate, alpha its change over the tick and J the inertia, all in body FRD. Like a force
sample, a torque sample is the mean over the tick that ends at its stamp. The motors' torque follows from the
thrust, position and propeller drag of each motor, averaged over the same tick. In the air and outside of
contacts, the estimator learns the noise and a constant torque. The constant torque, for example from an
offset centre of mass or a weak motor, is subtracted.
"""

from __future__ import annotations

import math
from typing import Final

from dart_flight.base.filters import VarianceEstimate, average_weight
from dart_flight.base.geometry import Vec3, gyroscopic_torque
from dart_flight.base.records import TorqueEstimate
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.sense.angular_motion import AngularMotion
from dart_flight.core.sense.thrust_model import Each

_NOISE_TIME_S: Final = 0.5
_THIRD: Final = 1.0 / 3.0  # white noise: variance of a first difference / variance of a second one
_ADDED: Final = 1e-10  # added to the learnt variance at each sample, N2 m2
_SLOW_S: Final = 1.0  # time constant of the estimate of the constant torque
_MAX_SLOW_NM: Final = 0.3  # limit of the constant torque


class TorqueEstimator:
    """Estimator of the external torque; it needs two IMU samples in close succession."""

    def __init__(self, vehicle: VehicleConfig) -> None:
        self._inertia = vehicle.airframe.inertia_kg_m2
        # Torque per newton of each motor, negated because the motors' torque is subtracted.
        self._levers = tuple((m.y_m, -m.x_m, -m.yaw_torque_per_thrust_m) for m in vehicle.airframe.motors)
        self._before: Each | None = None
        self._slow: Vec3 = (0.0, 0.0, 0.0)
        self._last: Vec3 | None = None
        self._variances = tuple([VarianceEstimate(1e-3, _NOISE_TIME_S, added=_ADDED) for _ in range(3)])
        self._noise: Vec3 = (0.0316, 0.0316, 0.0316)

    def estimate(
        self, t_us: int, turning: AngularMotion, each_n: Each | None, scale: float, learns: bool
    ) -> TorqueEstimate | None:
        """Return the torque at an IMU sample, N m, FRD, or None without a recent previous sample.

        Args:
            turning: angular motion, already updated with the sample.
            each_n: thrust of each motor at `t_us` by the thrust model, without `scale`; None if not known.
            scale: true thrust divided by the thrust of the curve.
            learns: whether to learn noise and constant torque; True in the air without a contact.
        """
        before, self._before = self._before, each_n
        if not turning.known:
            self._last = None
            return None
        (jx, jy, jz), (ax, ay, az) = self._inertia, turning.acceleration
        x, y, z = gyroscopic_torque(self._inertia, turning.rate)
        x, y, z = jx * ax + x, jy * ay + y, jz * az + z
        if each_n is not None:
            old = before or each_n
            half = 0.5 * scale
            u = v = w = 0.0
            for (roll, pitch, yaw), now_n, old_n in zip(self._levers, each_n, old, strict=True):
                mean_n = half * (now_n + old_n)
                u += roll * mean_n
                v += pitch * mean_n
                w += yaw * mean_n
            x, y, z = x + u, y + v, z + w
        raw = (x, y, z)
        if learns:
            self._learn(raw, turning.dt_s)
        self._last = raw
        u, v, w = self._slow
        x, y, z = x - u, y - v, z - w
        return TorqueEstimate(t_us, (x, y, z), self._noise)

    def _learn(self, raw: Vec3, dt_s: float) -> None:
        share, most = average_weight(dt_s, _SLOW_S), _MAX_SLOW_NM
        x, y, z = raw
        u, v, w = self._slow
        u, v, w = u + share * (x - u), v + share * (y - v), w + share * (z - w)
        if -most <= u <= most and -most <= v <= most and -most <= w <= most:
            self._slow = (u, v, w)
        last = self._last
        if last is None:
            return
        roll, pitch, yaw = self._variances
        self._noise = (
            math.sqrt(roll.update(_THIRD * (x - last[0]) ** 2, dt_s)),
            math.sqrt(pitch.update(_THIRD * (y - last[1]) ** 2, dt_s)),
            math.sqrt(yaw.update(_THIRD * (z - last[2]) ** 2, dt_s)),
        )
