"""The table of the guard's rules: name, action, scope and condition.

`guard` evaluates the table; `docs/guard.md` is generated from the table (`make docs`). A rule with a cause
function is evaluated every 20 ms in its scope. It is also evaluated immediately after the inputs in
`at_once`. A rule without a cause function fires when the mission reports the finding of the same name. Only
rules of this table can overrule the mission.
"""

from __future__ import annotations

import math
from typing import Final

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
from dart_flight.base.text import battery_figures
from dart_flight.core.guard.estimator_watch import ESTIMATOR_RULES
from dart_flight.core.guard.flight_conditions import LYING_TILT_DEG, FlightConditions
from dart_flight.core.guard.pose_watch import POSE_RULES
from dart_flight.core.guard.rule import Rule, RuleCondition, Scope, condition
from dart_flight.core.guard.second_vehicle import POSITION_JUMP_M
from dart_flight.core.guard.stream_watch import STAMP_TOLERANCE_S, STREAM_RULES
from dart_flight.core.mission.phases import ALTITUDE_EXEMPT, ON_GROUND
from dart_flight.core.sense.bias import THRUST_SCALE_LIMIT

LYING_S: Final = 0.5
IMU_STUCK_S: Final = 0.1  # longest time with equal readings; noise changes every reading of a working IMU
IMU_CLIPPED_S: Final = 0.25  # longest time at full scale; every contact is shorter
BATTERY_LOW_S: Final = 1.0  # time below the limit until the rule fires; bursts of thrust are shorter
ALTITUDE_TOLERANCE_M: Final = 0.25  # tolerance after an impact, which changes the altitude by about 0.15 m
FORCE_MARGIN: Final = 1.15  # margin for the noise of one sample; `peak_force` checks the peak itself
_SPEED_TOLERANCE: Final = 1.1
_STALE_SAMPLES: Final = 5  # number of old stamps in a row; a single old stamp may be a late datagram
_FALL_S: Final = 0.1
_ALTITUDE_SLACK_M: Final = 0.05
_GUARD_STRAYS_M: Final = 0.2  # a break-off may lead this far outside the bounds
_AFTER_CLIMB: Final = frozenset({Phase.WAYPOINT, Phase.PAUSE, Phase.TRANSIT, Phase.PREPARE})


# --- causes ------------------------------------------------------------------------------------------------


@condition("the pilot took PX4 out of offboard mode")
def _pilot(flight: FlightConditions) -> str | None:
    mode = flight.unrequested_mode
    return f"PX4 is in {mode.value}" if mode is not None and not _by_px4(flight) else None


@condition("PX4 left offboard mode by itself: PX4's failsafe flies the vehicle")
def _px4_failsafe(flight: FlightConditions) -> str | None:
    mode = flight.unrequested_mode
    if mode is None or not _by_px4(flight):
        return None
    return (
        f"{flight.failsafe_words}; PX4 is in {mode.value}"
        if flight.failsafe_reported
        else f"PX4 is in {mode.value}"
    )


def _by_px4(flight: FlightConditions) -> bool:
    # The pilot chose a stick mode that PX4 did not announce. A telemetry gap may hide the announcement.
    if flight.unrequested_mode is FlightMode.MANUAL:
        return flight.failsafe_hands_to_sticks
    return flight.failsafe_reported or flight.streams.was_cut_off


@condition("PX4 reports that it disarmed in the air, or the motors stand still and the vehicle falls")
def _disarmed(flight: FlightConditions) -> str | None:
    # A kill switch stops the motors immediately; PX4 disarms 5 s later, and the heartbeat may take 1 s more.
    if flight.kill_asked:
        return None  # the guard itself has stopped the motors
    falling_s = flight.duration_s(flight.falling_since_us)
    if falling_s > _FALL_S and flight.was_armed and not flight.state.on_ground:
        return f"PX4 stopped the motors in the air; the vehicle has been falling for {falling_s * 1e3:.0f} ms"
    if flight.state.status.armed or not flight.was_armed or flight.state.on_ground or flight.land_asked:
        return None
    # Another vehicle may have reported this state.
    return None if flight.status_unreliable else "PX4 disarmed in the air"


