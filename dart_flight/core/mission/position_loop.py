"""PX4's horizontal position loop as a point mass: what a set-point will do to the vehicle.

Per axis, with p the position, v the velocity, a the acceleration the attitude has reached:

    a_cmd = kv (kp (p_ref - p) - v) - kd a,     da/dt = (a_cmd - a) / tau

kp, kv, kd are MPC_XY_P, MPC_XY_VEL_P_ACC, MPC_XY_VEL_D_ACC; tau stands for attitude loop and motors.
`least_distance_m` leaves the velocity integral and drag out: within the half second of a braking they do not
move much. The planner (`flight_model`) has both.
"""

from __future__ import annotations

from typing import NamedTuple

from dart_flight.config.vehicle import Px4Parameters

# Attitude loop (MC_ROLL_P 6.5) and motors; held to the plant in tests/planning/test_against_plant.py.
ATTITUDE_LAG_S = 0.15


class Loop(NamedTuple):
    """Gains of the horizontal loop: kp 1/s, kv 1/s, ki 1/s2, kd, and the lag tau in s."""

    kp: float
    kv: float
    ki: float
    kd: float
    tau: float

    @classmethod
    def of(cls, px4: Px4Parameters) -> Loop:
        """The loop of a vehicle with these parameters."""
        return cls(
            px4.mpc_xy_p, px4.mpc_xy_vel_p_acc, px4.mpc_xy_vel_i_acc, px4.mpc_xy_vel_d_acc, ATTITUDE_LAG_S
        )


def least_distance_m(
    distance_m: float,
    closing_speed_m_s: float,
    closing_acceleration_m_s2: float,
    target_distance_m: float,
    px4: Px4Parameters,
    horizon_s: float = 2.0,
) -> float:
    """Nearest that the vehicle comes to a plane when told now to go to a distance from it.

    Args:
        distance_m: present signed distance to the plane.
        closing_speed_m_s: speed towards the plane.
        closing_acceleration_m_s2: acceleration towards the plane.
        target_distance_m: distance of the set-point from the plane.
        px4: gains.
        horizon_s: how far to look ahead.

    Returns:
        The smallest signed distance in metres within the horizon; the present one where it only grows.
    """
    kp, kv, kd = px4.mpc_xy_p, px4.mpc_xy_vel_p_acc, px4.mpc_xy_vel_d_acc
    x, v, a = distance_m, -closing_speed_m_s, -closing_acceleration_m_s2
    nearest, h = x, 0.01
    for _ in range(round(horizon_s / h)):
        command = kv * (kp * (target_distance_m - x) - v) - kd * a
        a += h * (command - a) / ATTITUDE_LAG_S
        v += h * a
        x += h * v
        if x < nearest:
            nearest = x
        elif v > 0.0:
            break
    return nearest
