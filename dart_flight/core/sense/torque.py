"""External torque about the centre of mass, beside the external force (docs/torque.md).

    torque = J alpha + w x J w - motors

with w the gyro's rate, alpha its change over the tick, J the inertia, all in body FRD: a sample means what
one of the force means, the mean over the tick that ends at its stamp. The motors' torque follows from each
one's thrust, place and propeller drag, averaged over the same tick. Noise is learnt outside of contacts,
as the accelerometer's is. A torque that is there all the time (a centre of mass beside the motors' middle, a
motor weaker than the others) is followed outside of contacts and taken off.
"""

from __future__ import annotations

import math

from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.sense.thrust import Four
from dart_flight.core.sense.turning import Turning
from dart_flight.geometry import Vec3
from dart_flight.samples import TorqueEstimate

_NOISE_TIME_S = 0.5
_OUTLIER = 9.0  # a squared difference counts at most this many times the present one
_THIRD = 1.0 / 3.0  # a change of the rate's white noise, of variance 2: successive ones differ by 6
_LEAST_VARIANCE = 1e-8  # N2 m2: never let certainty become absolute
_SLOW_S = 1.0  # time constant of the torque that is always there ...
_MOST_SLOW_NM = 0.3  # ... and its limit, per axis
_MOST_STEP_S = 0.05  # after a gap in the stream one sample counts for this long at most


class TorqueEstimator:
    """External torque, one estimate for every IMU sample that has one shortly before it."""

    def __init__(self, vehicle: VehicleConfig) -> None:
        self._inertia = vehicle.airframe.inertia_kg_m2
        self._motors = vehicle.airframe.motors
        self._filter_s = vehicle.estimation.filter_s
        self._before: Four | None = None
        self._slow: Vec3 = (0.0, 0.0, 0.0)
        self._last: Vec3 | None = None
        self._variance: Vec3 = (1e-3, 1e-3, 1e-3)
        self._noise: Vec3 = (0.0316, 0.0316, 0.0316)
        self._filtered: Vec3 = (0.0, 0.0, 0.0)

    def estimate(
        self, t_us: int, turning: Turning, each_n: Four | None, scale: float, learns: bool
    ) -> TorqueEstimate | None:
        """Torque in N m, FRD, at an IMU sample; None without a sample shortly before it.

        Args:
            t_us: stamp of the sample.
            turning: it has taken the sample.
            each_n: thrust of each motor at the stamp by the curve; None where not known motor by motor.
            scale: true thrust over the curve's.
            learns: in the air and without a contact: noise and slow torque are followed.
        """
        before, self._before = self._before, each_n
        if not turning.known:
            self._last = None
            return None
        (jx, jy, jz), (wx, wy, wz), (ax, ay, az) = self._inertia, turning.rate, turning.acceleration
        x = jx * ax + (jz - jy) * wy * wz
        y = jy * ay + (jx - jz) * wz * wx
        z = jz * az + (jy - jx) * wx * wy
        if each_n is not None:
            old = each_n if before is None else before
            for motor, now_n, then_n in zip(self._motors, each_n, old, strict=True):
                force = 0.5 * scale * (now_n + then_n)
                x += motor.y_m * force
                y -= motor.x_m * force
                z -= motor.yaw_m * force
        raw = (x, y, z)
        if learns:
            self._learn(raw, min(turning.dt_s, _MOST_STEP_S))
        self._last = raw
        slow = self._slow
        torque = (x - slow[0], y - slow[1], z - slow[2])
        keep = math.exp(-turning.dt_s / self._filter_s) if self._filter_s > 0.0 else 0.0
        f = self._filtered
        self._filtered = (
            torque[0] + (f[0] - torque[0]) * keep,
            torque[1] + (f[1] - torque[1]) * keep,
            torque[2] + (f[2] - torque[2]) * keep,
        )
        return TorqueEstimate(t_us, torque, self._filtered, self._noise, each_n is not None)

    def _learn(self, raw: Vec3, step_s: float) -> None:
        share, slow, most = step_s / _SLOW_S, self._slow, _MOST_SLOW_NM
        self._slow = (
            max(-most, min(most, slow[0] + share * (raw[0] - slow[0]))),
            max(-most, min(most, slow[1] + share * (raw[1] - slow[1]))),
            max(-most, min(most, slow[2] + share * (raw[2] - slow[2]))),
        )
        last = self._last
        if last is None:
            return
        share, v = step_s / _NOISE_TIME_S, self._variance
        dx, dy, dz = raw[0] - last[0], raw[1] - last[1], raw[2] - last[2]
        self._variance = v = (
            v[0] + share * (min(_THIRD * dx * dx, _OUTLIER * v[0]) - v[0]) + _LEAST_VARIANCE * share,
            v[1] + share * (min(_THIRD * dy * dy, _OUTLIER * v[1]) - v[1]) + _LEAST_VARIANCE * share,
            v[2] + share * (min(_THIRD * dz * dz, _OUTLIER * v[2]) - v[2]) + _LEAST_VARIANCE * share,
        )
        self._noise = (math.sqrt(v[0]), math.sqrt(v[1]), math.sqrt(v[2]))