@condition(
    "the autopilot's time went backwards: it restarted, or its clock was reset", f"{STAMP_TOLERANCE_S:g} s"
)
def _stamps_backwards(flight: FlightConditions) -> str | None:
    for name, count in flight.streams.stale.items():
        if count >= _STALE_SAMPLES:
            return f"{name}: {count} samples in a row have stamps over {STAMP_TOLERANCE_S:g} s in the past"
    return None


@condition("the IMU repeats one reading", f"{IMU_STUCK_S:g} s")
def _imu_stuck(flight: FlightConditions) -> str | None:
    lasting = flight.duration_s(flight.stuck_since_us)
    return f"the IMU has repeated one reading for {lasting * 1e3:.0f} ms" if lasting > IMU_STUCK_S else None


@condition("the IMU stays at full scale longer than any contact lasts", f"{IMU_CLIPPED_S:g} s")
def _imu_clipped(flight: FlightConditions) -> str | None:
    lasting = flight.duration_s(flight.clipped_since_us)
    return f"the IMU has been at full scale for {lasting * 1e3:.0f} ms" if lasting > IMU_CLIPPED_S else None


@condition("the standard deviation of PX4's position is too large for a collision", "guard.position_sd_m")
def _position_uncertain(flight: FlightConditions) -> str | None:
    sd, limit = flight.state.position_sd_m, flight.config.position_sd_m
    if sd is None or sd <= limit or not flight.mission.collisions or flight.mission.is_anchored:
        return None
    return f"standard deviation of the position {sd:.2f} m, limit {limit:.2f} m"


@condition("the position estimate leads or lags the IMU's motion", "guard.position_delay_s")
def _position_delayed(flight: FlightConditions) -> str | None:
    ahead_s, limit_s = flight.state.position_ahead_s, flight.config.position_delay_s
    if ahead_s is None or limit_s is None or abs(ahead_s) <= limit_s:
        return None
    leads = "leads" if ahead_s > 0.0 else "lags"
    return (
        f"the position estimate {leads} the IMU by about {abs(ahead_s) * 1e3:.0f} ms, "
        f"limit {limit_s * 1e3:.0f} ms: check EKF2_EV_DELAY"
    )


@condition(
    "the vehicle is in PX4's land mode and still armed long after the expected touchdown",
    "guard.kill_after_s, bounds_m.z",
)
def _still_armed(flight: FlightConditions) -> str | None:
    limit = flight.landing_timeout_s
    if limit is None or flight.landing_s <= limit:
        return None
    return f"still armed after {flight.landing_s:.0f} s in land mode"


@condition(
    "the vehicle lies on the ground, tilted and still, with its motors armed",
    f"{LYING_TILT_DEG:g} degrees, {LYING_S:g} s",
)
def _lying(flight: FlightConditions) -> str | None:
    lying_s = flight.duration_s(flight.lying_since_us)
    if lying_s <= LYING_S or not flight.state.status.armed:
        return None
    tilt_deg = math.degrees(flight.state.tilt_rad)
    return f"the vehicle has been lying on the ground at {tilt_deg:.0f} deg for {lying_s:.1f} s"


@condition("the battery is low", f"guard.battery_remaining, guard.battery_v, {BATTERY_LOW_S:g} s")
def _battery(flight: FlightConditions) -> str | None:
    if flight.duration_s(flight.battery_low_since_us) <= BATTERY_LOW_S:
        return None
    status = flight.state.status
    return ", ".join(battery_figures(status.battery_remaining, status.battery_v))


