"""The checks of a mission file without a vehicle: positions, path, collisions, recoveries, materials."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Sequence
from datetime import date
from pathlib import Path

from dart_flight.base.geometry import Vec3
from dart_flight.base.records import AfterImpact, Mode
from dart_flight.check.findings import CheckFinding
from dart_flight.check.probe_check import check_located_wall, check_probe
from dart_flight.config.material_history import HistoryEntry, newest_entry, read_history
from dart_flight.config.mission import Collision, Mission
from dart_flight.core.mission.approach import (
    NoApproachError,
    TransitSegment,
    check_segments_clear,
    is_blocked,
    is_blocked_by_post,
    plan_approach,
    plan_transit,
    transit_segments,
)
from dart_flight.core.mission.commitment import SETPOINT_OUTSIDE_M, setpoint_outside_m
from dart_flight.core.mission.planned_impact import describe_force, expected_hit, impact_velocity
from dart_flight.core.mission.position_loop import STOP_TIME_S, stop_share
from dart_flight.core.mission.recovery import recovery_point
from dart_flight.core.mission.wall_uncertainty import position_margin_m
from dart_flight.core.sense.detector import ImpactDetector
from dart_flight.planning.constraints import leads_behind
from dart_flight.planning.envelope import (
    clipping_warning,
    full_scale_n,
    height_warning,
    incidence_deg,
    incidence_warning,
    speed_warning,
)
from dart_flight.planning.predicted_flight import (
    PredictedFlight,
    describe_goal_miss,
    predict_mission,
    predicted_segments,
)
from dart_flight.recording.later_flights import AGREES, contradicts, later_excesses, mean_excess

_FLAT_DEG = 10.0  # incidence angle above which one guard carries most of the force
_CLEARANCE_M = 0.15  # minimum distance of start and goal from a wall's plane
_WEAK = 1.3  # minimum ratio of an impact's force to the detection threshold; a weaker impact may be missed
_SAME_M = 1e-6
_NOT_MEASURED = ("assumed", "[example]")  # words in a material's source that mean "not measured"
_LEG_POINTS = 50
_PEAK_SPEED = 1.875  # ratio of a transit's peak speed to its mean speed


def predict_flight_path(mission: Mission) -> PredictedFlight | None:
    """Return the flight that the planner's model predicts.

    The result is None if the position of a wall is still unknown, or if an approach cannot be flown. Other
    checks report the reason.
    """
    if any(c.wall.sought for c in mission.collisions):
        return None
    try:
        check_segments_clear(mission)
        for collision in mission.collisions:
            if collision.approach_m_s is not None:
                plan_approach(mission, collision)
    except NoApproachError:
        return None
    return predict_mission(mission)


def check_places(mission: Mission) -> list[CheckFinding]:
    """Check that start, goal, waypoints and walls lie within the bounds and clear of each other."""
    findings = []
    places = [("start", mission.start), ("goal", mission.goal.position_m)]
    places += [(w.name, w.position[:2]) for w in mission.waypoints if w.position is not None]
    for name, point in places:
        near = [
            wall
            for wall in mission.walls
            if wall.spans(point)
            and abs(wall.signed_distance(point)) < _CLEARANCE_M + position_margin_m(wall, point)
            and wall.signed_distance(point) >= -wall.behind_m
        ]
        for wall in near:
            distance = wall.signed_distance(point)
            message = f"{name} is {distance:.2f} m from wall {wall.name}, minimum {_CLEARANCE_M:g} m"
            if distance >= _CLEARANCE_M:
                margin_m = position_margin_m(wall, point)
                message += f"; the wall's position is uncertain, so it may be up to {margin_m:.2f} m nearer"
            findings.append(CheckFinding(f"{name.replace(' ', '_')}_clearance", False, message))
        for post in mission.posts:
            if is_blocked_by_post(mission, post, point, point):
                away = post.distance_to_segment(point, point) - post.radius_m
                message = f"{name} is {away:.2f} m from post {post.name}, too near for the vehicle"
                findings.append(CheckFinding(f"{name.replace(' ', '_')}_clearance", False, message))
    to_be_hit = {collision.wall.name for collision in mission.collisions}
    for wall in mission.walls:
        excess_m = mission.bounds.excess2(wall.point)
        if wall.name in to_be_hit and excess_m > 0.0:
            message = (
                f"wall {wall.name} is to be hit, but its middle is {excess_m:.2f} m outside bounds_m: extend "
                "bounds_m beyond it"
            )
            findings.append(CheckFinding("wall_bounds", False, message))
    for post in mission.posts:
        if mission.bounds.excess2(post.centre) > post.radius_m:
            message = f"post {post.name} is outside bounds_m and blocks no path"
            findings.append(CheckFinding("post_bounds", True, message, remark=True))
    if not findings:
        findings.append(
            CheckFinding("places", True, "start, goal and walls are within bounds_m and clear of each other")
        )
    return findings


def check_waypoints(mission: Mission, planned: PredictedFlight | None) -> list[CheckFinding]:
    """Check that no wall is between waypoints and that each leg reaches its requested speed."""
    legs = predicted_segments(mission, {} if planned is None else planned.hits)
    if not legs:
        return []
    try:
        check_segments_clear(mission)
    except NoApproachError as error:
        return [CheckFinding("waypoints", False, str(error))]
    if mission.vehicle.flying.transit_speed_m_s > mission.limits.speed_m_s:
        message = f"flying.transit_speed_m_s exceeds limits.speed_m_s {mission.limits.speed_m_s:g}"
        return [CheckFinding("waypoints", False, message)]
    known = [(leg, plan_transit(mission, leg, leg.begin)) for leg in legs if leg.begin is not None]
    way_m = sum(math.dist(t.begin, leg.end) for leg, t in known)
    held_s = sum(w.hold_s for w in mission.waypoints if w.position is not None) + mission.goal.hold_s
    flown_s = sum(t.duration_s for _, t in known) + held_s
    pauses = sum(w.position is None for w in mission.waypoints)
    message = f"the legs between stops are {way_m:.1f} m long and take {flown_s:.0f} s, including holds"
    if len(known) < len(legs):
        message += f", plus {len(legs) - len(known)} legs of unknown length after a contact"
    message += f", plus {pauses} pause{'s' if pauses > 1 else ''}" if pauses else ""
    findings = [CheckFinding("waypoints", True, message)]
    asked = {leg.name for leg in transit_segments(mission) if leg.begin is not None}
    for leg, transit in known:
        if leg.name not in asked:
            continue
        peak = _PEAK_SPEED * math.dist(transit.begin, leg.end) / transit.duration_s
        if leg.speed_m_s > peak + 0.01 > 0.02:
            slower = (
                f"{leg.name}: the path is too short for {leg.speed_m_s:g} m/s, the peak is {peak:.2f} m/s"
            )
            findings.append(CheckFinding("waypoint_speed", True, slower, remark=True))
    return findings


def check_collisions(mission: Mission, planned: PredictedFlight | None) -> Iterator[CheckFinding]:
    """Check each collision: approach, force, noise, envelope, recovery and time for the lock."""
    for collision in mission.collisions:
        if collision.wall.sought and collision.probe is None:
            yield from check_located_wall(collision)
            yield from _check_force(mission, collision)
            continue
        yield from _check_approach(mission, collision, planned)
        if collision.probe is not None:
            yield from check_probe(mission, collision, collision.probe)
            continue
        yield from _check_force(mission, collision)
        yield from _check_noise(mission, collision)
        yield from _check_envelope(mission, collision, planned)
        yield from _check_recovery(mission, collision, planned)
        yield from _check_servo(mission, collision)


def _check_approach(
    mission: Mission, collision: Collision, planned: PredictedFlight | None
) -> list[CheckFinding]:
    item = f"approach_{collision.index}"
    if collision.approach_m_s is None:
        return [_describe_arrival(mission, collision, planned)]
    try:
        approach = plan_approach(mission, collision)
    except NoApproachError as error:
        return [CheckFinding(item, False, str(error))]
    limit, speed_m_s = mission.limits.speed_m_s, math.hypot(*collision.approach_velocity())
    if speed_m_s > limit or mission.vehicle.flying.transit_speed_m_s > limit:
        return [CheckFinding(item, False, f"{speed_m_s:.2f} m/s exceeds limits.speed_m_s {limit:g}")]
    if collision.probe is not None:
        message = (
            f"if the probe for wall {collision.wall.name} touches nothing, the probe ends after "
            f"{approach.duration_s:.1f} s"
        )
        return [CheckFinding(item, True, message)]
    assert collision.impact_point is not None
    length_m = math.dist(approach.begin[:2], collision.impact_point)
    way = f"run-up of {length_m:.2f} m" if collision.trajectory is None else "a trajectory"
    message = (
        f"{way}, impact on wall {collision.wall.name} at {speed_m_s:.2f} m/s after "
        f"{approach.duration_s:.1f} s"
    )
    return [CheckFinding(item, True, message)]


def _describe_arrival(
    mission: Mission, collision: Collision, planned: PredictedFlight | None
) -> CheckFinding:
    """Describe the impact predicted at the end of the previous recovery, if the heading stays constant."""
    way = "recovery" if collision.trajectory is None else "trajectory"
    message = f"the {way} from the previous collision reaches wall {collision.wall.name}"
    incidence = incidence_deg(mission, collision)
    figures = {"incidence_deg": incidence}
    hit = None if planned is None else planned.hits.get(collision.index)
    if hit is not None:
        message += (
            f" near ({hit.position[0]:.2f}, {hit.position[1]:.2f}) at {-hit.normal_m_s:.2f} m/s, "
            f"{abs(hit.tangential_m_s):.2f} m/s along the wall"
        )
        figures |= {"normal_m_s": hit.normal_m_s, "tangential_m_s": hit.tangential_m_s}
    message += f", incidence {incidence:.0f} degrees"
    if incidence > _FLAT_DEG:
        message += ": one guard touches first, so the force may be only half of the prediction"
    return CheckFinding(f"approach_{collision.index}", True, message, figures=figures)


def _check_force(mission: Mission, collision: Collision) -> list[CheckFinding]:
    item, wall = f"force_{collision.index}", collision.wall.name
    hit = expected_hit(mission, collision)
    if hit is None:
        return [
            CheckFinding(
                item,
                True,
                f"wall {wall}: the mission contains no predicted impact; `plan` writes predictions",
            )
        ]
    normal, friction = hit.peak_normal_force_n, hit.peak_friction_force_n
    force, limit = math.hypot(normal, friction), mission.limits.peak_force_n
    detection = mission.vehicle.detection.force_threshold_n
    message = f"wall {wall}: predicted {describe_force(normal, friction)}"
    if force > limit:
        return [CheckFinding(item, False, f"{message}, limits.peak_force_n is {limit:g} N")]
    if normal < _WEAK * detection:
        weak = (
            f"{message}, too near the detection threshold of {detection:g} N: the impact may not be detected"
        )
        return [CheckFinding(item, False, weak)]
    clipping = clipping_warning(mission, collision)
    if clipping is not None:
        # If an impact exceeds the IMU's full scale, the recovery is too weak and PX4's estimate is disturbed.
        go = force <= full_scale_n(mission)
        return [CheckFinding(item, go, clipping, remark=go)]
    return [CheckFinding(item, True, f"{message}, limit {limit:g} N")]


def _check_noise(mission: Mission, collision: Collision) -> list[CheckFinding]:
    """Compare the predicted force with the detection limit.

    The limit follows from the configured vibration, which the detector assumes until it has measured the
    vibration in flight.
    """
    hit, vehicle = expected_hit(mission, collision), mission.vehicle
    if hit is None:
        return []
    floor = ImpactDetector(vehicle).detection_floor_n(hit.contact_time_s)
    if hit.peak_normal_force_n >= floor:
        return []
    message = (
        f"{collision.mode.value}, {hit.peak_normal_force_n:.1f} N at wall {collision.wall.name}, below the "
        f"detection limit of {floor:.1f} N at a vibration of {vehicle.estimation.imu_noise_m_s2:g} m/s2; "
        "measure your vehicle's vibration with `inspect`"
    )
    return [CheckFinding(f"noise_{collision.index}", True, message, remark=True)]


def _check_envelope(
    mission: Mission, collision: Collision, planned: PredictedFlight | None
) -> list[CheckFinding]:
    """Check that earlier flights have recovered from impacts of this speed, incidence and guard height."""
    hit = None if planned is None else planned.hits.get(collision.index)
    predicted = None if hit is None else (hit.normal_m_s, hit.tangential_m_s)
    warnings = {
        "speed": speed_warning(collision, predicted),
        "incidence": incidence_warning(mission, collision),
        "guard_height": height_warning(mission, collision, predicted),
    }
    return [
        CheckFinding(f"{item}_{collision.index}", False, message)
        for item, message in warnings.items()
        if message is not None
    ]


def check_path(mission: Mission, planned: PredictedFlight | None) -> list[CheckFinding]:
    """Check the planned flight against the guard's limits, and that the vehicle could stop in bounds."""
    if planned is None:
        return []
    fastest = max(_states(mission, planned), key=lambda state: math.hypot(*state[2:]), default=(0.0,) * 4)
    speed_m_s, limit = math.hypot(*fastest[2:]), mission.limits.speed_m_s
    if speed_m_s > limit:
        message = (
            f"the predicted path reaches {speed_m_s:.2f} m/s near ({fastest[0]:.2f}, {fastest[1]:.2f}), "
            f"limits.speed_m_s is {limit:g}"
        )
        return [CheckFinding("path", False, message)]
    worst, where, stops = 0.0, (0.0, 0.0), False
    for x, y, vx, vy in _states(mission, planned):
        share = STOP_TIME_S * stop_share(mission.walls, (x, y), (vx, vy))
        for point, by_stopping in (((x, y), False), ((x + share * vx, y + share * vy), True)):
            excess = mission.bounds.excess2(point)
            if excess > worst + _SAME_M:
                worst, where, stops = excess, point, by_stopping
    place = f"({where[0]:.2f}, {where[1]:.2f})"
    if worst > 0.0 and stops:
        message = f"if the vehicle brakes on its path, it stops at {place}, {worst:.2f} m outside bounds_m"
        return [CheckFinding("path", False, message)]
    if worst > 0.0:
        message = f"the predicted path leads to {place}, {worst:.2f} m outside bounds_m"
        return [CheckFinding("path", False, message)]
    reached = "" if len(planned.hits) == len(mission.collisions) else ", as far as the model predicts"
    return [
        CheckFinding("path", True, f"the predicted path and its stopping points are within bounds_m{reached}")
    ]


