"""The one table of the guard's rules: name, what it says, threshold, action, scope, cause.

`guard` iterates over it; `docs/guard.md` is generated from it (`make docs`). A rule with a `cause` is judged
every 20 ms in its `scope`, and after the inputs that it names at once; one without comes as a finding in the
mission's proposal. Nothing outside of this table can overrule the mission.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import StrEnum
from typing import Final, NamedTuple

from dart_flight.base.geometry import horizontal, norm
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    FlightMode,
    ImuSample,
    OdometrySample,
    OperatorRequest,
    OtherVehicle,
    Override,
    Phase,
    Request,
    StatusSample,
    StatusText,
)
from dart_flight.base.streams import BY_NAME
from dart_flight.base.text import battery_figures
from dart_flight.core.guard.flight_conditions import FlightConditions, Stamped
from dart_flight.core.guard.heading_step import HEADING_STEP_DEG
from dart_flight.core.mission.phases import ALTITUDE_EXEMPT, ON_GROUND

_SPEED_TOLERANCE: Final = 1.1
_STALE_SAMPLES: Final = 5  # in a row; one late datagram is no clock that runs backwards
_FALL_S: Final = 0.1
_OTHERS_SINCE: Final = 12  # a tenth of a second of one other stream
_ALTITUDE_SLACK_M: Final = 0.05
_GUARD_STRAYS_M: Final = 0.2  # allowed out of bounds, for a break-off from a wall at their edge
_THRUST_MISFIT: Final = 0.25  # 4.3 standard deviations for 3 % spread of mass and 5 % of battery
_AFTER_CLIMB: Final = frozenset({Phase.WAYPOINT, Phase.PAUSE, Phase.TRANSIT, Phase.PREPARE})


class Scope(StrEnum):
    """When a rule is judged."""

    ALWAYS = "always"
    GROUND = "before take-off"
    AIR = "in the air"
    GUIDED = "while mission or guard flies"  # not while landing
    FLYING = "while the mission flies"  # not while landing or once overruled


class Rule(NamedTuple):
    """One rule.

    Attributes:
        name: as in the log and in the verdict.
        description: what is wrong, as shown to the operator.
        threshold: keys of the vehicle's configuration or of the mission that it compares with.
        action: what the guard does.
        scope: when it is judged.
        cause: says what is wrong now, or None; a rule without one comes as a finding of the mission.
        by_person: a person took over: the flight counts as released, not as aborted.
        at_once: inputs after which it is judged without waiting: modes, arming and requests must not wait,
            and what is known only of one sample cannot.
        explains: rules that may have fired for the same cause before it could be told: where their action is
            in force and no weaker, the reason becomes this rule's.
        of_streams: telemetry fails; what else is known of link and computer is said with it.
        noted: whether log and verdict note the rule, once a flight, while an action as strong is in force.
    """

    name: str
    description: str
    threshold: str
    action: Override
    scope: Scope = Scope.ALWAYS
    cause: Callable[[FlightConditions], str | None] | None = None
    by_person: bool = False
    at_once: tuple[type, ...] = ()
    explains: frozenset[str] = frozenset()
    of_streams: bool = False
    noted: bool = False


# --- causes ------------------------------------------------------------------------------------------------


def _pilot(v: FlightConditions) -> str | None:
    mode = v.unrequested_mode
    return f"PX4 is in {mode.value}" if mode is not None and not _by_px4(v) else None


def _px4_failsafe(v: FlightConditions) -> str | None:
    mode = v.unrequested_mode
    if mode is None or not _by_px4(v):
        return None
    return f"{v.failsafe_words}; PX4 is in {mode.value}" if v.failsafe_said else f"PX4 is in {mode.value}"


def _by_px4(v: FlightConditions) -> bool:
    # A mode flown by stick is the pilot's choice unless PX4 announced it. A gap may hide the announcement.
    if v.unrequested_mode is FlightMode.MANUAL:
        return v.failsafe_hands_to_sticks
    return v.failsafe_said or v.was_cut_off


def _failsafe_announced(v: FlightConditions) -> str | None:
    return v.failsafe_announced


def _terminated(v: FlightConditions) -> str | None:
    return v.termination


def _disarmed(v: FlightConditions) -> str | None:
    # A kill switch stops the motors at once; PX4 disarms 5 s later, and the heartbeat may take 1 s more.
    falling_s = v.lasting_s(v.falling_since_us)
    if falling_s > _FALL_S and v.was_armed and not v.state.on_ground:
        return f"PX4 has stopped the motors in the air, falling for {falling_s * 1e3:.0f} ms"
    if v.state.status.armed or not v.was_armed or v.state.on_ground or v.land_asked:
        return None
    # It may be the other vehicle's state.
    return None if v.status_unreliable else "PX4 has disarmed in the air"


def _silent(v: FlightConditions, name: str, newest: Stamped | None, limit_s: float) -> str | None:
    age = v.age_s(newest)
    if age <= limit_s:
        return None
    return f"for {min(age, 999.0) * 1e3:.0f} ms" + v.state.text_about(BY_NAME[name].message)


def _attitude_silent(v: FlightConditions) -> str | None:
    return _silent(v, "attitude", v.state.attitude, v.config.stream_timeout_s)


def _odometry_silent(v: FlightConditions) -> str | None:
    return _silent(v, "odometry", v.state.odometry, v.config.stream_timeout_s)


def _actuator_silent(v: FlightConditions) -> str | None:
    return _silent(v, "actuator", v.state.actuator, v.config.actuator_timeout_s)


def _imu_silent(v: FlightConditions) -> str | None:
    age = v.age_s(v.state.imu)
    # While the other streams go on it is the IMU; when all pause, as on a busy host, that is given longer.
    alone = age > v.config.imu_timeout_s and v.since_imu >= _OTHERS_SINCE
    if alone or age > v.config.stream_timeout_s:
        return f"for {min(age, 999.0) * 1e3:.0f} ms"
    return None


def _status_silent(v: FlightConditions) -> str | None:
    age = v.status_age_s
    return f"for {age:.1f} s" if age > v.config.status_timeout_s else None


def _link_lost(v: FlightConditions) -> str | None:
    age = min(
        v.status_age_s, *(v.age_s(newest) for newest in (v.state.imu, v.state.attitude, v.state.odometry))
    )
    return f"no telemetry for {age:.1f} s" if age > v.config.link_lost_s else None


def _stream_rate(v: FlightConditions) -> str | None:
    for name, rate_hz in v.rates_hz.items():
        if rate_hz < BY_NAME[name].expected_hz:
            return f"{name} at {rate_hz:.0f} Hz, needs {BY_NAME[name].expected_hz:.0f}"
    return None


def _telemetry_late(v: FlightConditions) -> str | None:
    return v.lateness.describe() if v.lateness.late else None


def _second_vehicle(v: FlightConditions) -> str | None:
    return v.second_vehicle


def _second_vehicle_ground(v: FlightConditions) -> str | None:
    return v.other_system


def _stamps_backwards(v: FlightConditions) -> str | None:
    for name, count in v.stale.items():
        if count >= _STALE_SAMPLES:
            return f"{name}: {count} samples in a row more than {v.config.stamp_tolerance_s:g} s in the past"
    return None


def _imu_stuck(v: FlightConditions) -> str | None:
    lasting = v.lasting_s(v.stuck_since_us)
    return f"the same reading for {lasting * 1e3:.0f} ms" if lasting > v.config.imu_stuck_s else None


def _imu_clipped(v: FlightConditions) -> str | None:
    lasting = v.lasting_s(v.clipped_since_us)
    return f"at full scale for {lasting * 1e3:.0f} ms" if lasting > v.config.imu_clipped_s else None


def _estimator_jump(v: FlightConditions) -> str | None:
    return v.jump or None


def _estimator_reset(v: FlightConditions) -> str | None:
    return v.reset_step()


def _heading_reset(v: FlightConditions) -> str | None:
    step_deg, limit = math.degrees(v.heading_step_rad), HEADING_STEP_DEG
    return f"by {step_deg:.1f} deg, {limit:.0f} deg allowed" if abs(step_deg) > limit else None


def _position_uncertain(v: FlightConditions) -> str | None:
    sd, limit = v.state.position_sd_m, v.config.position_sd_m
    if sd is None or sd <= limit or not v.mission.collisions or v.mission.is_anchored:
        return None
    return f"standard deviation {sd:.2f} m, allowed {limit:.2f}"


def _position_delayed(v: FlightConditions) -> str | None:
    ahead_s, limit_s = v.state.position_ahead_s, v.config.position_delay_s
    if ahead_s is None or limit_s is None or abs(ahead_s) <= limit_s:
        return None
    side = "ahead of" if ahead_s > 0.0 else "behind"
    return (
        f"the position estimate is about {abs(ahead_s) * 1e3:.0f} ms {side} the IMU, "
        f"{limit_s * 1e3:.0f} ms allowed: check EKF2_EV_DELAY"
    )


def _estimator_flags(v: FlightConditions) -> str | None:
    lasting = v.lasting_s(v.flags_bad_since_us)
    return f"no valid estimate for {lasting:.1f} s" if lasting > v.config.estimator_bad_s else None


def _still_armed(v: FlightConditions) -> str | None:
    limit = v.surely_down_s
    return f"after {v.landing_s:.0f} s in land mode" if limit is not None and v.landing_s > limit else None


def _battery(v: FlightConditions) -> str | None:
    if v.lasting_s(v.battery_low_since_us) <= v.config.battery_low_s:
        return None
    status = v.state.status
    return ", ".join(battery_figures(status.battery_remaining, status.battery_v))


def _hover_thrust(v: FlightConditions) -> str | None:
    ratio, vehicle = v.thrust_ratio, v.mission.vehicle
    if ratio is None or v.impact is not None or v.phase not in _AFTER_CLIMB or not v.mission.collisions:
        return None
    allowed = max(_THRUST_MISFIT, vehicle.estimation.hover.thrust_scale_limit)
    if abs(ratio - 1.0) <= allowed:
        return None
    mass_kg = vehicle.airframe.mass_kg
    says = f"by the thrust curve the motors carry {mass_kg / max(ratio, 0.01):.2f} kg, airframe.mass_kg is "
    return f"{says}{mass_kg:g}: ratio {ratio:.2f}, {1.0 - allowed:.2f} to {1.0 + allowed:.2f} allowed"


def _tilt(v: FlightConditions) -> str | None:
    tilt = math.degrees(v.state.tilt_rad)
    return f"{tilt:.0f} deg" if tilt > v.config.tilt_deg else None


def _bounds(v: FlightConditions) -> str | None:
    bounds = v.mission.bounds
    excess = bounds.excess2(v.state.position)
    if v.phase is Phase.OVERRULED:  # the guard is braking already, and may break off outwards
        return f"{excess:.2f} m outside" if excess > _GUARD_STRAYS_M else None
    if excess > 0.0:
        return f"{excess:.2f} m outside"
    excess = v.stop_excess_m()
    return f"would stop {excess:.2f} m outside" if excess > 0.0 else None


def _altitude(v: FlightConditions) -> str | None:
    if v.phase in ALTITUDE_EXEMPT or not v.was_inside:
        return None
    low, high = v.mission.bounds.z
    tolerance = v.config.altitude_tolerance_m if v.just_after_impact else _ALTITUDE_SLACK_M
    z = v.state.position[2]
    return None if low - tolerance <= z <= high + tolerance else f"{z:.2f} m"


def _speed(v: FlightConditions) -> str | None:
    speed = norm(v.state.velocity)
    return f"{speed:.2f} m/s" if speed > v.mission.limits.speed_m_s * _SPEED_TOLERANCE else None


def _force(v: FlightConditions) -> str | None:
    limit = v.mission.limits.peak_force_n * v.config.force_margin
    force = horizontal(v.force.force_mission) if v.force is not None else 0.0
    return f"{force:.0f} N" if force > limit else None


def _operator_lands(v: FlightConditions) -> str | None:
    return "landing requested" if v.request is not None and v.request.request is Request.LAND else None


def _operator_stops(v: FlightConditions) -> str | None:
    if _operator_lands(v) is None or v.phase not in ON_GROUND or v.state.status.armed:
        return None
    return "stopped before take-off"


def _operator_releases(v: FlightConditions) -> str | None:
    released = v.request is not None and v.request.request is Request.RELEASE
    return "released by the operator" if released else None


def _world_died(v: FlightConditions) -> str | None:
    if v.request is None or v.request.request is not Request.WORLD_DIED:
        return None
    return v.request.detail or "simulated vehicle terminated"


# --- the table ---------------------------------------------------------------------------------------------

_ALWAYS, _GROUND, _AIR = Scope.ALWAYS, Scope.GROUND, Scope.AIR
_GUIDED, _FLYING = Scope.GUIDED, Scope.FLYING
_GIVE_UP, _BREAK_OFF, _HOLD = Override.GIVE_UP, Override.BREAK_OFF, Override.HOLD
_LAND, _KILL, _RELEASE = Override.LAND, Override.KILL, Override.RELEASE
_MODE = (StatusSample, StatusText)  # PX4's own words say whose doing a change of mode is
_REQUEST = (OperatorRequest,)

# fmt: off
RULES: tuple[Rule, ...] = (
    # judged here
    Rule("px4_failsafe", "PX4 has left offboard by itself: its failsafe flies", "",
         _RELEASE, _ALWAYS, _px4_failsafe, at_once=_MODE),
    Rule("terminated", "PX4 terminated the flight, or a kill switch was used: motors off", "",
         _RELEASE, _AIR, _terminated, at_once=_MODE),
    Rule("failsafe_announced", "PX4 announced a failsafe, and telemetry does not show its mode yet",
         "", _BREAK_OFF, _FLYING, _failsafe_announced, at_once=_MODE),
    Rule("pilot", "PX4 was taken out of offboard: the pilot flies", "",
         _RELEASE, _ALWAYS, _pilot, by_person=True, at_once=_MODE),
    Rule("disarmed", "disarmed in the air: PX4 says so, or the motors stand still and the vehicle falls", "",
         _RELEASE, _AIR, _disarmed, at_once=(StatusSample, ActuatorSample)),
    Rule("link_lost", "no telemetry at all: PX4's own failsafe must act",
         "guard.link_lost_s", _RELEASE, _AIR, _link_lost, of_streams=True),
    Rule("imu_silent", "IMU stream timed out: impacts cannot be detected",
         "guard.imu_timeout_s, guard.stream_timeout_s", _LAND, _AIR, _imu_silent, of_streams=True),
    Rule("attitude_silent", "attitude stream timed out: force direction unknown", "guard.stream_timeout_s",
         _LAND, _AIR, _attitude_silent, of_streams=True),
    Rule("odometry_silent", "position stream timed out", "guard.stream_timeout_s",
         _LAND, _AIR, _odometry_silent, of_streams=True),
    Rule("actuator_silent", "actuator stream timed out: thrust and contact force cannot be separated",
         "guard.actuator_timeout_s", _HOLD, _FLYING, _actuator_silent, of_streams=True),
    Rule("status_silent", "heartbeat timed out", "guard.status_timeout_s",
         _LAND, _AIR, _status_silent, of_streams=True),
    Rule("stream_rate", "a stream comes at less than the rate that a mission needs (`base/streams.py`)",
         "streams: expected_hz", _HOLD, _FLYING, _stream_rate, of_streams=True),
    Rule("telemetry_late_ground", "telemetry arrives too late to act on",
         "guard.telemetry_late_s", _GIVE_UP, _GROUND, _telemetry_late, of_streams=True),
    Rule("telemetry_late", "telemetry has been late for more than a moment",
         "guard.telemetry_late_s", _LAND, _AIR, _telemetry_late,
         explains=frozenset({"imu_silent", "attitude_silent", "odometry_silent", "status_silent"}),
         of_streams=True),
    Rule("second_vehicle_ground", "a second vehicle sends on the link, whatever its system id",
         "guard.stamp_tolerance_s, guard.position_jump_m", _GIVE_UP, _GROUND, _second_vehicle_ground,
         at_once=(OtherVehicle,)),
    Rule("second_vehicle", "two vehicles share one system id: two clocks or two positions alternate",
         "guard.stamp_tolerance_s, guard.position_jump_m", _LAND, _AIR, _second_vehicle,
         explains=frozenset({"stamps_backwards", "odometry_silent", "attitude_silent", "imu_silent",
                             "status_silent", "estimator_flags", "altitude"})),
    Rule("stamps_backwards", "autopilot timestamps went backwards: it restarted, or its clock was reset",
         "guard.stamp_tolerance_s", _LAND, _AIR, _stamps_backwards, of_streams=True),
    Rule("imu_stuck", "IMU reading stuck", "guard.imu_stuck_s",
         _LAND, _AIR, _imu_stuck),
    Rule("imu_clipped", "the IMU stays at full scale longer than any contact lasts", "guard.imu_clipped_s",
         _LAND, _AIR, _imu_clipped),
    Rule("estimator_jump", "position or velocity has jumped, other than shortly after an impact",
         "guard.position_jump_m, guard.velocity_jump_m_s, guard.impact_window_s",
         _HOLD, _GUIDED, _estimator_jump, at_once=(OdometrySample,), noted=True),
    Rule("estimator_reset",
         "PX4's estimator was reset, and position or velocity stepped, other than shortly after an impact",
         "guard.reset_position_m, guard.reset_velocity_m_s, guard.impact_window_s",
         _HOLD, _GUIDED, _estimator_reset, noted=True),
    Rule("heading_reset",
         "PX4's estimator was reset, and the heading stepped by more than 5 degrees against the gyro", "",
         _BREAK_OFF, _FLYING, _heading_reset),
    Rule("estimator_flags", "PX4's estimator says that its position is not valid, and the impact is over",
         "guard.estimator_bad_s, guard.impact_window_s", _LAND, _AIR, _estimator_flags),
    Rule("position_uncertain", "PX4 itself is not sure enough of its position to fly at walls",
         "guard.position_sd_m", _LAND, _GUIDED, _position_uncertain, noted=True),
    Rule("position_delayed", "the position estimate is ahead of the IMU's motion, or behind it",
         "guard.position_delay_s", _BREAK_OFF, _FLYING, _position_delayed),
    Rule("battery", "the battery is low", "guard.battery_remaining, guard.battery_v, guard.battery_low_s",
         _LAND, _AIR, _battery),
    Rule("still_armed", "in PX4's land mode and still armed long after touchdown was due",
         "guard.kill_after_s, bounds_m.z", _KILL, _AIR, _still_armed),
    Rule("hover_thrust", "before the first impact, thrust differs by over 25 % from mass and thrust curve",
         "estimation.hover.thrust_scale_limit", _BREAK_OFF, _FLYING, _hover_thrust),
    # No landing yet, as after `mode_felt`: PX4's land mode unwinds a tilt at MPC_JERK_AUTO and flies away.
    Rule("tilt", "tilt beyond what PX4 can be trusted to recover from", "guard.tilt_deg", _BREAK_OFF, _AIR,
         _tilt, at_once=(AttitudeSample,), noted=True),
    Rule("altitude", "outside of the flight space vertically; more is allowed after an impact",
         "bounds_m.z, guard.altitude_tolerance_m, guard.impact_window_s", _LAND, _GUIDED, _altitude,
         at_once=(OdometrySample,), noted=True),
    Rule("bounds", "outside of the flight space horizontally, or would stop there", "bounds_m.x, bounds_m.y",
         _HOLD, _GUIDED, _bounds, at_once=(OdometrySample,), noted=True),
    Rule("speed", "faster than the mission allows", "limits.speed_m_s", _HOLD, _FLYING, _speed,
         at_once=(OdometrySample,)),
    Rule("force_over_limit", "the contact force goes well over the limit while it lasts",
         "limits.peak_force_n, guard.force_margin", _BREAK_OFF, _FLYING, _force, at_once=(ImuSample,)),
    Rule("operator_ground", "the operator stops the flight before take-off", "",
         _LAND, _ALWAYS, _operator_stops, at_once=_REQUEST),
    Rule("operator", "operator requests landing (Ctrl-C)", "", _BREAK_OFF, _ALWAYS, _operator_lands,
         at_once=_REQUEST),
    Rule("operator_release", "operator releases the vehicle (second Ctrl-C)", "",
         _RELEASE, _ALWAYS, _operator_releases, by_person=True, at_once=_REQUEST),
    Rule("world_died", "simulated vehicle terminated", "", _RELEASE, _ALWAYS, _world_died,
         at_once=_REQUEST),
    # found by the mission, which alone knows the plan
    Rule("peak_force", "an impact's peak was over the limit", "limits.peak_force_n", _BREAK_OFF),
    Rule("wall_not_met", "the wall was not met where or when it should have been",
         "guard.wall_overrun_m, guard.wall_late_s, limits.collision_timeout_s", _BREAK_OFF),
    Rule("wall_met_early", "a contact well before the planned wall", "guard.wall_early_m", _BREAK_OFF),
    Rule("hit_in_noise", "planned impact is below the detection limit at the vibration level measured so far",
         "detection.noise_sigma, detection.short_window_s, detection.long_window_s", _BREAK_OFF),
    Rule("unplanned_hit", "an impact where the plan has none; noted: at the wall just hit, within 1 s", "",
         _BREAK_OFF),
    Rule("no_peak", "contact force does not decay", "detection.peak_wait_s", _BREAK_OFF),
    Rule("lock_not_settled", "the lock is not in the planned mode in the approach or at the impact", "",
         _BREAK_OFF),
    Rule("mode_felt", "contact indicates the other mode than the lock reports; with `go_on` only noted",
         "mode_mismatch, estimation.walls.sure_log_odds", _BREAK_OFF),
    Rule("lock_late", "the lock is not in the planned mode at the last point at which the vehicle can still "
         "stop before the wall, and the impact is not allowed in both modes", "", _BREAK_OFF),
    Rule("lock_not_ready", "the lock did not reach the planned mode before the approach", "lock.timeout_s",
         _LAND),
    Rule("no_approach", "a wall as a contact has found it leaves no room for the approach to it", "bounds_m",
         _HOLD),
    Rule("climb_timeout", "the altitude was not reached in time", "flying.ready_timeout_s", _LAND),
    Rule("transit_timeout", "the run-up point or a waypoint was not reached in time",
         "flying.ready_timeout_s", _HOLD),
    Rule("pause_timeout", "operator did not resume in time", "", _LAND),
    Rule("goal_not_reached", "the goal could not be held in time", "goal.hold_s, limits.collision_timeout_s",
         _LAND),
    Rule("not_ready", "telemetry or lock not ready before takeoff", "flying.ready_timeout_s", _GIVE_UP,
         of_streams=True),
    Rule("offboard_refused", "PX4 refuses offboard mode", "flying.ready_timeout_s", _GIVE_UP),
    Rule("arming_refused", "PX4 does not arm", "flying.ready_timeout_s", _GIVE_UP),
    Rule("mission_fault", "an exception in the mission's own code", "", _LAND),
)
# fmt: on

RULES_BY_NAME = {rule.name: rule for rule in RULES}


def in_scope(rule: Rule, phase: Phase) -> bool:
    """Whether a rule is judged in a phase."""
    if phase is Phase.DONE:
        return False
    if rule.scope is Scope.ALWAYS:
        return True
    if rule.scope is Scope.GROUND or phase in ON_GROUND:  # else the mission's time-outs judge there
        return rule.scope is Scope.GROUND and phase in ON_GROUND
    if rule.scope is Scope.AIR or phase is Phase.LANDING:
        return rule.scope is Scope.AIR
    return rule.scope is Scope.GUIDED or phase is not Phase.OVERRULED


def table() -> str:
    """The rules as a Markdown table, one row each."""
    rows = ["| rule | fires when | threshold | action | judged by |", "|---|---|---|---|---|"]
    for rule in RULES:
        judge = f"guard, {rule.scope.value}" if rule.cause is not None else "mission"
        if rule.at_once:
            judge += ", at once after " + ", ".join(f"`{kind.__name__}`" for kind in rule.at_once)
        keys = ", ".join(f"`{key}`" for key in rule.threshold.split(", ") if key) or "-"
        action = rule.action.value.replace("_", " ")
        rows.append(f"| `{rule.name}` | {rule.description} | {keys} | {action} | {judge} |")
    return "\n".join(rows) + "\n"