@condition("before the first impact, the thrust predicted from mass and thrust curve is wrong by over 25 %")
def _hover_thrust(flight: FlightConditions) -> str | None:
    ratio = flight.thrust_ratio
    if (
        ratio is None
        or flight.impact is not None
        or flight.phase not in _AFTER_CLIMB
        or not flight.mission.collisions
    ):
        return None
    if abs(ratio - 1.0) <= THRUST_SCALE_LIMIT:
        return None
    mass_kg, allowed = flight.mission.vehicle.airframe.mass_kg, THRUST_SCALE_LIMIT
    text = f"the thrust curve gives a mass of {mass_kg / max(ratio, 0.01):.2f} kg, airframe.mass_kg is "
    return f"{text}{mass_kg:g}: ratio {ratio:.2f}, limits {1.0 - allowed:.2f} to {1.0 + allowed:.2f}"


@condition("the tilt exceeds the largest angle from which PX4 reliably recovers", "guard.tilt_deg")
def _tilt(flight: FlightConditions) -> str | None:
    tilt = math.degrees(flight.state.tilt_rad)
    return f"{tilt:.0f} deg, limit {flight.config.tilt_deg:g} deg" if tilt > flight.config.tilt_deg else None


@condition(
    "the vehicle is horizontally outside bounds_m, or would stop outside bounds_m", "bounds_m.x, bounds_m.y"
)
def _bounds(flight: FlightConditions) -> str | None:
    if flight.estimator.resets.reckoned is not None:
        return None  # PX4's position is wrong
    bounds = flight.mission.bounds
    excess = bounds.excess2(flight.state.position)
    if flight.phase is Phase.OVERRULED:  # the guard brakes already, and may break off outwards
        return f"{excess:.2f} m outside bounds_m" if excess > _GUARD_STRAYS_M else None
    if excess > 0.0:
        return f"{excess:.2f} m outside bounds_m"
    excess = flight.stop_excess_m()
    return f"the vehicle would stop {excess:.2f} m outside bounds_m" if excess > 0.0 else None


@condition(
    "the altitude is outside bounds_m; the tolerance is larger after an impact",
    f"bounds_m.z, {ALTITUDE_TOLERANCE_M:g} m",
)
def _altitude(flight: FlightConditions) -> str | None:
    if flight.phase in ALTITUDE_EXEMPT or not flight.was_inside:
        return None
    low, high = flight.mission.bounds.z
    tolerance = ALTITUDE_TOLERANCE_M if flight.just_after_impact else _ALTITUDE_SLACK_M
    z = flight.state.position[2]
    return None if low - tolerance <= z <= high + tolerance else f"{z:.2f} m, limits {low:g} to {high:g} m"


@condition("the vehicle is faster than the mission allows", "limits.speed_m_s")
def _speed(flight: FlightConditions) -> str | None:
    speed, limit = norm(flight.state.velocity), flight.mission.limits.speed_m_s
    return f"{speed:.2f} m/s, limit {limit:g} m/s" if speed > limit * _SPEED_TOLERANCE else None


@condition(
    "the force during a contact exceeds the limit and its margin",
    f"limits.peak_force_n, {FORCE_MARGIN:g} times",
)
def _force(flight: FlightConditions) -> str | None:
    limit = flight.mission.limits.peak_force_n * FORCE_MARGIN
    force = horizontal(flight.force.force_mission) if flight.force is not None else 0.0
    return f"{force:.0f} N, limit {limit:g} N" if force > limit else None


@condition("the operator stopped the flight before take-off")
def _operator_stops(flight: FlightConditions) -> str | None:
    stops = flight.is_asked(Request.LAND) and flight.phase in ON_GROUND and not flight.state.status.armed
    return "stopped by the operator before take-off" if stops else None


@condition("the simulated vehicle ended")
def _world_died(flight: FlightConditions) -> str | None:
    if flight.request is None or not flight.is_asked(Request.WORLD_DIED):
        return None
    return flight.request.detail or "the simulated vehicle ended"


