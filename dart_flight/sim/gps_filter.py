"""A small Kalman filter, which gives the embedded autopilot's estimator its gains with GPS."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from dart_flight.base.geometry import Vec3


class GpsWeights(NamedTuple):
    """The noise and the accelerometer bias that the filter assumes.

    Attributes:
        position_m, velocity_m_s: assumed noise of a fix, EKF2_GPS_P_NOISE and EKF2_GPS_V_NOISE.
        standing_bias_ned: accelerometer bias estimated before take-off, m/s2.
    """

    position_m: float
    velocity_m_s: float
    standing_bias_ned: Vec3


class GpsFilter:
    """A Kalman filter for position, velocity and accelerometer bias, with the same gains for every axis."""

    _ACCELERATION_M_S2: Final = 0.35  # PX4's EKF2_ACC_NOISE, for samples at 100 Hz
    _BIAS_M_S3: Final = 0.003  # EKF2_ACC_B_NOISE
    _SAMPLE_S: Final = 0.01

    def __init__(self, weights: GpsWeights) -> None:
        self._noise = np.diag([weights.position_m**2, weights.velocity_m_s**2])
        self._p = np.diag([weights.position_m**2, 0.1**2, 0.01**2])
        self._since_s = 0.0

    @property
    def position_sd_m(self) -> float:
        """Standard deviation of the horizontal position."""
        return float(np.sqrt(2.0 * self._p[0, 0]))

    def predict(self, dt_s: float) -> None:
        self._since_s += dt_s

    def correct(self) -> tuple[tuple[float, float], ...]:
        """Return the gains of position, velocity and bias for a fix's position and for a fix's velocity."""
        h, self._since_s = self._since_s, 0.0
        step = np.array([[1.0, h, 0.5 * h * h], [0.0, 1.0, h], [0.0, 0.0, 1.0]])
        q = (self._ACCELERATION_M_S2**2) * self._SAMPLE_S * h
        grown = np.diag([q * h * h / 3.0, q, (self._BIAS_M_S3**2) * self._SAMPLE_S * h])
        p = step @ self._p @ step.T + grown
        gain = p[:, :2] @ np.linalg.inv(p[:2, :2] + self._noise)
        self._p = p - gain @ p[:2, :]
        return tuple((float(row[0]), float(row[1])) for row in gain)