def check_goal(mission: Mission, planned: PredictedFlight | None) -> list[CheckFinding]:
    """Check whether the last recovery is predicted to reach the goal; a miss is a remark, not a no-go."""
    if planned is None or not mission.recovers_to_goal or mission.standoff_m is not None:
        return []
    if planned.goal_miss_m is None:
        message = "the model cannot predict how near the vehicle passes the goal"
        return [CheckFinding("goal", True, message, remark=True)]
    miss_m, radius_m = planned.goal_miss_m, mission.goal.capture_radius_m
    figures = {"goal_miss_m": miss_m, "capture_radius_m": radius_m}
    message = describe_goal_miss(
        miss_m, mission.goal, mission.after_impact, mission.goal_trajectory is not None
    )
    misses = miss_m > radius_m and mission.after_impact is not AfterImpact.REPLAN
    return [CheckFinding("goal", True, message, remark=misses, figures=figures)]


def _states(mission: Mission, planned: PredictedFlight) -> Iterator[tuple[float, float, float, float]]:
    """Yield positions (m) and velocities (m/s) of the planned flight: steady runs, free flights, transits."""
    for collision in mission.collisions:
        if collision.impact_point is not None:
            vx, vy, _ = collision.approach_velocity()
            for share in (0.0, 0.25, 0.5, 0.75, 1.0):
                before_s = share * mission.vehicle.flying.steady_run_s
                x, y = collision.impact_point
                yield x - before_s * vx, y - before_s * vy, vx, vy
    for path in planned.legs.values():
        for x, y, vx, vy in path.tolist():
            yield x, y, vx, vy
    for leg in transit_segments(mission):
        if leg.begin is not None:
            transit = plan_transit(mission, leg, leg.begin)
            for i in range(_LEG_POINTS + 1):
                at = transit.at(transit.duration_s * i / _LEG_POINTS)
                yield at.position[0], at.position[1], at.velocity[0], at.velocity[1]


