"""The sensors of the simulated vehicle, with noise, bias and delay.

Both autopilots use IMU, motion capture and GPS; PX4 also uses barometer and magnetometer.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final, NamedTuple

from dart_flight.base.geometry import (
    Quaternion,
    Vec3,
    add,
    quaternion_conjugate,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    rotate,
    scale,
)
from dart_flight.config.vehicle import ImuRinging, VehicleConfig
from dart_flight.sim.noise import GaussianNoise
from dart_flight.sim.plant import Plant

# Standard deviations per axis: a Pixhawk's sensors, and motion capture with millimetre accuracy.
IMU_BIAS_M_S2: Final = 0.05
GYRO_NOISE_RAD_S: Final = 0.01
POSE_NOISE_M: Final = 0.001
ATTITUDE_NOISE_RAD: Final = 0.002
_ROUNDING_S: Final = 1e-9  # tolerance, so that rounding does not delay a pose by one tick


class ImuSensor:
    """Accelerometer and gyro with noise.

    The accelerometer averages over one tick, has a constant bias and saturates at full scale.
    """

    def __init__(self, vehicle: VehicleConfig, noise: GaussianNoise) -> None:
        s = vehicle.simulation
        self._noise = noise
        self._sigma, self._gyro_sigma = s.imu_noise_m_s2, GYRO_NOISE_RAD_S
        self.full_scale_m_s2 = vehicle.imu.full_scale_m_s2
        self.bias: Vec3 = noise.three(IMU_BIAS_M_S2)
        ringing = s.imu_ringing
        self._ringing = None if ringing is None else _Ringing(ringing, vehicle.imu.tick_s, noise)

    def measure(
        self, specific_force_frd: Vec3, rate_frd: Vec3, motors_turn: bool = True
    ) -> tuple[Vec3, Vec3]:
        """Return specific force (m/s2) and body rate (rad/s) of one tick, FRD.

        Vibration is added only while the motors turn, so PX4 can align its estimator before the take-off.
        """
        (x, y, z), (bx, by, bz), scale = specific_force_frd, self.bias, self.full_scale_m_s2
        nx, ny, nz = self._noise.three(self._sigma)
        nx, ny, nz = x + bx + nx, y + by + ny, z + bz + nz
        if self._ringing is not None and motors_turn:
            nx, ny, nz = add((nx, ny, nz), self._ringing.next())
        read = (_saturate(x, nx, scale), _saturate(y, ny, scale), _saturate(z, nz, scale))
        return read, add(rate_frd, self._noise.three(self._gyro_sigma))


class _Ringing:
    """A vibration of the frame: white noise, and a tone of wandering frequency with a phase for each axis."""

    _WANDER_S = 1.0  # time for the tone's frequency to cross its band

    def __init__(self, config: ImuRinging, tick_s: float, noise: GaussianNoise) -> None:
        self._config, self._tick_s, self._noise = config, tick_s, noise
        rng = noise.rng
        self._low, self._high = config.tone_hz_low, config.tone_hz_high
        self._hz = rng.uniform(self._low, self._high)
        self._phase = 0.0
        self._shift = (rng.uniform(0.0, math.tau), rng.uniform(0.0, math.tau), rng.uniform(0.0, math.tau))

    def next(self) -> Vec3:
        """Return the vibration of the next tick, m/s2, FRD."""
        c = self._config
        white = self._noise.three(c.white_m_s2)
        if c.tone_m_s2 <= 0.0:
            return white
        step = (self._high - self._low) * math.sqrt(self._tick_s / self._WANDER_S)
        self._hz = max(self._low, min(self._high, self._hz + self._noise.one(step)))
        self._phase = (self._phase + math.tau * self._hz * self._tick_s) % math.tau
        top = math.sqrt(2.0) * c.tone_m_s2
        a, b, d = self._shift
        tone = (
            top * math.sin(self._phase + a),
            top * math.sin(self._phase + b),
            top * math.sin(self._phase + d),
        )
        return add(white, tone)


def _saturate(true: float, noisy: float, scale: float) -> float:
    """Limit a reading to full scale; if the true value is beyond a limit, return the limit without noise."""
    if not -scale < true < scale:
        return math.copysign(scale, true)
    return noisy if -scale < noisy < scale else math.copysign(scale, noisy)


class PoseSensor:
    """Motion capture: position and attitude at a fixed rate, with noise and delay."""

    def __init__(self, vehicle: VehicleConfig, noise: GaussianNoise) -> None:
        s = vehicle.simulation
        self._noise = noise
        self._period_s = 1.0 / s.pose_rate_hz
        self._delay_s = s.pose_delay_s
        self.offset_ned: Vec3 = (0.0, 0.0, 0.0)  # offset of the room's origin, which a fault may set
        self._next_s = 0.0
        self._pending: deque[tuple[float, Vec3, Quaternion]] = deque()

    def measure(self, plant: Plant) -> tuple[float, Vec3, Quaternion] | None:
        """Return time of measurement (s), position (NED, m) and attitude, or None if no pose arrives now."""
        now = plant.time_s
        if now >= self._next_s:
            self._next_s += self._period_s
            twist = quaternion_from_rotation_vector(self._noise.three(ATTITUDE_NOISE_RAD))
            position = add(add(plant.position, self.offset_ned), self._noise.three(POSE_NOISE_M))
            self._pending.append((now, position, quaternion_multiply(plant.q, twist)))
        if self._pending and self._pending[0][0] + self._delay_s <= now + _ROUNDING_S:
            return self._pending.popleft()
        return None


class Barometer:
    """A barometer: static pressure of the standard atmosphere, with noise."""

    SIGMA_HPA = 0.01  # about 8 cm

    def __init__(self, noise: GaussianNoise, home_altitude_m: float) -> None:
        self._noise, self._home = noise, home_altitude_m

    def measure(self, plant: Plant) -> tuple[float, float]:
        """Return static pressure (hPa) and pressure altitude (m)."""
        true_hpa = pressure_hpa(self._home - plant.position[2])
        measured = true_hpa + self._noise.one(self.SIGMA_HPA)
        return measured, altitude_m(measured)


def pressure_hpa(altitude_amsl_m: float) -> float:
    """Return the pressure (hPa) of the international standard atmosphere, below 11 km."""
    return float(1013.25 * (1.0 - 2.25577e-5 * altitude_amsl_m) ** 5.25588)


def altitude_m(pressure: float) -> float:
    """Return the altitude above mean sea level (m) at a pressure (hPa); inverts `pressure_hpa`."""
    return float((1.0 - (pressure / 1013.25) ** (1.0 / 5.25588)) / 2.25577e-5)


class Magnetometer:
    """A magnetometer: the earth's magnetic field in the body frame, with noise."""

    SIGMA_GAUSS = 0.002

    def __init__(self, noise: GaussianNoise, field_ned_gauss: Vec3) -> None:
        self._noise, self._field = noise, field_ned_gauss

    def measure(self, plant: Plant) -> Vec3:
        """Return the magnetic field in gauss, FRD."""
        body = rotate(quaternion_conjugate(plant.q), self._field)
        return add(body, self._noise.three(self.SIGMA_GAUSS))