_TWO = f"{STAMP_TOLERANCE_S:g} s, {POSITION_JUMP_M:g} m"
_TERMINATED = RuleCondition(
    "PX4 terminated the flight, or a kill switch was used: motors off", "", lambda flight: flight.termination
)
_ANNOUNCED = RuleCondition(
    "PX4 announced a failsafe, but telemetry does not show its mode yet",
    "",
    lambda flight: flight.failsafe_announced,
)
_OTHER_VEHICLE = RuleCondition(
    "a second vehicle, with the same or another system id, sends on the link",
    _TWO,
    lambda flight: flight.others.any_system,
)
_SAME_SYSTEM = RuleCondition(
    "two vehicles share one system id: the samples alternate between two clocks or two positions",
    _TWO,
    lambda flight: flight.others.same_system,
)
_OPERATOR_LANDS = RuleCondition(
    "the operator requested a landing (Ctrl-C)",
    "",
    lambda flight: "landing requested" if flight.is_asked(Request.LAND) else None,
)
_OPERATOR_RELEASES = RuleCondition(
    "the operator released the vehicle (second Ctrl-C)",
    "",
    lambda flight: "released by the operator" if flight.is_asked(Request.RELEASE) else None,
)


# --- the table ---------------------------------------------------------------------------------------------


def _found(
    name: str, action: Override, description: str, threshold: str = "", of_streams: bool = False
) -> Rule:
    """Return a rule that fires on a finding; only the mission, which has the plan, can report the finding."""
    return Rule(name, action, Scope.ALWAYS, RuleCondition(description, threshold), of_streams=of_streams)


_ALWAYS, _GROUND, _AIR = Scope.ALWAYS, Scope.GROUND, Scope.AIR
_GUIDED, _FLYING = Scope.GUIDED, Scope.FLYING
_GIVE_UP, _BREAK_OFF, _HOLD = Override.GIVE_UP, Override.BREAK_OFF, Override.HOLD
_LAND, _KILL, _RELEASE = Override.LAND, Override.KILL, Override.RELEASE
_MODE = (StatusSample, StatusText)  # PX4's texts identify the cause of a mode change
_MOTORS, _REQUEST, _POSITION = (StatusSample, ActuatorSample), (OperatorRequest,), (OdometrySample,)
_SILENT = ("odometry_silent", "attitude_silent", "imu_silent", "status_silent")
_STEPS = ("estimator_jump", "estimator_reset", "heading_reset", "position_delayed", "tilt", "bounds", "speed")
_BY_TWO = frozenset((*_SILENT, *_STEPS, "stamps_backwards", "estimator_flags", "altitude", "stream_rate"))