def _check_recovery(
    mission: Mission, collision: Collision, planned: PredictedFlight | None
) -> list[CheckFinding]:
    """Check the point to which a recovery leads.

    If the next collision has no approach, the recovery itself must lead to that collision's wall. Otherwise
    the recovery must hit no wall and no post.
    """
    hit, item = expected_hit(mission, collision), f"recovery_{collision.index}"
    place = collision.impact_point or (collision.predicted.position_m if collision.predicted else None)
    velocity = impact_velocity(collision)
    met = planned.hits.get(collision.index) if planned is not None else None
    if hit is not None and place is not None and velocity is not None:
        normal_n, friction_n = hit.peak_normal_force_n, hit.peak_friction_force_n
    elif met is not None:
        place, velocity = (
            met.position,
            (met.normal_m_s, met.tangential_m_s),
        )
        normal_n, friction_n = met.normal_n, abs(met.tangential_n)
    else:
        return []
    along = math.copysign(friction_n, -velocity[1])  # friction acts opposite to the tangential motion
    alphas = (collision.alpha_normal_m_per_n, collision.alpha_tangential_m_per_n)
    horizontal = recovery_point(place, collision.wall.normal, (normal_n, along), alphas)
    target = (*horizontal, mission.altitude_at(collision.index - 1))
    message = f"recovery setpoint after wall {collision.wall.name} near ({target[0]:.2f}, {target[1]:.2f})"
    following = next((c for c in mission.collisions if c.index == collision.index + 1), None)
    leg = next(
        (one for one in transit_segments(mission) if _begins_after_recovery(mission, one, collision)), None
    )
    if (mission.goal_trajectory if following is None else following.trajectory) is not None:
        return [
            _evaluate_setpoint(
                mission,
                item,
                target,
                f"{message}, until a trajectory is planned from there",
                "the trajectory",
            )
        ]
    if following is not None and following.approach_m_s is None:
        beyond = following.wall.signed_distance(target)
        if beyond > 0.0:
            short = f"{message}: {beyond:.2f} m short of the next wall, {following.wall.name}"
            return [CheckFinding(item, False, short)]
        leads = f"{message}, leads to wall {following.wall.name}"
        return [_evaluate_setpoint(mission, item, target, leads, "that wall")]
    for wall in mission.walls:
        if wall is not collision.wall and leads_behind(wall, (place[0], place[1]), (target[0], target[1])):
            return [
                CheckFinding(item, False, f"{message}: behind wall {wall.name}, which is not the next wall")
            ]
        if leg is not None and is_blocked(wall, target[:2], leg.end[:2]):
            message = f"{message}: from there wall {wall.name} blocks the path to {leg.name}"
            return [CheckFinding(item, False, message)]
    for post in mission.posts:
        way = (place[0], place[1]), (target[0], target[1])
        if post.name != collision.wall.name and is_blocked_by_post(mission, post, *way):
            return [
                CheckFinding(item, False, f"{message}: post {post.name} blocks the path to this setpoint")
            ]
        if leg is not None and is_blocked_by_post(mission, post, target[:2], leg.end[:2]):
            message = f"{message}: from there post {post.name} blocks the path to {leg.name}"
            return [CheckFinding(item, False, message)]
    return [_evaluate_setpoint(mission, item, target, message, "the goal" if leg is None else leg.name)]


