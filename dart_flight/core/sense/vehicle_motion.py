"""Motion of the vehicle and its known forces at an IMU sample, from streams that are aligned by their stamps.

A reading of the accelerometer is the mean over one tick. The anti-alias filter delays the reading, so the
tick ends before the reading's stamp. The gyro extrapolates the attitude to the middle of this tick. The
thrust, however, is averaged from the previous stamp to this stamp. `core/sense/angular_motion.py` corrects
the specific force for an IMU away from the centre of mass.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from dart_flight.base.geometry import MissionFrame, Quaternion, Vec3, advance_attitude
from dart_flight.base.records import AttitudeSample, ImuSample
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.sense.angular_motion import AngularMotion
from dart_flight.core.sense.bias import HoverBias
from dart_flight.core.sense.state import FlightState
from dart_flight.core.sense.thrust_model import ThrustModel

_ATTITUDE_REACH_US: Final = 60_000  # an attitude older than this is not extrapolated
_HISTORY: Final = 32
_MOMENTA: Final = 40  # momenta kept: 0.16 s
_MOMENTUM_GAP_S: Final = 0.05


class VehicleMotion:
    """Attitude, angular motion, thrust and specific force at the newest IMU sample.

    Attributes:
        thrust: thrust model; the caller passes actuator, ESC and voltage samples to it.
        attitude: body FRD to NED, or None if no attitude is recent.
        dt_s: time since the previous IMU sample.
        thrust_n: thrust averaged over the tick, corrected by the scale that `hover` has learnt.
        up: direction of the thrust, mission frame.
        residual_n: mass times specific force, minus thrust, mission frame: drag and external force. The bias
            from hover is removed.
        momenta: integral of mass times specific force since the start, mission frame, N s. One timestamped
            entry per recent IMU sample; entries before a gap in the stream are dropped. Hover bias is removed
            from the specific force; gravity is not.
    """

    def __init__(self, vehicle: VehicleConfig) -> None:
        self._mass = vehicle.airframe.mass_kg
        # The middle of a reading's averaging time lies this long before its stamp.
        self._centre_us = round(vehicle.imu.reading_lag_s * 1e6)
        at = vehicle.imu.position_m
        self._imu_at = at if any(at) else None
        self.thrust = ThrustModel(vehicle)
        self.hover = HoverBias(vehicle.estimation, self._mass)
        self.turning = AngularMotion()
        self.attitude: Quaternion | None = None
        self.dt_s = vehicle.imu.tick_s
        self.thrust_n = 0.0
        self.up: Vec3 = (0.0, 0.0, 1.0)
        self.residual_n: Vec3 = (0.0, 0.0, 0.0)
        self.momenta: deque[tuple[int, float, float, float]] = deque([(0, 0.0, 0.0, 0.0)], maxlen=_MOMENTA)
        self._attitudes: deque[AttitudeSample] = deque(maxlen=_HISTORY)
        self._last_us: int | None = None
        self._frame: MissionFrame | None = None
        self._heading = (1.0, 0.0)

    def add_attitude(self, sample: AttitudeSample) -> None:
        self._attitudes.append(sample)

    def update(self, imu: ImuSample, state: FlightState, in_contact: bool) -> bool:
        """Process an IMU sample; return False without a recent attitude or a frame.

        Stamps must increase. Bias and noise are not learnt while `in_contact`.
        """
        t_us = imu.t_us
        if self._last_us is not None:
            self.dt_s = (t_us - self._last_us) * 1e-6
        self._last_us = t_us
        curve_n = self.thrust.mean_over_tick(t_us)
        self.turning.update(imu)
        q = self.attitude = self._attitude_at(t_us - self._centre_us, imu.rate_frd)
        frame = state.frame
        if q is None or frame is None:
            return False
        if frame is not self._frame:
            self._frame = frame
            self._heading = (math.cos(frame.heading_rad), math.sin(frame.heading_rad))
        f, v = imu.specific_force_frd, state.velocity
        if self._imu_at is not None:
            f = self.turning.at_centre(f, self._imu_at)
        if not in_contact and not state.on_ground:
            speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
            self.hover.learn(f, imu.rate_frd, speed, curve_n, self.dt_s)
        self.thrust_n = curve_n * self.hover.scale
        self._turn_to_mission(t_us, f, q)
        return True

    def _turn_to_mission(self, t_us: int, f: Vec3, q: Quaternion) -> None:
        """Set `up`, `residual_n` and `momenta` from a specific force (body FRD) and an attitude."""
        m, hover, thrust_n = self._mass, self.hover, self.thrust_n
        fx, fy, fz = f
        w, x, y, z = q
        c, s = self._heading
        # Rotate from body FRD to NED (R, written out), then from NED to mission.
        bx, by, bz = m * (fx - hover.bias_x), m * (fy - hover.bias_y), m * fz + thrust_n
        down_n, down_e, down_d = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
        n = (1.0 - 2.0 * (y * y + z * z)) * bx + 2.0 * (x * y - w * z) * by + down_n * bz
        e = 2.0 * (x * y + w * z) * bx + (1.0 - 2.0 * (x * x + z * z)) * by + down_e * bz
        d = 2.0 * (x * z - w * y) * bx + 2.0 * (y * z + w * x) * by + down_d * bz
        up = self.up = (-(down_n * c + down_e * s), -(down_n * s - down_e * c), down_d)
        rx, ry, rz = self.residual_n = (n * c + e * s, n * s - e * c, -d)
        last_us, px, py, pz = self.momenta[-1]
        step_s = (t_us - last_us) * 1e-6
        if step_s > _MOMENTUM_GAP_S:
            self.momenta.clear()
        px, py = px + (rx + thrust_n * up[0]) * step_s, py + (ry + thrust_n * up[1]) * step_s
        self.momenta.append((t_us, px, py, pz + (rz + thrust_n * up[2]) * step_s))

    def _attitude_at(self, t_us: int, rate_frd: Vec3) -> Quaternion | None:
        """Extrapolate the nearest stored attitude by the gyro's rate; return None if none is recent."""
        best: AttitudeSample | None = None
        away = _ATTITUDE_REACH_US
        for sample in reversed(self._attitudes):
            distance = abs(sample.t_us - t_us)
            if distance <= away:
                best, away = sample, distance
            elif sample.t_us < t_us:
                break  # all further attitudes are older
        if best is None:
            return None
        return advance_attitude(best.q_frd_to_ned, rate_frd, (t_us - best.t_us) * 1e-6)
