"""What impacts a mission may plan: its own force limit, and what flights with a real PX4 have shown.

The sweep of docs/px4.md (acrylic and wood, both modes, 0.5 to 4 m/s) sets the figures here.
"""

from __future__ import annotations

import math

from dart_flight.config.mission import Collision, Mission
from dart_flight.contact.collision_map import collide
from dart_flight.contact.law import Onset

FLOWN_UP_TO_M_S = 4.0  # normal speed: the sweep's end, survived in both modes
CLIP_SHARE = 0.95  # of full scale: what is left for tilt, noise and friction
# Of full scale. At 254 N (1.25) the estimate was off by 0.15 to 0.26 m, at 295 N (1.45) by 1.3 m.
LOST_SHARE = 1.3


def expected_force_n(mission: Mission, collision: Collision) -> float | None:
    """Peak of the contact force (normal and friction together) in newton that a collision will bring.

    From the planned approach and the contact law, else from the planner's prediction (its normal force); None
    where the mission says neither, as for a wall that a recovery leads to.
    """
    if collision.approach_m_s is None:
        return collision.predicted.peak_force_n if collision.predicted is not None else None
    vehicle = mission.vehicle
    coefficients = vehicle.materials[collision.wall.material].of(collision.mode)
    normal, tangential = collision.approach_m_s
    hit = collide(coefficients, vehicle.airframe.mass_kg, normal, tangential, Onset(vehicle.onset))
    return math.hypot(hit.peak_normal_force_n, hit.peak_friction_force_n)


def impact_problem(mission: Mission) -> str | None:
    """Why a mission must not be flown: an impact beyond its own limit; None where there is no reason."""
    for collision in mission.collisions:
        force = expected_force_n(mission, collision)
        if force is not None and force > mission.limits.peak_force_n:
            return (
                f"collision {collision.index} with {collision.wall.name} will peak at {force:.0f} N, over "
                f"limits.peak_force_n {mission.limits.peak_force_n:g}"
            )
    return None


def impact_warnings(mission: Mission) -> list[str]:
    """What a person should know of a mission's impacts before it flies, a line each."""
    warnings = []
    full_n = mission.vehicle.airframe.mass_kg * mission.vehicle.imu.full_scale_m_s2
    for collision in mission.collisions:
        where = f"collision {collision.index} with {collision.wall.name}"
        force = expected_force_n(mission, collision)
        if force is not None and force > LOST_SHARE * full_n:
            warnings.append(
                f"{where} will peak at {force:.0f} N, {force / full_n:.1f} times the accelerometer's full "
                f"scale ({full_n:.0f} N): PX4 loses its position by more than a metre (docs/px4.md)"
            )
        elif force is not None and force > CLIP_SHARE * full_n:
            warnings.append(
                f"{where} will peak at {force:.0f} N, at or beyond the accelerometer's full scale "
                f"({full_n:.0f} N): the measured force will be a lower bound and PX4's estimate will be "
                "shaken (docs/px4.md)"
            )
        if collision.approach_m_s is not None and -collision.approach_m_s[0] > FLOWN_UP_TO_M_S:
            warnings.append(
                f"{where} at {-collision.approach_m_s[0]:g} m/s is faster than anything flown with PX4 "
                f"({FLOWN_UP_TO_M_S:g} m/s)"
            )
    return warnings
