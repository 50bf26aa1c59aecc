"""Limits on planned impacts: the mission's own force limit, and the range that flights have covered.

The limits of speed and force come from the flights in docs/px4.md. These flights are a sweep (acrylic and
wood, both modes, 0.5 to 4 m/s) and impacts of a body with guards. The limits of incidence and height come
from the flights in docs/results/body.md and docs/results/guard_height.md. A `_warning` returns None if
there is nothing to warn about. If the mission specifies no velocity, the function uses its argument
`velocity`: the predicted (normal, tangential) velocity.
"""

from __future__ import annotations

import math

import numpy as np

from dart_flight.base.records import AfterImpact, Mode
from dart_flight.config.mission import Collision, Mission
from dart_flight.config.vehicle import BodyModel, VehicleConfig
from dart_flight.core.mission.planned_impact import expected_hit, impact_velocity

# Largest normal speed without a warning; a body with guards tilts by more than 60 degrees at 3.5 m/s
# (docs/px4.md).
FLOWN_UP_TO_M_S = 3.0
# Flights recovered from all impacts up to this incidence: up to 2 m/s in both modes, up to 3 m/s if rigid.
INCIDENCE_FLOWN_DEG = 30.0
# Largest distances (m) of DART's guards from the centre of mass at which the tilt stays below 60 degrees
# (docs/results/guard_height.md). Columns: normal speed (m/s); distance below with rigid arms, and with
# flexible arms; distance above. If the guards are below the centre of mass, impact and setpoint tilt the
# vehicle in the same direction, so the limit is lower.
HEIGHTS_FLOWN_M = (
    (1.0, 0.100, 0.100, 0.10),
    (1.25, 0.060, 0.060, 0.08),
    (1.5, 0.050, 0.040, 0.05),
    (2.0, 0.030, 0.020, 0.05),
    (2.5, 0.010, 0.005, 0.04),
    (3.0, 0.005, 0.0, 0.03),
)
# Moment of inertia over mass of the vehicle that flew HEIGHTS_FLOWN_M. An impact rotates a vehicle by its
# momentum times the height over the moment of inertia, so a smaller ratio lowers the limits.
FLOWN_INERTIA_PER_MASS_M2 = 0.0125 / 1.3
# [ours] Exponent of that ratio for the speed at which the limits are read, fitted to flights of two vehicles.
_SPEED_EXPONENT = -0.25
HEIGHT_SURE_SD = 2.0  # `check` allows for a height error of this many standard deviations
CLIP_SHARE = 0.95  # usable fraction of full scale; the rest is a margin for tilt, noise and friction
# Above this fraction of full scale, PX4 loses its position. At 254 N (fraction 1.25) the position was wrong
# by 0.16 to 0.26 m, and at 296 N (1.45) by 1.3 m.
LOST_SHARE = 1.3


def full_scale_n(mission: Mission) -> float:
    return mission.vehicle.airframe.mass_kg * mission.vehicle.imu.full_scale_m_s2


def expected_force_n(mission: Mission, collision: Collision) -> float | None:
    """Return a collision's expected peak force, normal and friction combined, or None if it is unknown."""
    hit = expected_hit(mission, collision)
    return None if hit is None else math.hypot(hit.peak_normal_force_n, hit.peak_friction_force_n)


def impact_problem(mission: Mission) -> str | None:
    """Return the reason not to fly if an impact exceeds the mission's force limit."""
    for collision in mission.collisions:
        force = expected_force_n(mission, collision)
        if force is not None and force > mission.limits.peak_force_n:
            return (
                f"collision {collision.index} with {collision.wall.name} will peak at {force:.0f} N, "
                f"limits.peak_force_n is {mission.limits.peak_force_n:g} N"
            )
    return None


def clipping_warning(mission: Mission, collision: Collision) -> str | None:
    """Warn about an impact at or above the accelerometer's full scale."""
    force, full_n = expected_force_n(mission, collision), full_scale_n(mission)
    if force is None or force <= CLIP_SHARE * full_n:
        return None
    where = f"{_name(collision)} will peak at {force:.0f} N"
    if force > LOST_SHARE * full_n:
        return (
            f"{where}, {force / full_n:.1f} times the accelerometer's full scale ({full_n:.0f} N): PX4's "
            "position will be wrong by more than a metre (docs/px4.md)"
        )
    return (
        f"{where}, at or beyond the accelerometer's full scale ({full_n:.0f} N): the measured force will be "
        "a lower bound and PX4's estimate will be disturbed (docs/px4.md)"
    )


def speed_warning(collision: Collision, velocity: tuple[float, float] | None = None) -> str | None:
    """Warn about an impact that is faster than all impacts from which PX4 reliably recovered."""
    velocity = impact_velocity(collision) or velocity
    if velocity is None or -velocity[0] <= FLOWN_UP_TO_M_S:
        return None
    return (
        f"{_name(collision)} at {-velocity[0]:.3g} m/s exceeds {FLOWN_UP_TO_M_S:g} m/s, the highest speed "
        "from which a vehicle with guards reliably recovered on PX4 (docs/px4.md)"
    )


