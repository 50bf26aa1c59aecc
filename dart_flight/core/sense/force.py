"""Acceleration-based estimate of the external force (paper, Sec. IV-A; docs/force.md).

    force = m R f - R T + m diag(b) v

Here f is the specific force at the centre of mass, without gravity, and T is the thrust vector. R rotates
from body to mission, and b is the air drag along the mission's axes. `core/sense/vehicle_motion.py` aligns
the streams and computes the first two terms. `Senses` is the only user of this module.
"""

from __future__ import annotations

from typing import Final

from dart_flight.base.filters import LowPass
from dart_flight.base.geometry import Vec3
from dart_flight.base.records import ForceEstimate, ImuSample, Mode
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.sense.arm_vibration import ArmFilter
from dart_flight.core.sense.state import FlightState
from dart_flight.core.sense.vehicle_motion import VehicleMotion

ATTITUDE_ERROR_RAD: Final = 0.01  # standard deviation of PX4's attitude
FILTER_S: Final = 0.02  # time constant of the filtered force, which is for display only
_CLIP_SHARE: Final = 0.99  # a reading above this fraction of full scale counts as clipped


class ForceEstimator:
    """Estimator of the external force."""

    def __init__(self, vehicle: VehicleConfig) -> None:
        e = vehicle.estimation
        self._mass = vehicle.airframe.mass_kg
        self._drag = vehicle.airframe.drag_per_s
        self._clip = _CLIP_SHARE * vehicle.imu.full_scale_m_s2
        self._thrust_variance = e.thrust_error_n**2
        self._attitude_variance = ATTITUDE_ERROR_RAD**2
        self._filter = LowPass(FILTER_S)
        self._arms = ArmFilter(e.arm_vibration, vehicle.imu.tick_s) if e.arm_vibration else None

    def estimate(self, imu: ImuSample, motion: VehicleMotion, state: FlightState) -> ForceEstimate:
        """Return the external force at an IMU sample, newton, mission frame; `motion` includes the sample."""
        m, v, b, up = self._mass, state.velocity, self._drag, motion.up
        drag = (m * b[0] * v[0], m * b[1] * v[1], m * b[2] * v[2])
        push = (motion.thrust_n * up[0] - drag[0], motion.thrust_n * up[1] - drag[1])
        x, y, z = motion.residual_n
        force = (x + drag[0], y + drag[1], z + drag[2])
        if self._arms is not None:
            force = self._without_vibration(self._arms, force, state, motion.dt_s)
        clip, noise = self._clip, m * motion.hover.noise_m_s2
        rx, ry, rz = imu.specific_force_frd
        clipped = abs(rx) >= clip or abs(ry) >= clip or abs(rz) >= clip
        variance = self._variance(force, up, noise * noise)
        filtered = self._filter.update(force, motion.dt_s)
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
