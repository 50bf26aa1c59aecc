"""What the simulated vehicle can measure of itself: IMU and motion capture, with noise, bias and delay."""

from __future__ import annotations

import random
from collections import deque

from dart_flight.config.vehicle import VehicleConfig
from dart_flight.geometry import Quaternion, Vec3, add, quaternion_from_rotation_vector, quaternion_multiply
from dart_flight.sim.plant import Plant


def gauss3(rng: random.Random, sigma: float) -> Vec3:
    """Three independent normal numbers of the same standard deviation."""
    return (rng.gauss(0.0, sigma), rng.gauss(0.0, sigma), rng.gauss(0.0, sigma))


class ImuSensor:
    """Accelerometer and gyro: tick averages with noise, a constant residual bias, saturated at full scale."""

    def __init__(self, vehicle: VehicleConfig, rng: random.Random) -> None:
        s = vehicle.simulation
        self._rng = rng
        self._sigma, self._gyro_sigma = s.imu_noise_m_s2, s.gyro_noise_rad_s
        self.full_scale_m_s2 = vehicle.imu.full_scale_m_s2
        self.bias: Vec3 = gauss3(rng, s.imu_bias_m_s2)

    def measure(self, specific_force_frd: Vec3, rate_frd: Vec3) -> tuple[Vec3, Vec3]:
        """(specific force m/s2, body rate rad/s), FRD, as reported for one tick."""
        noisy = add(add(specific_force_frd, self.bias), gauss3(self._rng, self._sigma))
        s = self.full_scale_m_s2
        clipped = (
            max(-s, min(s, noisy[0])),
            max(-s, min(s, noisy[1])),
            max(-s, min(s, noisy[2])),
        )
        return clipped, add(rate_frd, gauss3(self._rng, self._gyro_sigma))


class PoseSensor:
    """Motion capture: position and attitude at a rate, with noise, reported after a delay."""

    def __init__(self, vehicle: VehicleConfig, rng: random.Random) -> None:
        s = vehicle.simulation
        self._rng = rng
        self._period_s = 1.0 / s.pose_rate_hz
        self._delay_s, self._sigma, self._attitude_sigma = (
            s.pose_delay_s,
            s.pose_noise_m,
            s.attitude_noise_rad,
        )
        self.offset_ned: Vec3 = (0.0, 0.0, 0.0)  # of the motion capture's origin; a fault moves it
        self._next_s = 0.0
        self._pending: deque[tuple[float, Vec3, Quaternion]] = deque()

    def measure(self, plant: Plant) -> tuple[float, Vec3, Quaternion] | None:
        """(time of the measurement in s, position NED, attitude), or None where none arrives at this tick."""
        now = plant.time_s
        if now >= self._next_s:
            self._next_s += self._period_s
            twist = quaternion_from_rotation_vector(gauss3(self._rng, self._attitude_sigma))
            position = add(add(plant.position, self.offset_ned), gauss3(self._rng, self._sigma))
            self._pending.append((now, position, quaternion_multiply(plant.q, twist)))
        if self._pending and self._pending[0][0] + self._delay_s <= now:
            return self._pending.popleft()
        return None