def _begins_after_recovery(mission: Mission, leg: TransitSegment, collision: Collision) -> bool:
    if leg.begin is not None:
        return False
    ends = [w.after for w in mission.waypoints if w.name == leg.name]
    return (ends[0] if ends else len(mission.collisions)) == collision.index


def _evaluate_setpoint(mission: Mission, item: str, target: Vec3, message: str, first: str) -> CheckFinding:
    """Check how far a recovery setpoint lies outside the bounds.

    A setpoint slightly outside is only a remark, because the vehicle reaches `first` (a wall, a waypoint or
    the goal) before the setpoint. A setpoint far outside is a no-go, because the collision's gain alpha is
    probably wrong.
    """
    outside = setpoint_outside_m(mission.bounds, target[0], target[1])
    if outside > SETPOINT_OUTSIDE_M:
        far = f"{message}, {outside:.2f} m outside bounds_m, limit {SETPOINT_OUTSIDE_M:g} m"
        return CheckFinding(item, False, far + ": check alpha")
    if outside > 0.0:
        return CheckFinding(
            item,
            True,
            f"{message}, {outside:.2f} m outside bounds_m: acceptable if the vehicle reaches {first} first",
            remark=True,
        )
    return CheckFinding(item, True, message)


def _check_servo(mission: Mission, collision: Collision) -> list[CheckFinding]:
    """If a recovery leads to a wall, check that the lock can switch to that wall's mode in time."""
    following = next((c for c in mission.collisions if c.index == collision.index + 1), None)
    if following is None or following.approach_m_s is not None or following.mode is collision.mode:
        return []
    lock, item = mission.vehicle.lock, f"servo_{following.index}"
    if lock is None:
        return []
    needed = lock.relaxation_s + lock.switch_time_s
    here, there = collision.predicted, following.predicted
    hit = expected_hit(mission, collision)
    if here is not None and there is not None:
        free = there.t_s - here.t_s - here.contact_time_s
        how = "predicted"
    elif hit is not None and collision.impact_point is not None:
        # Compute the shortest flight time within the mission's speed limit.
        way = following.wall.signed_distance(collision.impact_point)
        free = way / mission.limits.speed_m_s
        how = "at least"
    else:
        return []
    message = f"the lock needs {needed:.2f} s between the contacts, {free:.2f} s are available ({how})"
    go = free >= needed or how == "at least"
    if free < needed and go:
        message += "; if the lock is late, the vehicle breaks off the approach"
    return [CheckFinding(item, go, message)]


