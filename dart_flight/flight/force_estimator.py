"""Acceleration-based estimate of the external force (paper, Sec. IV-A; `docs/concepts.md`).

    force = m R f - R T + m diag(b) v

with f the specific force of the IMU (gravity is not in it), T the thrust vector, R body to mission, b the air
drag along the mission's axes. Streams are aligned by the autopilot's stamps: attitude is carried to the
IMU's stamp with the gyro, thrust is the motors' lagged response to the commands in force by then.
"""

from __future__ import annotations

import math
from collections import deque

from dart_flight.config.vehicle import VehicleConfig
from dart_flight.flight.state import FlightState
from dart_flight.geometry import advance_attitude, rotate
from dart_flight.samples import ActuatorSample, AttitudeSample, ForceEstimate, ImuSample

_ATTITUDE_REACH_US = 60_000  # older attitudes are not carried on by the gyro
_CLIP_SHARE = 0.99  # a reading this near full scale is a lower bound
_HISTORY = 32


class ForceEstimator:
    """External force on the vehicle, one estimate for every IMU sample with an attitude near it."""

    def __init__(self, vehicle: VehicleConfig) -> None:
        self._mass = vehicle.airframe.mass_kg
        self._drag = vehicle.airframe.drag_per_s
        self._thrust = vehicle.thrust
        self._lag_s = vehicle.thrust.motor_lag_s
        self._clip = _CLIP_SHARE * vehicle.imu.full_scale_m_s2
        self._attitudes: deque[AttitudeSample] = deque(maxlen=_HISTORY)
        self._commands: deque[ActuatorSample] = deque(maxlen=_HISTORY)
        self._motors: list[float] | None = None
        self._last_us: int | None = None

    def take_attitude(self, sample: AttitudeSample) -> None:
        """Remember an attitude."""
        self._attitudes.append(sample)

    def take_actuator(self, sample: ActuatorSample) -> None:
        """Remember motor commands."""
        self._commands.append(sample)

    def estimate(self, imu: ImuSample, state: FlightState) -> ForceEstimate | None:
        """Force in newton, mission frame, at the IMU's stamp; None without an attitude near it."""
        thrust_n = self._thrust_at(imu.t_us)
        attitude = self._attitude_near(imu.t_us)
        if attitude is None or state.frame is None:
            return None
        dt = (imu.t_us - attitude.t_us) * 1e-6
        q = advance_attitude(attitude.q_frd_to_ned, imu.rate_frd, dt)
        fx, fy, fz = imu.specific_force_frd
        m = self._mass
        force = state.frame.vector_from_ned(rotate(q, (m * fx, m * fy, m * fz + thrust_n)))
        v, b = state.velocity, self._drag
        clip = self._clip
        return ForceEstimate(
            t_us=imu.t_us,
            force_mission=(
                force[0] + m * b[0] * v[0],
                force[1] + m * b[1] * v[1],
                force[2] + m * b[2] * v[2],
            ),
            clipped=abs(fx) >= clip or abs(fy) >= clip or abs(fz) >= clip,
        )

    def _attitude_near(self, t_us: int) -> AttitudeSample | None:
        best: AttitudeSample | None = None
        for sample in reversed(self._attitudes):
            if best is None or abs(sample.t_us - t_us) < abs(best.t_us - t_us):
                best = sample
            else:
                break  # stamps only get older from here
        if best is None or abs(best.t_us - t_us) > _ATTITUDE_REACH_US:
            return None
        return best

    def _thrust_at(self, t_us: int) -> float:
        """Total thrust in newton: the motors' first-order response up to `t_us`."""
        command: ActuatorSample | None = None
        for sample in reversed(self._commands):
            command = sample
            if sample.t_us <= t_us:
                break
        if command is None:
            return self._mass * 9.81  # nothing known yet: hover
        if self._motors is None or self._last_us is None:
            self._motors = list(command.motors)
        else:
            decay = math.exp(-(t_us - self._last_us) * 1e-6 / self._lag_s) if self._lag_s > 0.0 else 0.0
            for i in range(4):
                self._motors[i] = command.motors[i] + (self._motors[i] - command.motors[i]) * decay
        self._last_us = t_us
        force_n = self._thrust.force_n
        motors = self._motors
        return force_n(motors[0]) + force_n(motors[1]) + force_n(motors[2]) + force_n(motors[3])
