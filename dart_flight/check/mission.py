"""What can be judged of a mission without a vehicle."""

from __future__ import annotations

import math

from dart_flight.check.findings import Finding
from dart_flight.config.mission import Collision, Mission
from dart_flight.core.mission.approach import NoApproachError, plan_approach
from dart_flight.core.mission.planned import expected_hit, impact_velocity
from dart_flight.core.mission.recovery import recovery_point
from dart_flight.core.sense.detector import ImpactDetector
from dart_flight.planning.envelope import (
    clipping_warning,
    full_scale_n,
    speed_warning,
)

_CLEARANCE_M = 0.15  # of start and goal from a wall's plane
_WEAK = 1.3  # an impact below this many thresholds may be missed


def check_mission(mission: Mission) -> list[Finding]:
    """What can be judged without a vehicle."""
    findings = _check_places(mission)
    for collision in mission.collisions:
        findings += _check_approach(mission, collision)
        findings += _check_force(mission, collision)
        findings += _check_noise(mission, collision)
        findings += _check_speed(mission, collision)
        findings += _check_recovery(mission, collision)
        findings += _check_servo(mission, collision)
    findings += _check_coefficients(mission)
    return findings


def _check_places(mission: Mission) -> list[Finding]:
    findings = []
    for name, point in (("start", mission.start), ("goal", mission.goal.position_m)):
        near = [
            (wall.signed_distance(point), wall.name)
            for wall in mission.walls
            if wall.spans(point) and abs(wall.signed_distance(point)) < _CLEARANCE_M
        ]
        for distance, wall_name in near:
            says = f"{name} is {distance:.2f} m from wall {wall_name}, less than {_CLEARANCE_M:g} m"
            findings.append(Finding(f"{name}_clearance", False, says))
    for wall in mission.walls:
        if mission.bounds.excess2(wall.point) > 0.0:
            says = f"the middle of wall {wall.name} lies outside of bounds_m: it could not be flown to"
            findings.append(Finding("wall_bounds", False, says))
    if not findings:
        findings.append(
            Finding("places", True, "start, goal and walls lie within the bounds, clear of each other")
        )
    return findings


def _check_approach(mission: Mission, collision: Collision) -> list[Finding]:
    item = f"approach_{collision.index}"
    if collision.approach_m_s is None:
        says = f"wall {collision.wall.name} is reached by the recovery from the collision before"
        return [Finding(item, True, says)]
    try:
        approach = plan_approach(mission, collision)
    except NoApproachError as error:
        return [Finding(item, False, str(error))]
    limit = mission.limits.speed_m_s
    if approach.speed_m_s > limit or mission.vehicle.flying.transit_speed_m_s > limit:
        return [Finding(item, False, f"{approach.speed_m_s:.2f} m/s is over limits.speed_m_s {limit:g}")]
    says = (
        f"run-up of {approach.length_m:.2f} m, wall {collision.wall.name} met at "
        f"{approach.speed_m_s:.2f} m/s after {approach.impact_s:.1f} s"
    )
    return [Finding(item, True, says)]


def _check_force(mission: Mission, collision: Collision) -> list[Finding]:
    item, wall = f"force_{collision.index}", collision.wall.name
    hit = expected_hit(mission, collision)
    if hit is None:
        return [Finding(item, True, f"wall {wall}: not predicted in the mission (`plan` writes it)")]
    normal, friction = hit.peak_normal_force_n, hit.peak_friction_force_n
    force, limit = math.hypot(normal, friction), mission.limits.peak_force_n
    detection = mission.vehicle.detection.force_threshold_n
    says = f"wall {wall}: {force:.0f} N predicted ({normal:.0f} normal, {friction:.0f} along)"
    if force > limit:
        return [Finding(item, False, f"{says}, over limits.peak_force_n {limit:g}")]
    if normal < _WEAK * detection:
        weak = f"{says}, too near the detection threshold of {detection:g} N: it may go unnoticed"
        return [Finding(item, False, weak)]
    clipping = clipping_warning(mission, collision)
    if clipping is not None:
        # At full scale the recovery is too weak and PX4's estimate is shaken; just below it is a remark.
        go = force <= full_scale_n(mission)
        return [Finding(item, go, clipping, remark=go)]
    return [Finding(item, True, f"{says}, limit {limit:g} N")]