# fmt: off
RULES: tuple[Rule, ...] = (
    Rule("px4_failsafe", _RELEASE, _ALWAYS, _px4_failsafe, _MODE),
    Rule("terminated", _RELEASE, _AIR, _TERMINATED, _MODE),
    Rule("failsafe_announced", _BREAK_OFF, _FLYING, _ANNOUNCED, _MODE),
    Rule("pilot", _RELEASE, _ALWAYS, _pilot, _MODE, by_person=True),
    Rule("disarmed", _RELEASE, _AIR, _disarmed, _MOTORS),
    *STREAM_RULES,
    Rule("second_vehicle_ground", _GIVE_UP, _GROUND, _OTHER_VEHICLE, (OtherVehicle,)),
    Rule("second_vehicle", _LAND, _AIR, _SAME_SYSTEM, explains=_BY_TWO),
    Rule("stamps_backwards", _LAND, _AIR, _stamps_backwards, of_streams=True),
    Rule("imu_stuck", _LAND, _AIR, _imu_stuck),
    Rule("imu_clipped", _LAND, _AIR, _imu_clipped),
    *POSE_RULES,  # before the estimator's rules, because wrong poses cause estimator faults
    *ESTIMATOR_RULES,
    Rule("position_uncertain", _LAND, _GUIDED, _position_uncertain, noted=True),
    Rule("position_delayed", _BREAK_OFF, _FLYING, _position_delayed),
    Rule("battery", _LAND, _AIR, _battery),
    Rule("still_armed", _KILL, _AIR, _still_armed),
    Rule("lying", _KILL, _AIR, _lying),
    Rule("hover_thrust", _BREAK_OFF, _FLYING, _hover_thrust),
    # Break off before landing, as for `mode_felt`: in land mode PX4 levels slowly, and the vehicle drifts.
    Rule("tilt", _BREAK_OFF, _AIR, _tilt, (AttitudeSample,), noted=True),
    Rule("altitude", _LAND, _GUIDED, _altitude, _POSITION, noted=True),
    Rule("bounds", _HOLD, _GUIDED, _bounds, _POSITION, noted=True),
    Rule("speed", _HOLD, _FLYING, _speed, _POSITION),
    Rule("force_over_limit", _BREAK_OFF, _FLYING, _force, (ImuSample,)),
    Rule("operator_ground", _LAND, _ALWAYS, _operator_stops, _REQUEST),
    Rule("operator", _BREAK_OFF, _ALWAYS, _OPERATOR_LANDS, _REQUEST),
    Rule("operator_release", _RELEASE, _ALWAYS, _OPERATOR_RELEASES, _REQUEST, by_person=True),
    Rule("world_died", _RELEASE, _ALWAYS, _world_died, _REQUEST),
    _found("peak_force", _BREAK_OFF, "the peak force of an impact exceeded the limit", "limits.peak_force_n"),
    _found("harder_hit", _BREAK_OFF,
           "the peak force of an impact exceeded the limit of this collision", "collisions[].peak_limit_n"),
    _found("wall_not_met", _BREAK_OFF,
           "no contact with the wall at the planned position or time",
           "guard.wall_overrun_m, guard.wall_late_s, limits.collision_timeout_s"),
    _found("wall_met_early", _BREAK_OFF,
           "a contact occurred far before the planned wall", "guard.wall_early_m"),
    _found("hit_in_noise", _BREAK_OFF,
           "the planned impact is below the detection limit at the measured vibration level",
           "detection.noise_sigma"),
    _found("unplanned_hit", _BREAK_OFF,
           "an impact is not planned; a second impact at the same wall within 1 s is only noted"),
    _found("no_peak", _BREAK_OFF, "the contact force does not decay", "detection.peak_wait_s"),
    _found("lock_not_settled", _BREAK_OFF,
           "the lock is not in the planned mode during the approach or at the impact"),
    _found("mode_felt", _BREAK_OFF,
           "a contact indicates one mode, but the lock reports the other; with `mode_mismatch: go_on` the "
           "difference is noted without an action",
           "mode_mismatch"),
    _found("lock_late", _BREAK_OFF,
           "the lock is not in the planned mode at the last moment for stopping; to continue, the lock must "
           "settle at least 0.05 s before the impact, and the impact must be acceptable in both modes"),
    _found("lock_not_ready", _LAND,
           "the lock did not reach the planned mode before the approach", "lock.timeout_s"),
    _found("no_approach", _HOLD,
           "the measured position of a wall leaves too little space for the approach", "bounds_m"),
    _found("climb_timeout", _LAND, "the altitude was not reached in time", "flying.ready_timeout_s"),
    _found("transit_timeout", _HOLD,
           "the run-up point or a waypoint was not reached in time", "flying.ready_timeout_s"),
    _found("pause_timeout", _LAND, "the operator did not end the pause in time"),
    _found("goal_not_reached", _LAND,
           "the vehicle did not reach and hold the goal in time", "goal.hold_s, limits.collision_timeout_s"),
    _found("not_ready", _GIVE_UP,
           "telemetry or lock was not ready before take-off", "flying.ready_timeout_s", of_streams=True),
    _found("offboard_refused", _GIVE_UP, "PX4 refused offboard mode", "flying.ready_timeout_s"),
    _found("arming_refused", _GIVE_UP, "PX4 refused to arm", "flying.ready_timeout_s"),
    _found("mission_fault", _LAND, "the code of the mission or of the guard raised an exception"),
)
# fmt: on

RULES_BY_NAME = {rule.name: rule for rule in RULES}