def impact_yaw(mission: Mission, collision: Collision) -> float:
    """Return the planned heading at a collision, mission frame, radians.

    An approach turns the vehicle parallel to the wall that it approaches; a recovery keeps the heading.
    """
    yaw = 0.0
    for one in mission.collisions[: collision.index]:
        if one.approach_m_s is not None:
            yaw = one.wall.parallel_yaw(yaw)
    return yaw


def incidence_deg(mission: Mission, collision: Collision) -> float:
    """Return the planned angle of incidence of a collision, 0 to 45."""
    return math.degrees(collision.wall.incidence(impact_yaw(mission, collision)))


def max_incidence_deg(vehicle: VehicleConfig, mode: Mode) -> float:
    """Return the largest angle of incidence at which flights have recovered from impacts.

    In the flexible mode the limit is at most `incidence_rigid_deg`, because unlocked arms do not fold at
    larger angles.
    """
    arms = vehicle.airframe.incidence_rigid_deg if mode is Mode.FLEXIBLE else INCIDENCE_FLOWN_DEG
    return min(arms, INCIDENCE_FLOWN_DEG)


def incidence_warning(mission: Mission, collision: Collision) -> str | None:
    """Warn about an impact whose incidence exceeds the limit of its mode."""
    planned, most = incidence_deg(mission, collision), max_incidence_deg(mission.vehicle, collision.mode)
    if planned <= most:
        return None
    return (
        f"{_name(collision)} has an incidence of {planned:.0f} degrees, but "
        f"{collision.mode.value} arms tolerate {most:g}: "
        "give the collision its own approach, which turns the vehicle parallel to the wall"
    )


def heights_flown_m(vehicle: VehicleConfig, normal_m_s: float, mode: Mode) -> tuple[float, float]:
    """Return how far below and above the centre of mass the guards may be for a proven recovery, metres.

    The limits of DART are lowered for a vehicle with a smaller moment of inertia per mass.
    """
    airframe = vehicle.airframe
    per_mass_m2 = min(airframe.inertia_kg_m2[:2]) / airframe.mass_kg
    scale = min(1.0, per_mass_m2 / FLOWN_INERTIA_PER_MASS_M2)
    speed = normal_m_s * scale**_SPEED_EXPONENT
    speeds, rigid, flexible, above = zip(*HEIGHTS_FLOWN_M, strict=True)
    below = rigid if mode is Mode.RIGID else flexible
    return scale * float(np.interp(speed, speeds, below)), scale * float(np.interp(speed, speeds, above))


def is_leaned(mission: Mission, collision: Collision) -> bool:
    """Return whether the vehicle tilts to compensate for the guards' height that an earlier touch measured.

    The vehicle tilts only before an impact at the end of a mission's trajectory (docs/replanning.md).
    """
    touched = any(c.index < collision.index for c in mission.collisions)
    return touched and collision.trajectory is not None and mission.after_impact is AfterImpact.REPLAN


def height_warning(
    mission: Mission, collision: Collision, velocity: tuple[float, float] | None = None
) -> str | None:
    """Warn about guards that may be too far below or above the centre of mass."""
    contact = mission.vehicle.simulation.contact
    velocity = impact_velocity(collision) or velocity
    if velocity is None or contact.body is BodyModel.POINT:
        return None
    below, above = heights_flown_m(mission.vehicle, -velocity[0], collision.mode)
    height, sd = contact.guard_height_m, contact.guard_height_sd_m
    slack = 0.0 if is_leaned(mission, collision) else HEIGHT_SURE_SD * sd
    if -below <= height - slack and height + slack <= above:
        return None
    where = "level with" if height == 0.0 else f"{abs(height):g} m {'below' if height < 0.0 else 'above'}"
    allowed = f" (standard deviation {sd:g} m)" if slack else ""
    return (
        f"{_name(collision)} at {-velocity[0]:.2f} m/s with guards {where} the centre of mass{allowed} may "
        f"turn the vehicle over: flights recovered with guards {below:.3f} m below to {above:.3f} m above. "
        "Hit the wall more slowly, or touch a wall first and let `plan` choose the trajectory"
    )


def impact_warnings(mission: Mission) -> list[str]:
    found = (
        warning
        for collision in mission.collisions
        for warning in (
            clipping_warning(mission, collision),
            speed_warning(collision),
            incidence_warning(mission, collision),
            height_warning(mission, collision),
        )
    )
    return [warning for warning in found if warning is not None]


def _name(collision: Collision) -> str:
    return f"collision {collision.index} with {collision.wall.name}"