def _check_noise(mission: Mission, collision: Collision) -> list[Finding]:
    """Whether the hit could be told from the vibration that is assumed until one is measured in flight."""
    hit, vehicle = expected_hit(mission, collision), mission.vehicle
    if hit is None or vehicle.detection.noise_sigma <= 0.0:
        return []
    floor = ImpactDetector(vehicle).floor_n(hit.contact_time_s)
    if hit.peak_normal_force_n >= floor:
        return []
    says = (
        f"{collision.mode.value}, {hit.peak_normal_force_n:.1f} N at wall {collision.wall.name}: with "
        f"vibration of {vehicle.estimation.imu_noise_m_s2:g} m/s2 only {floor:.1f} N is sure to be felt; "
        "`feel` says what yours is"
    )
    return [Finding(f"noise_{collision.index}", True, says, remark=True)]


def _check_speed(mission: Mission, collision: Collision) -> list[Finding]:
    """Whether an impact so fast has been survived with a real PX4."""
    warning = speed_warning(collision)
    return [] if warning is None else [Finding(f"speed_{collision.index}", False, warning)]


def _check_recovery(mission: Mission, collision: Collision) -> list[Finding]:
    """Where the recovery leads: to the next wall where that is the plan, and not into one otherwise."""
    hit, item = expected_hit(mission, collision), f"recovery_{collision.index}"
    place = collision.impact_point or (collision.predicted.position_m if collision.predicted else None)
    velocity = impact_velocity(collision)
    if hit is None or place is None or velocity is None:
        return []
    along = math.copysign(hit.peak_friction_force_n, -velocity[1])  # friction is against the motion
    target = recovery_point(
        (place[0], place[1], 0.0),
        collision.wall.normal,
        hit.peak_normal_force_n,
        along,
        collision.alpha_normal_m_per_n,
        collision.alpha_tangential_m_per_n,
        mission.altitude_m,
    )
    says = f"set-point after wall {collision.wall.name} about ({target[0]:.2f}, {target[1]:.2f})"
    following = next((c for c in mission.collisions if c.index == collision.index + 1), None)
    if following is not None and following.approach_m_s is None:
        beyond = following.wall.signed_distance(target)
        if beyond > 0.0:
            short = f"{says}: {beyond:.2f} m short of wall {following.wall.name}, which it should lead to"
            return [Finding(item, False, short)]
        return [Finding(item, True, f"{says}, leads to wall {following.wall.name}")]
    for wall in mission.walls:
        crossed = wall.signed_distance(place) > 0.0 >= wall.signed_distance(target)
        if wall is not collision.wall and crossed and wall.spans(target):
            return [Finding(item, False, f"{says}: behind wall {wall.name}, which is not to be hit next")]
    outside = mission.bounds.excess2(target)
    if outside > 0.0:
        says += f", {outside:.2f} m outside bounds_m: the goal must be passed before"
    return [Finding(item, True, says)]


def _check_servo(mission: Mission, collision: Collision) -> list[Finding]:
    """Whether the lock can be in the next mode before the wall that the recovery leads to."""
    following = next((c for c in mission.collisions if c.index == collision.index + 1), None)
    if following is None or following.approach_m_s is not None or following.mode is collision.mode:
        return []
    lock, item = mission.vehicle.lock, f"servo_{following.index}"
    needed = lock.relaxation_s + lock.switch_time_s
    here, there = collision.predicted, following.predicted
    hit = expected_hit(mission, collision)
    if here is not None and there is not None:
        free = there.t_s - here.t_s - here.contact_time_s
        how = "predicted"
    elif hit is not None and collision.impact_point is not None:
        # The quickest that the way can be flown within the mission's speed limit.
        way = following.wall.signed_distance(collision.impact_point)
        free = way / mission.limits.speed_m_s
        how = "at least"
    else:
        return []
    says = f"the lock needs {needed:.2f} s between the contacts, {how} {free:.2f} s there are"
    go = free >= needed or how == "at least"
    if free < needed and go:
        says += "; where it is late, the approach is broken off in flight"
    return [Finding(item, go, says)]


def _check_coefficients(mission: Mission) -> list[Finding]:
    findings = []
    for name in sorted({c.wall.material for c in mission.collisions}):
        source = mission.vehicle.materials[name].source
        assumed = "assumed" in source or not source
        note = " (assumed: the flight may differ; `identify` measures)" if assumed else ""
        findings.append(Finding(f"material_{name}", True, f"{name}: {source or 'no source given'}{note}"))
    return findings
