"""PX4's multicopter control cascade (P-PID), with PX4's parameter names: position, velocity, attitude, rate.

The cascade follows the controller diagrams in PX4's documentation. P on position gives a velocity, and PID on
velocity gives an acceleration. The acceleration gives a thrust vector and, with the yaw, an attitude. P on
the attitude error gives body rates, which correct the tilt before the heading. PID on the rates gives
torques, which the allocation converts to motor commands.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

from dart_flight.base.geometry import (
    GRAVITY_M_S2,
    Quaternion,
    Vec3,
    body_up,
    quaternion_conjugate,
    quaternion_multiply,
    quaternion_normalise,
    wrap_angle,
)
from dart_flight.config.vehicle import Motor, Thrust
from dart_flight.sim.allocation import Allocation

_FREE = (math.nan, math.nan, math.nan)
_MAX_RATE = (math.radians(220.0), math.radians(220.0), math.radians(200.0))  # MC_*RATE_MAX defaults
_NOT_SUMMED = math.radians(400.0)  # rate error above which the rate error is not integrated
_MAX_YAW: Final = 0.15  # limit of the normalised yaw torque
_YAW_WEIGHT: Final = 0.4  # MC_YAW_WEIGHT default
_HORIZONTAL_MARGIN: Final = 0.3  # MPC_THR_XY_MARG default: thrust kept for horizontal control when saturated


class TrajectorySetpoint:
    """Setpoint of the position controller, NED; NaN components are not controlled."""

    def __init__(
        self,
        position: Vec3 = _FREE,
        velocity: Vec3 = _FREE,
        acceleration: Vec3 = _FREE,
        yaw: float = math.nan,
    ) -> None:
        self.position, self.velocity, self.acceleration, self.yaw = position, velocity, acceleration, yaw


class Cascade:
    """The controllers with their states.

    Args:
        parameters: PX4 parameters by name; read at every step, so that a PARAM_SET takes effect.
        hover_thrust: MPC_THR_HOVER, the value that PX4's hover thrust estimator would find.
        thrust: thrust curve (THR_MDL_FAC), which the cascade inverts.
        motors: CA_ROTOR*.
    """

    def __init__(
        self, parameters: Mapping[str, float], hover_thrust: float, thrust: Thrust, motors: Sequence[Motor]
    ) -> None:
        self.parameters, self.hover, self.thrust = parameters, hover_thrust, thrust
        self._allocation, self._full_n, self._curve = Allocation(motors), thrust.max_thrust_n, thrust.curve
        self._velocity_integral: list[float] = [0.0, 0.0, 0.0]
        self._velocity_last: Vec3 | None = None
        self._velocity_slope: list[float] = [0.0, 0.0, 0.0]
        self._rate_integral: list[float] = [0.0, 0.0, 0.0]
        self._rate_last: Vec3 = (0.0, 0.0, 0.0)
        self.attitude_setpoint: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self.thrust_setpoint = 0.0

    def reset(self) -> None:
        """Reset the integrals, as PX4 does while landed."""
        self._velocity_integral = [0.0, 0.0, 0.0]
        self._rate_integral = [0.0, 0.0, 0.0]
        self._velocity_last = None

    # -- position and velocity --

    def update_position(
        self, setpoint: TrajectorySetpoint, position: Vec3, velocity: Vec3, yaw: float, dt_s: float
    ) -> None:
        """Set attitude and thrust setpoints from a trajectory setpoint (all NED)."""
        g = self.parameters
        self._differentiate(velocity, dt_s)
        wanted = self._velocity_setpoint(setpoint, position)
        gains = (
            (g["MPC_XY_VEL_P_ACC"], g["MPC_XY_VEL_I_ACC"], g["MPC_XY_VEL_D_ACC"]),
            (g["MPC_XY_VEL_P_ACC"], g["MPC_XY_VEL_I_ACC"], g["MPC_XY_VEL_D_ACC"]),
            (g["MPC_Z_VEL_P_ACC"], g["MPC_Z_VEL_I_ACC"], g["MPC_Z_VEL_D_ACC"]),
        )
        acceleration = [0.0, 0.0, 0.0]
        error = [0.0, 0.0, 0.0]
        for i in range(3):
            p, _, d = gains[i]
            feedforward = setpoint.acceleration[i]
            acceleration[i] = 0.0 if math.isnan(feedforward) else feedforward
            if not math.isnan(wanted[i]):
                error[i] = wanted[i] - velocity[i]
                acceleration[i] += p * error[i] + self._velocity_integral[i] - d * self._velocity_slope[i]
        thrust = self._thrust_vector(acceleration)
        achieved = (thrust[0] * GRAVITY_M_S2 / self.hover, thrust[1] * GRAVITY_M_S2 / self.hover)
        for i in range(2):
            # Anti-windup: the part removed by tilt and thrust limits is not integrated.
            excess = acceleration[i] - achieved[i]
            if abs(excess) > 1e-6 and excess * error[i] > 0.0:
                error[i] -= 2.0 / gains[i][0] * excess
        for i in range(3):
            step = error[i] * gains[i][1] * dt_s
            bound = GRAVITY_M_S2 if i == 2 else 100.0
            self._velocity_integral[i] = max(-bound, min(bound, self._velocity_integral[i] + step))
        self._attitude_from_thrust(thrust, setpoint.yaw if not math.isnan(setpoint.yaw) else yaw)

    def _differentiate(self, velocity: Vec3, dt_s: float) -> None:
        if self._velocity_last is not None and dt_s > 0.0:
            alpha = dt_s / (dt_s + 1.0 / (2.0 * math.pi * self.parameters["MPC_VELD_LP"]))
            for i in range(3):
                slope = (velocity[i] - self._velocity_last[i]) / dt_s
                self._velocity_slope[i] += alpha * (slope - self._velocity_slope[i])
        self._velocity_last = velocity

    def _velocity_setpoint(self, setpoint: TrajectorySetpoint, position: Vec3) -> Vec3:
        g = self.parameters
        kp = (g["MPC_XY_P"], g["MPC_XY_P"], g["MPC_Z_P"])
        wanted = [math.nan, math.nan, math.nan]
        for i in range(3):
            feedforward = setpoint.velocity[i]
            if not math.isnan(setpoint.position[i]):
                wanted[i] = kp[i] * (setpoint.position[i] - position[i])
                if not math.isnan(feedforward):
                    wanted[i] += feedforward
            else:
                wanted[i] = feedforward
        speed = math.hypot(wanted[0], wanted[1])
        if speed > g["MPC_XY_VEL_MAX"]:
            wanted[0] *= g["MPC_XY_VEL_MAX"] / speed
            wanted[1] *= g["MPC_XY_VEL_MAX"] / speed
        wanted[2] = max(-g["MPC_Z_VEL_MAX_UP"], min(g["MPC_Z_VEL_MAX_DN"], wanted[2]))
        return (wanted[0], wanted[1], wanted[2])

    def _thrust_vector(self, acceleration: list[float]) -> Vec3:
        """Return the normalised thrust vector, NED. At the thrust limit, the vertical part has priority."""
        g = self.parameters
        limit = math.tan(math.radians(g["MPC_TILTMAX_AIR"])) * GRAVITY_M_S2
        ax, ay = acceleration[0], acceleration[1]
        size = math.hypot(ax, ay)
        if size > limit:
            ax, ay = ax * limit / size, ay * limit / size
        per_g = self.hover / GRAVITY_M_S2
        vertical = -self.hover + acceleration[2] * per_g
        vertical = min(-g["MPC_THR_MIN"], vertical)
        top = g["MPC_THR_MAX"]
        vertical = max(vertical, -math.sqrt(top * top - _HORIZONTAL_MARGIN * _HORIZONTAL_MARGIN))
        # The lateral acceleration follows from the tilt, independently of the vertical thrust.
        tx, ty = ax * per_g, ay * per_g
        room = math.sqrt(max(0.0, top * top - vertical * vertical))
        lateral = math.hypot(tx, ty)
        if lateral > room:
            tx, ty = tx * room / lateral, ty * room / lateral
        return (tx, ty, vertical)

    def _attitude_from_thrust(self, thrust: Vec3, yaw: float) -> None:
        size = math.sqrt(thrust[0] ** 2 + thrust[1] ** 2 + thrust[2] ** 2)
        z = (-thrust[0] / size, -thrust[1] / size, -thrust[2] / size)
        # Body y is perpendicular to the heading direction; body x completes the frame.
        heading = (math.cos(yaw), math.sin(yaw), 0.0)
        y = _unit(_cross(z, heading))
        x = _cross(y, z)
        self.attitude_setpoint = _quaternion_from_axes(x, y, z)
        self.thrust_setpoint = size

    # -- attitude, rate, allocation --

    def update_attitude(self, q: Quaternion, rate: Vec3, dt_s: float) -> tuple[float, ...]:
        """Return motor commands, 0 to 1."""
        g = self.parameters
        error = _attitude_error(q, self.attitude_setpoint)
        sign = 2.0 if error[0] >= 0.0 else -2.0
        axes = (
            (g["MC_ROLL_P"], g["MC_ROLLRATE_P"], g["MC_ROLLRATE_I"], g["MC_ROLLRATE_D"]),
            (g["MC_PITCH_P"], g["MC_PITCHRATE_P"], g["MC_PITCHRATE_I"], g["MC_PITCHRATE_D"]),
            (g["MC_YAW_P"] / _YAW_WEIGHT, g["MC_YAWRATE_P"], g["MC_YAWRATE_I"], 0.0),
        )
        torque = [0.0, 0.0, 0.0]
        integral, last = self._rate_integral, self._rate_last
        for i, (kp, p, ki, d) in enumerate(axes):
            most, now, summed = _MAX_RATE[i], rate[i], integral[i]
            rate_error = max(-most, min(most, kp * sign * error[i + 1])) - now
            torque[i] = p * rate_error + summed - d * ((now - last[i]) / dt_s)
            share = max(0.0, 1.0 - (rate_error / _NOT_SUMMED) ** 2)
            integral[i] = max(-0.3, min(0.3, summed + share * ki * rate_error * dt_s))
        self._rate_last = rate
        yaw = max(-_MAX_YAW, min(_MAX_YAW, torque[2]))
        shares = self._allocation.shares(torque[0], torque[1], yaw, self.thrust_setpoint)
        full_n, curve = self._full_n, self._curve
        if curve is None:
            return tuple(self.thrust.commands_for([max(0.0, share) * full_n for share in shares]))
        return tuple([curve.command_for(max(0.0, share) * full_n) for share in shares])


def _attitude_error(q: Quaternion, wanted: Quaternion) -> Quaternion:
    """Return the rotation from the current attitude `q` to the desired attitude, in body axes.

    The shortest rotation corrects the thrust direction first. The remaining rotation about that direction is
    commanded only in part (MC_YAW_WEIGHT). A single rotation would mix both corrections: at a heading error
    of 180 degrees, it would tilt the vehicle sideways instead of levelling the vehicle.
    """
    up, up_wanted = body_up(q), body_up(wanted)
    cosine = up[0] * up_wanted[0] + up[1] * up_wanted[1] + up[2] * up_wanted[2]
    if cosine < -0.9999:  # the vehicle is upside down: every rotation is equally short
        return quaternion_multiply(quaternion_conjugate(q), wanted)
    w = math.sqrt(0.5 * (1.0 + cosine))
    x, y, z = _cross(up, up_wanted)
    shortest = (w, 0.5 * x / w, 0.5 * y / w, 0.5 * z / w)
    level = quaternion_multiply(quaternion_normalise(shortest), q)
    rest = quaternion_multiply(quaternion_conjugate(level), wanted)
    turn = 0.5 * _YAW_WEIGHT * wrap_angle(2.0 * math.atan2(rest[3], rest[0]))
    aimed = quaternion_multiply(level, (math.cos(turn), 0.0, 0.0, math.sin(turn)))
    return quaternion_multiply(quaternion_conjugate(q), aimed)


def _cross(a: Vec3, b: Vec3) -> Vec3:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _unit(a: Vec3) -> Vec3:
    size = math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    return (a[0] / size, a[1] / size, a[2] / size)


def _quaternion_from_axes(x: Vec3, y: Vec3, z: Vec3) -> Quaternion:
    """Return the attitude of a body whose axes point along `x`, `y` and `z` in the world."""
    trace = x[0] + y[1] + z[2]
    # Of the four formulas for a quaternion, use the best conditioned one.
    if trace > 0.0:
        s = 2.0 * math.sqrt(1.0 + trace)
        q = (0.25 * s, (y[2] - z[1]) / s, (z[0] - x[2]) / s, (x[1] - y[0]) / s)
    elif x[0] > y[1] and x[0] > z[2]:
        s = 2.0 * math.sqrt(1.0 + x[0] - y[1] - z[2])
        q = ((y[2] - z[1]) / s, 0.25 * s, (y[0] + x[1]) / s, (z[0] + x[2]) / s)
    elif y[1] > z[2]:
        s = 2.0 * math.sqrt(1.0 + y[1] - x[0] - z[2])
        q = ((z[0] - x[2]) / s, (y[0] + x[1]) / s, 0.25 * s, (z[1] + y[2]) / s)
    else:
        s = 2.0 * math.sqrt(1.0 + z[2] - x[0] - y[1])
        q = ((x[1] - y[0]) / s, (z[0] + x[2]) / s, (z[1] + y[2]) / s, 0.25 * s)
    return quaternion_normalise(q)