class GpsQuality(NamedTuple):
    """The accuracy of a receiver; the error is a first-order Gauss-Markov process plus white noise.

    Attributes:
        fix_type: MAVLink's GPS_FIX_TYPE, such as 3 for 3D or 6 for RTK fixed.
        wander_m, wander_s: standard deviation and correlation time of the position's Gauss-Markov error. The
            standard deviation is per horizontal axis; the vertical value is 1.5 times as large.
        noise_m, velocity_noise_m_s: standard deviations of the white noise of position and velocity.
        eph_m, epv_m: horizontal and vertical accuracy that the receiver reports.
        velocity_wander_m_s, velocity_wander_s: standard deviation and correlation time of the Gauss-Markov
            error of the Doppler velocity.
    """

    fix_type: int
    wander_m: float
    wander_s: float
    noise_m: float
    velocity_noise_m_s: float
    eph_m: float
    epv_m: float
    velocity_wander_m_s: float = 0.0
    velocity_wander_s: float = 20.0


# The total standard deviation is 0.02 m for RTK and 1 m without corrections.
GPS_QUALITIES: Final[dict[str, GpsQuality]] = {
    "rtk": GpsQuality(6, 0.0173, 20.0, 0.01, 0.03, 0.02, 0.03),
    "plain": GpsQuality(3, 1.0, 60.0, 0.05, 0.1, 0.9, 1.5, 0.03),
}


GPS_QUALITIES["anchored"] = GPS_QUALITIES["plain"]


class GpsFix(NamedTuple):
    """A fix: time of measurement (s), and position (m) and velocity (m/s) in the plant's NED frame."""

    t_s: float
    position_ned: Vec3
    velocity_ned: Vec3


class GpsReceiver:
    """A GPS receiver: fixes at a fixed rate, with wandering error, noise and delay."""

    RATE_HZ = 10.0
    DELAY_S = 0.1

    def __init__(self, quality: GpsQuality, noise: GaussianNoise) -> None:
        self.quality, self._noise = quality, noise
        self._period_s = 1.0 / self.RATE_HZ
        self._decay = math.exp(-self._period_s / quality.wander_s)
        self._velocity_decay = math.exp(-self._period_s / quality.velocity_wander_s)
        self._wander = self._scaled(quality.wander_m)
        self._velocity_wander = self._scaled(quality.velocity_wander_m_s)
        self._next_s = 0.0
        self._pending: deque[tuple[float, GpsFix]] = deque()

    def measure(self, plant: Plant) -> GpsFix | None:
        """Return the fix that arrives at this tick."""
        now = plant.time_s
        if now >= self._next_s:
            self._next_s += self._period_s
            q = self.quality
            self._wander = self._advance_error(self._wander, q.wander_m, self._decay)
            drift = self._advance_error(self._velocity_wander, q.velocity_wander_m_s, self._velocity_decay)
            self._velocity_wander = drift
            position = add(add(plant.position, self._wander), self._noise.three(q.noise_m))
            velocity = add(add(plant.velocity, drift), self._noise.three(q.velocity_noise_m_s))
            self._pending.append((now, GpsFix(now, position, velocity)))
        if self._pending and self._pending[0][0] + self.DELAY_S <= now:
            return self._pending.popleft()[1]
        return None

    def _advance_error(self, wander: Vec3, sd: float, decay: float) -> Vec3:
        """Return a first-order Gauss-Markov error after one more fix."""
        return add(scale(wander, decay), self._scaled(sd * math.sqrt(1.0 - decay * decay)))

    def _scaled(self, sigma: float) -> Vec3:
        x, y, z = self._noise.three(sigma)
        return (x, y, 1.5 * z)
