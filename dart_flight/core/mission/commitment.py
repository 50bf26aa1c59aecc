"""The decision at the last moment for stopping: whether to continue to a wall while the lock still moves.

An approach continues while holding position would still stop the vehicle before the wall. After that moment,
the approach continues only under two conditions. The lock must settle `SETTLED_BEFORE_S` before the impact,
and the impact must be acceptable in *both* modes. If a servo without feedback is stuck, the impact occurs in
the mode that was not planned. Executive, planner and `check` use this rule.
"""

from __future__ import annotations

import math

from dart_flight.base.arithmetic import Number, hypot, maximum, where
from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Collision, Mission
from dart_flight.config.mission_file import BoundsSpec, Limits
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.contact.coefficients import CoefficientArrays
from dart_flight.contact.contact_map import contact_map
from dart_flight.contact.law import Onset
from dart_flight.core.mission.position_loop import PlaneImpact
from dart_flight.core.mission.recovery import recovery_offset, recovery_point
from dart_flight.core.sense.state import FlightState

# Minimum predicted distance of the stop from the wall; a break-off, which brakes harder, stops earlier.
STOP_MARGIN_M = 0.02
# The lock must settle this long before the predicted impact: timing error plus one poll of the lock.
SETTLED_BEFORE_S = 0.05
# The paper's plan has a setpoint 0.5 m outside the bounds. A much farther one pulls the vehicle astray.
SETPOINT_OUTSIDE_M = 2.0


def setpoint_outside_m(bounds: BoundsSpec, x: Number, y: Number) -> Number:
    """Return how far a setpoint lies outside the horizontal bounds; 0 inside."""
    beside = maximum(bounds.x[0] - x, x - bounds.x[1])
    return maximum(maximum(beside, maximum(bounds.y[0] - y, y - bounds.y[1])), 0.0)


def may_commit(
    mission: Mission, following: Collision, met: PlaneImpact, ready_s: float, state: FlightState
) -> bool:
    """Return whether to continue past the last moment for stopping.

    Args:
        following: the collision ahead.
        met: predicted impact with the wall.
        ready_s: time until the lock is settled; infinite if the lock is in fault or overdue.
    """
    if ready_s > met.after_s - SETTLED_BEFORE_S:
        return False
    vx, vy, _ = state.velocity
    wall, (tx, ty) = following.wall, following.wall.tangent
    place = wall.foot((state.position[0] + vx * met.after_s, state.position[1] + vy * met.after_s))
    return bool(
        is_acceptable_in_either_mode(
            mission.vehicle,
            mission.limits,
            mission.bounds,
            wall,
            (following.alpha_normal_m_per_n, following.alpha_tangential_m_per_n),
            place,
            (met.normal_m_s, vx * tx + vy * ty),
        )
    )


def is_acceptable_in_either_mode(
    vehicle: VehicleConfig,
    limits: Limits,
    bounds: BoundsSpec,
    wall: Wall,
    alphas_m_per_n: tuple[float, float],
    place: tuple[Number, Number],
    velocity_m_s: tuple[Number, Number],
) -> Number:
    """Return whether an impact meets the limits of force, tilt and flight space in every mode of the arms.

    Args:
        bounds: the flight space; the recovery setpoint may lie `SETPOINT_OUTSIDE_M` outside.
        alphas_m_per_n: gains (A_n, A_t) of the recovery setpoint.
        place: position of the vehicle's centre at the impact, mission frame, metres.
        velocity_m_s: (normal, tangential) velocity at the impact, collision frame.
    """
    normal, tangential = velocity_m_s
    px4, bearable = vehicle.px4, True
    most_m_s2 = GRAVITY_M_S2 * math.tan(math.radians(px4.mpc_tiltmax_air))
    for mode in vehicle.modes:
        c = CoefficientArrays.from_table(vehicle.materials[wall.material].coefficients(mode))
        hit = contact_map(c, vehicle.airframe.mass_kg, normal, tangential, Onset(vehicle.onset))
        friction = where(tangential < 0.0, 1.0, -1.0) * hit.peak_friction_force_n
        peaks = (hit.peak_normal_force_n, friction)
        away, onward = recovery_offset(peaks, alphas_m_per_n)
        force = hypot(hit.peak_normal_force_n, hit.peak_friction_force_n)
        push_n = px4.mpc_xy_p * away - hit.normal_out_m_s
        push_t = px4.mpc_xy_p * onward - hit.tangential_out_m_s
        command = px4.mpc_xy_vel_p_acc * hypot(push_n, push_t)
        x, y = recovery_point(place, wall.normal, peaks, alphas_m_per_n)
        bearable = (
            bearable
            & (force <= limits.peak_force_n)
            & (command <= most_m_s2)
            & (setpoint_outside_m(bounds, x, y) <= SETPOINT_OUTSIDE_M)
        )
    return bearable
