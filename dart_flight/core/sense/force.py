"""Acceleration-based estimate of the external force (paper, Sec. IV-A; docs/force.md).

    force = m R f - R T + m diag(b) v

Here f is the specific force at the centre of mass, without gravity, and T is the thrust vector. R rotates
from body to mission, and b is the air drag along the mission's axes. `core/sense/angular_motion.py` corrects
f for an IMU away from the centre of mass. The autopilot's stamps align the streams. A reading is the mean
over one tick. The anti-alias filter delays the reading, so the tick ends before the reading's stamp. The gyro
extrapolates the attitude to the middle of this tick. The thrust, however, is averaged from the previous stamp
to this stamp.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from dart_flight.base.filters import LowPass
from dart_flight.base.geometry import MissionFrame, Quaternion, Vec3, advance_attitude
from dart_flight.base.records import AttitudeSample, ForceEstimate, ImuSample, Mode
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.sense.angular_motion import AngularMotion
from dart_flight.core.sense.arm_vibration import ArmFilter
from dart_flight.core.sense.bias import HoverBias
from dart_flight.core.sense.state import FlightState
from dart_flight.core.sense.thrust_model import ThrustModel

ATTITUDE_ERROR_RAD: Final = 0.01  # standard deviation of PX4's attitude
FILTER_S: Final = 0.02  # time constant of the filtered force, which is for display only
_ATTITUDE_REACH_US: Final = 60_000  # older attitudes are not extrapolated
_CLIP_SHARE: Final = 0.99  # a reading this near full scale is a lower bound
_HISTORY: Final = 32
_MOMENTA: Final = 40  # momenta kept: 0.16 s
_MOMENTUM_GAP_S: Final = 0.05


class ForceEstimator:
    """Estimator of the external force, with one estimate for every IMU sample that has a recent attitude.

    Attributes:
        thrust: thrust model; the caller passes actuator, ESC and voltage samples to it.
        attitude: attitude of the newest estimate, body FRD to NED, or None if there was none.
        momenta: integral of mass times specific force since the start, mission frame, N s. Each entry has a
            stamp and belongs to one of the last estimates; a gap in the stream discards the older entries.
            Hover bias is removed from the specific force; gravity is not.
    """

    def __init__(self, vehicle: VehicleConfig) -> None:
        e = vehicle.estimation
        self._mass = vehicle.airframe.mass_kg
        self._drag = vehicle.airframe.drag_per_s
        self._clip = _CLIP_SHARE * vehicle.imu.full_scale_m_s2
        # The middle of a reading's averaging time lies this long before its stamp.
        self._centre_us = round(vehicle.imu.reading_lag_s * 1e6)
        self._tick_s = vehicle.imu.tick_s
        self.thrust = ThrustModel(vehicle)
        self.hover = HoverBias(e, self._mass)
        self.turning = AngularMotion()
        self.attitude: Quaternion | None = None
        self.thrust_n = 0.0
        self.momenta: deque[tuple[int, float, float, float]] = deque([(0, 0.0, 0.0, 0.0)], maxlen=_MOMENTA)
        at = vehicle.imu.position_m
        self._imu_at = at if any(at) else None
        self._thrust_variance = e.thrust_error_n**2
        self._attitude_variance = ATTITUDE_ERROR_RAD**2
        self._filter = LowPass(FILTER_S)
        self._arms = ArmFilter(e.arm_vibration, vehicle.imu.tick_s) if e.arm_vibration else None
        self._attitudes: deque[AttitudeSample] = deque(maxlen=_HISTORY)
        self._last_us: int | None = None
        self._frame: MissionFrame | None = None
        self._heading = (1.0, 0.0)

    def add_attitude(self, sample: AttitudeSample) -> None:
        self._attitudes.append(sample)

    def estimate(self, imu: ImuSample, state: FlightState, in_contact: bool = False) -> ForceEstimate | None:
        """Return the external force at the IMU's stamp, newton, mission frame, or None without attitude.

        Stamps must increase. Bias and noise are not learnt while `in_contact`.
        """
        t_us = imu.t_us
        dt_s = (t_us - self._last_us) * 1e-6 if self._last_us is not None else self._tick_s
        self._last_us = t_us
        hover = self.hover
        curve_n = self.thrust.mean_over_tick(t_us)
        self.turning.update(imu)
        q = self.attitude = self._attitude_at(t_us - self._centre_us, imu.rate_frd)
        frame = state.frame
        if q is None or frame is None:
            return None
        if frame is not self._frame:
            self._frame = frame
            self._heading = (math.cos(frame.heading_rad), math.sin(frame.heading_rad))
        f, v = imu.specific_force_frd, state.velocity
        if self._imu_at is not None:
            f = self.turning.at_centre(f, self._imu_at)
        if not in_contact and not state.on_ground:
            speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
            hover.learn(f, imu.rate_frd, speed, curve_n, dt_s)
        self.thrust_n = curve_n * hover.scale
        return self._force(imu, f, state, q, self.thrust_n, dt_s)

    def _force(
        self, imu: ImuSample, f: Vec3, state: FlightState, q: Quaternion, thrust_n: float, dt_s: float
    ) -> ForceEstimate:
        m, hover = self._mass, self.hover
        fx, fy, fz = f
        w, x, y, z = q
        c, s = self._heading
        # Rotate from body FRD to NED (R, written out), then from NED to mission.
        bx, by, bz = m * (fx - hover.bias_x), m * (fy - hover.bias_y), m * fz + thrust_n
        down_n, down_e, down_d = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
        n = (1.0 - 2.0 * (y * y + z * z)) * bx + 2.0 * (x * y - w * z) * by + down_n * bz
        e = 2.0 * (x * y + w * z) * bx + (1.0 - 2.0 * (x * x + z * z)) * by + down_e * bz
        d = 2.0 * (x * z - w * y) * bx + 2.0 * (y * z + w * x) * by + down_d * bz
        v, b = state.velocity, self._drag
        drag = (m * b[0] * v[0], m * b[1] * v[1], m * b[2] * v[2])
        up = (-(down_n * c + down_e * s), -(down_n * s - down_e * c), down_d)
        tx, ty, tz = thrust_n * up[0], thrust_n * up[1], thrust_n * up[2]
        push = (tx - drag[0], ty - drag[1])
        n, e = n * c + e * s, n * s - e * c
        last_us, px, py, pz = self.momenta[-1]
        step_s = (imu.t_us - last_us) * 1e-6
        if step_s > _MOMENTUM_GAP_S:
            self.momenta.clear()
        self.momenta.append(
            (imu.t_us, px + (n + tx) * step_s, py + (e + ty) * step_s, pz + (tz - d) * step_s)
        )
        force = (n + drag[0], e + drag[1], -d + drag[2])
        if self._arms is not None:
            force = self._without_vibration(self._arms, force, state, dt_s)
        clip, noise = self._clip, m * hover.noise_m_s2
        rx, ry, rz = imu.specific_force_frd
        clipped = abs(rx) >= clip or abs(ry) >= clip or abs(rz) >= clip
        variance = self._variance(force, up, noise * noise)
        filtered = self._filter.update(force, dt_s)
        return ForceEstimate(imu.t_us, force, clipped, filtered, variance, noise, push)

    def _without_vibration(self, arms: ArmFilter, force: Vec3, state: FlightState, dt_s: float) -> Vec3:
        if state.lock_is_in(Mode.RIGID):
            arms.reset()
            return force
        m = self._mass
        ax, ay = arms.remove(force[0] / m, force[1] / m, dt_s)
        return (m * ax, m * ay, force[2])

    def _variance(self, force: Vec3, up: Vec3, noise2: float) -> Vec3:
        """Return the variance per axis, N2: white noise, thrust error and attitude error."""
        t, a = self._thrust_variance, self._attitude_variance
        x, y, z = force
        ux, uy, uz = up
        every = noise2 + a * (x * x + y * y + z * z)
        return (
            every + t * ux * ux - a * x * x,
            every + t * uy * uy - a * y * y,
            every + t * uz * uz - a * z * z,
        )

    def _attitude_at(self, t_us: int, rate_frd: Vec3) -> Quaternion | None:
        """Extrapolate the nearest stored attitude by the gyro's rate; return None if there is none near."""
        best: AttitudeSample | None = None
        away = _ATTITUDE_REACH_US
        for sample in reversed(self._attitudes):
            distance = abs(sample.t_us - t_us)
            if distance <= away:
                best, away = sample, distance
            elif sample.t_us < t_us:
                break  # the remaining attitudes are older
        if best is None:
            return None
        return advance_attitude(best.q_frd_to_ned, rate_frd, (t_us - best.t_us) * 1e-6)