def check_flown(mission: Mission) -> CheckFinding:
    """Return the result of the mission's simulated flights, as recorded by `plan`.

    Without a record, or if the mission has changed since these flights, return a remark.
    """
    flown = mission.flown
    try_it = f"dart-flight dry-run {shlex.quote(mission.source)} --fast --runs 20 --vary all"
    if flown is None or flown.digest != mission.digest:
        why = (
            "this mission contains no record of simulated flights; `plan` writes one"
            if flown is None
            else "mission or vehicle has changed since `plan` flew it in simulation"
        )
        return CheckFinding("flown", True, f"{why}; to fly it 20 times in simulation: {try_it}", remark=True)
    if flown.danger is not None:
        return CheckFinding(
            "flown",
            False,
            f"in simulation, {flown.danger}: plan a lower speed, or measure the walls by touch first",
        )
    message = f"flown in simulation by {flown.software}: {flown.summary}"
    figures: dict[str, float] = {}
    if flown.drawn is not None:
        figures = {"flights": flown.drawn.flights, "completed": flown.drawn.completed}
    if flown.saving_s is not None:
        figures["saving_s"] = flown.saving_s
    return CheckFinding("flown", True, message, remark=flown.failure is not None, figures=figures)


def check_materials(mission: Mission, log_dir: Path) -> list[CheckFinding]:
    """Return the source of each material's coefficients.

    If `series apply` wrote them, the finding has their age, and a remark if the newest flights in
    `log_dir` disagree with them.
    """
    findings = []
    source_file = None if mission.vehicle_source is None else mission.vehicle_source.source
    history = () if source_file is None else read_history(Path(source_file))
    for name in sorted({c.wall.material for c in mission.collisions if c.wall.material_known}):
        source = mission.vehicle.materials[name].source
        assumed = not source or any(word in source for word in _NOT_MEASURED)
        note = "; these coefficients were not measured: measure them with `identify`" if assumed else ""
        message = f"{name}: {source or 'no source given'}{note}"
        modes = sorted({c.mode.value for c in mission.collisions if c.wall.material == name})
        applied = [one for mode in modes if (one := newest_entry(history, name, mode)) is not None]
        if applied:
            ages = [f"{one.mode} {(date.today() - one.day).days} days old" for one in applied]
            message += f"; coefficients: {', '.join(ages)}"
        differing = list(_differing(mission, name, applied, log_dir))
        message += "".join(f"; {text}" for text in differing)
        findings.append(CheckFinding(f"material_{name}", True, message, remark=assumed or bool(differing)))
    return findings


def _differing(
    mission: Mission, material: str, applied: Sequence[HistoryEntry], log_dir: Path
) -> Iterator[str]:
    """Yield a sentence for each mode whose applied coefficients the newest flights contradict."""
    if not applied:
        return
    since = min(one.day for one in applied)
    excesses = later_excesses(log_dir, since, mission.vehicle, material)
    for mode in (Mode(one.mode) for one in applied):
        if (values := excesses.get(mode)) and contradicts(*mean_excess(values)):
            mean, count = mean_excess(values)[0], len(values)
            yield (
                f"the last {count} hit{'s' * (count > 1)} {mode} had {100.0 * abs(mean):.0f} % "
                f"{'more' if mean > 0.0 else 'less'} force than these coefficients predict (limit "
                f"{100.0 * AGREES:.0f} %): measure the wall again with `series`"
            )
