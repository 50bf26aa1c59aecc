"""PX4's horizontal position loop as a point mass: the predicted motion towards a setpoint.

Per axis, with p the position, v the velocity, and a the acceleration at the current attitude:

    a_cmd = kv (kp (p_ref - p) - v) - kd a,     da/dt = (a_cmd - a) / tau

kp, kv, kd are MPC_XY_P, MPC_XY_VEL_P_ACC, MPC_XY_VEL_D_ACC; tau is the lag of attitude loop and motors.
`least_distance_m` omits the velocity integral and drag: both have little effect during braking, which takes
about half a second. The planner's model (`flight_model`) includes velocity integral and drag.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from dart_flight.base.arithmetic import Number, maximum, minimum, where
from dart_flight.base.walls import Wall
from dart_flight.config.vehicle import Px4Parameters
from dart_flight.core.mission.wall_uncertainty import position_margin_m

# Lag of attitude loop (MC_ROLL_P 6.5) and motors; tests/planning/test_against_plant.py checks the value.
ATTITUDE_LAG_S = 0.15


STOP_TIME_S = 0.5  # ratio of the loop's stopping distance to the speed
_STEP_S = 0.01
_BEHIND_M = 0.3  # a vehicle farther behind the plane is on the wall's other side


def stop_share(
    walls: Iterable[Wall], position: tuple[Number, Number], velocity: tuple[Number, Number]
) -> Number:
    """Return the fraction of the stopping distance that the vehicle can fly before a wall stops it.

    The stopping distance is the distance flown in `STOP_TIME_S`. Without a wall ahead, the result is 1.
    Position and velocity are horizontal, mission frame.
    """
    share: Number = 1.0
    (x, y), (vx, vy) = position, velocity
    for wall in walls:
        here = wall.signed_distance(position)
        there = wall.signed_distance((x + STOP_TIME_S * vx, y + STOP_TIME_S * vy))
        within = wall.spans(position)
        behind_m = _BEHIND_M + position_margin_m(wall, position) if wall.is_uncertain else _BEHIND_M
        if wall.thickness_m is not None:
            behind_m = minimum(behind_m, wall.behind_m)
        stops = (here > there) & (there < 0.0) & (here > -behind_m) & within
        way = where(stops, here - there, 1.0)
        share = where(stops, minimum(share, maximum(here / way, 0.0)), share)
    return share


class PositionLoop(NamedTuple):
    """Gains of the horizontal loop: kp 1/s, kv 1/s, ki 1/s2, kd, and the lag tau in s."""

    kp: float
    kv: float
    ki: float
    kd: float
    tau: float

    @classmethod
    def from_px4(cls, px4: Px4Parameters) -> PositionLoop:
        return cls(
            px4.mpc_xy_p, px4.mpc_xy_vel_p_acc, px4.mpc_xy_vel_i_acc, px4.mpc_xy_vel_d_acc, ATTITUDE_LAG_S
        )


class PlaneImpact(NamedTuple):
    """Predicted impact with a plane: time from now, and the (negative) velocity along the outward normal."""

    after_s: float
    normal_m_s: float


def predict_impact(
    distance_m: float,
    closing_speed_m_s: float,
    closing_acceleration_m_s2: float,
    target_distance_m: float,
    px4: Px4Parameters,
    horizon_s: float = 2.0,
) -> PlaneImpact | None:
    """Predict when a vehicle that flies to a setpoint hits a plane; None if not within `horizon_s`.

    The arguments are those of `least_distance_m`.
    """
    h = _STEP_S
    before = distance_m
    for n, (x, v) in enumerate(
        _course(distance_m, closing_speed_m_s, closing_acceleration_m_s2, target_distance_m, px4, horizon_s),
        start=1,
    ):
        if x <= 0.0:
            share = before / (before - x) if before > x else 1.0
            return PlaneImpact((n - 1 + share) * h, v)
        before = x
    return None


def least_distance_m(
    distance_m: float,
    closing_speed_m_s: float,
    closing_acceleration_m_s2: float,
    target_distance_m: float,
    px4: Px4Parameters,
    horizon_s: float = 2.0,
) -> float:
    """Predict the smallest signed distance from a plane while the vehicle flies to a setpoint.

    If the distance only increases, this is the current distance. `target_distance_m` is the distance of the
    setpoint from the plane; speed and acceleration are positive towards the plane.
    """
    nearest = distance_m
    for x, v in _course(
        distance_m, closing_speed_m_s, closing_acceleration_m_s2, target_distance_m, px4, horizon_s
    ):
        if x < nearest:
            nearest = x
        elif v > 0.0:
            break
    return nearest


def _course(
    distance_m: float,
    closing_speed_m_s: float,
    closing_acceleration_m_s2: float,
    target_distance_m: float,
    px4: Px4Parameters,
    horizon_s: float,
) -> Iterator[tuple[float, float]]:
    """Yield the distance from a plane and the velocity along its normal after every step."""
    kp, kv, kd = px4.mpc_xy_p, px4.mpc_xy_vel_p_acc, px4.mpc_xy_vel_d_acc
    x, v, a, h = distance_m, -closing_speed_m_s, -closing_acceleration_m_s2, _STEP_S
    for _ in range(round(horizon_s / h)):
        command = kv * (kp * (target_distance_m - x) - v) - kd * a
        a += h * (command - a) / ATTITUDE_LAG_S
        v += h * a
        x += h * v
        yield x, v
