"""The one table of the guard's rules: name, what it says, threshold, action, who judges it.

`guard` iterates over it; `docs/guard.md` is generated from it (`make docs`). A rule with a `cause` is judged
here at every step of its `scope`; one without is reported by name by who knows the plan (the executive) or
the fault (the core). Nothing outside of this table can overrule the mission.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntEnum, StrEnum

import msgspec

from dart_flight.core.guard.watch import View, low_rate
from dart_flight.core.mission.phases import ALTITUDE_EXEMPT, ON_GROUND, Phase
from dart_flight.geometry import horizontal, norm
from dart_flight.samples import FlightMode

_SPEED_TOLERANCE = 1.1
_STALE_SAMPLES = 5  # in a row; one late datagram is no clock that runs backwards
_OTHERS_SINCE = 12  # a tenth of a second of one other stream
_ALTITUDE_SLACK_M = 0.05


class Action(IntEnum):
    """What an override does; a higher one replaces a lower one."""

    NONE = 0
    GIVE_UP = 1  # on the ground: the mission ends before it has begun
    BREAK_OFF = 2  # away from the wall, hold, land
    HOLD = 3  # stop here, then land
    LAND = 4
    KILL = 5  # motors off, whatever PX4 believes
    RELEASE = 6  # silence: somebody else flies


class Scope(StrEnum):
    """When a rule is judged."""

    ALWAYS = "always"
    AIR = "in the air"
    FLYING = "while the mission flies"  # not while landing or once overruled


class Rule(msgspec.Struct, frozen=True):
    """One rule.

    Attributes:
        name: as in the log and in the verdict.
        says: what is wrong, in words.
        threshold: keys of the vehicle's configuration or of the mission that it compares with.
        action: what the guard does.
        scope: when it is judged.
        judge: `guard`, `executive` or `core`.
        cause: says what is wrong now, or None; only for rules that the guard judges.
        by_person: a person took over: the flight counts as released, not as aborted.
    """

    name: str
    says: str
    threshold: str
    action: Action
    scope: Scope = Scope.AIR
    judge: str = "guard"
    cause: Callable[[View], str | None] | None = None
    by_person: bool = False


# --- causes ------------------------------------------------------------------------------------------------


def _pilot(v: View) -> str | None:
    mode = v.foreign_mode
    return f"PX4 is in {mode.value}" if mode is not None and not _by_px4(v) else None


def _px4_failsafe(v: View) -> str | None:
    mode = v.foreign_mode
    return f"PX4 is in {mode.value}" if mode is not None and _by_px4(v) else None


def _by_px4(v: View) -> bool:
    # No failsafe of PX4 hands over to sticks; a gap in the telemetry hides what PX4 says.
    return v.foreign_mode is not FlightMode.MANUAL and (v.failsafe_said or v.was_cut_off)


def _disarmed(v: View) -> str | None:
    status = v.state.status
    if v.was_armed and not status.armed and not v.state.on_ground and not v.land_asked:
        return "PX4 has disarmed in the air"
    return None


def _silent(stream: str, limit_s: Callable[[View], float]) -> Callable[[View], str | None]:
    def cause(v: View) -> str | None:
        age = v.age_s(stream)
        return f"for {min(age, 999.0) * 1e3:.0f} ms" if age > limit_s(v) else None

    return cause


def _imu_silent(v: View) -> str | None:
    age = v.age_s("imu")
    # While the other streams go on it is the IMU; when all pause, as on a busy host, that is given longer.
    alone = age > v.config.imu_timeout_s and v.since_imu >= _OTHERS_SINCE
    if alone or age > v.config.stream_timeout_s:
        return f"for {min(age, 999.0) * 1e3:.0f} ms"
    return None


def _status_silent(v: View) -> str | None:
    age = v.status_age_s
    return f"for {age:.1f} s" if age > v.config.status_timeout_s else None


def _link_lost(v: View) -> str | None:
    if v.age_s("imu") <= v.config.link_lost_s:  # as nearly always
        return None
    age = min(v.status_age_s, *(v.age_s(name) for name in ("imu", "attitude", "odometry")))
    return f"nothing from the vehicle for {age:.1f} s" if age > v.config.link_lost_s else None


def _stamps_backwards(v: View) -> str | None:
    for name, count in v.stale.items():
        if count >= _STALE_SAMPLES:
            return f"{name}: {count} samples in a row more than {v.config.stamp_tolerance_s:g} s in the past"
    return None


def _imu_stuck(v: View) -> str | None:
    lasting = v.lasting_s(v.stuck_since_us)
    return f"the same reading for {lasting * 1e3:.0f} ms" if lasting > v.config.imu_stuck_s else None


def _imu_clipped(v: View) -> str | None:
    lasting = v.lasting_s(v.clipped_since_us)
    return f"at full scale for {lasting * 1e3:.0f} ms" if lasting > v.config.imu_clipped_s else None


def _estimator_jump(v: View) -> str | None:
    return v.jump or None


def _estimator_reset(v: View) -> str | None:
    return v.reset_step()


def _estimator_flags(v: View) -> str | None:
    lasting = v.lasting_s(v.flags_bad_since_us)
    return f"no valid estimate for {lasting:.1f} s" if lasting > v.config.estimator_bad_s else None


def _still_armed(v: View) -> str | None:
    limit = v.surely_down_s
    return f"after {v.landing_s:.0f} s in land mode" if limit is not None and v.landing_s > limit else None


def _battery(v: View) -> str | None:
    if v.lasting_s(v.battery_low_since_us) <= v.config.battery_low_s:
        return None
    status = v.state.status
    left = "" if status.battery_remaining is None else f"{100.0 * status.battery_remaining:.0f} %"
    volts = "" if status.battery_v is None else f"{status.battery_v:.1f} V"
    return ", ".join(part for part in (left, volts) if part)


def _tilt(v: View) -> str | None:
    tilt = math.degrees(v.state.tilt_rad)
    return f"{tilt:.0f} deg" if tilt > v.config.tilt_deg else None


def _bounds(v: View) -> str | None:
    bounds = v.mission.bounds
    excess = bounds.excess2(v.state.position)
    if excess > 0.0:
        return f"{excess:.2f} m outside"
    v.inside_once = True
    excess = bounds.excess2(v.stop_point())
    return f"would stop {excess:.2f} m outside" if excess > 0.0 else None


def _altitude(v: View) -> str | None:
    if v.phase in ALTITUDE_EXEMPT:
        return None
    low, high = v.mission.bounds.z
    tolerance = v.config.altitude_tolerance_m if v.shaken else _ALTITUDE_SLACK_M
    z = v.state.position[2]
    return None if low - tolerance <= z <= high + tolerance else f"{z:.2f} m"


def _speed(v: View) -> str | None:
    speed = norm(v.state.velocity)
    return f"{speed:.2f} m/s" if speed > v.mission.limits.speed_m_s * _SPEED_TOLERANCE else None


def _force(v: View) -> str | None:
    limit = v.mission.limits.peak_force_n * v.config.force_margin
    for estimate in v.forces:
        force = horizontal(estimate.force_mission)
        if force > limit:
            return f"{force:.0f} N"
    return None


# --- the table ---------------------------------------------------------------------------------------------

_A, _S = Action, Scope


def _told(name: str, judge: str, action: Action, threshold: str, says: str, *, person: bool = False) -> Rule:
    return Rule(name, says, threshold, action, _S.ALWAYS, judge, None, person)


RULES: tuple[Rule, ...] = (
    Rule(
        "px4_failsafe",
        "PX4 has left offboard by itself: its failsafe flies",
        "",
        _A.RELEASE,
        _S.ALWAYS,
        cause=_px4_failsafe,
    ),
    Rule(
        "pilot",
        "somebody has taken PX4 out of offboard: the pilot flies",
        "",
        _A.RELEASE,
        _S.ALWAYS,
        cause=_pilot,
        by_person=True,
    ),
    Rule("disarmed", "PX4 has disarmed in the air", "", _A.RELEASE, cause=_disarmed),
    Rule(
        "link_lost",
        "nothing at all comes from the vehicle: PX4's own failsafe must act",
        "guard.link_lost_s",
        _A.RELEASE,
        cause=_link_lost,
    ),
    Rule(
        "imu_silent",
        "no IMU sample for too long: impacts cannot be felt",
        "guard.imu_timeout_s, guard.stream_timeout_s",
        _A.LAND,
        cause=_imu_silent,
    ),
    Rule(
        "attitude_silent",
        "no attitude for too long: forces have no direction",
        "guard.stream_timeout_s",
        _A.LAND,
        cause=_silent("attitude", lambda v: v.config.stream_timeout_s),
    ),
    Rule(
        "odometry_silent",
        "no position for too long",
        "guard.stream_timeout_s",
        _A.LAND,
        cause=_silent("odometry", lambda v: v.config.stream_timeout_s),
    ),
    Rule(
        "actuator_silent",
        "no motor outputs for too long: thrust cannot be told from contact",
        "guard.actuator_timeout_s",
        _A.HOLD,
        _S.FLYING,
        cause=_silent("actuator", lambda v: v.config.actuator_timeout_s),
    ),
    Rule(
        "status_silent",
        "no heartbeat for too long",
        "guard.status_timeout_s",
        _A.LAND,
        cause=_status_silent,
    ),
    Rule(
        "stream_rate",
        "a stream comes at less than the rate that a mission needs (`streams.py`)",
        "streams: expected_hz",
        _A.HOLD,
        _S.FLYING,
        cause=low_rate,
    ),
    Rule(
        "stamps_backwards",
        "the autopilot's time stamps have gone back: it has restarted, or its clock has",
        "guard.stamp_tolerance_s",
        _A.LAND,
        cause=_stamps_backwards,
    ),
    Rule(
        "imu_stuck",
        "the IMU repeats one reading: no sensor is that quiet",
        "guard.imu_stuck_s",
        _A.LAND,
        cause=_imu_stuck,
    ),
    Rule(
        "imu_clipped",
        "the IMU stays at full scale longer than any contact lasts",
        "guard.imu_clipped_s",
        _A.LAND,
        cause=_imu_clipped,
    ),
    Rule(
        "estimator_jump",
        "position or velocity has jumped, other than shortly after an impact",
        "guard.position_jump_m, guard.velocity_jump_m_s, guard.impact_window_s",
        _A.HOLD,
        _S.FLYING,
        cause=_estimator_jump,
    ),
    Rule(
        "estimator_reset",
        "PX4's estimator counts a reset and position or velocity step, other than shortly after an impact",
        "guard.reset_position_m, guard.reset_velocity_m_s, guard.impact_window_s",
        _A.HOLD,
        _S.FLYING,
        cause=_estimator_reset,
    ),
    Rule(
        "estimator_flags",
        "PX4's estimator says that its position is not valid, and the impact is over",
        "guard.estimator_bad_s, guard.impact_window_s",
        _A.LAND,
        cause=_estimator_flags,
    ),
    Rule(
        "battery",
        "the battery is low",
        "guard.battery_remaining, guard.battery_v, guard.battery_low_s",
        _A.LAND,
        cause=_battery,
    ),
    Rule(
        "still_armed",
        "in PX4's land mode and still armed long after a landing must have ended",
        "guard.kill_after_s, bounds_m.z",
        _A.KILL,
        cause=_still_armed,
    ),
    Rule("tilt", "tilted further than PX4 can be trusted to right", "guard.tilt_deg", _A.LAND, cause=_tilt),
    Rule(
        "altitude",
        "outside of the flight space vertically; more is allowed after an impact",
        "bounds_m.z, guard.altitude_tolerance_m, guard.impact_window_s",
        _A.LAND,
        _S.FLYING,
        cause=_altitude,
    ),
    Rule(
        "bounds",
        "outside of the flight space horizontally, or would stop there",
        "bounds_m.x, bounds_m.y",
        _A.HOLD,
        _S.FLYING,
        cause=_bounds,
    ),
    Rule("speed", "faster than the mission allows", "limits.speed_m_s", _A.HOLD, _S.FLYING, cause=_speed),
    Rule(
        "force_over_limit",
        "the contact force goes well over the limit while it lasts",
        "limits.peak_force_n, guard.force_margin",
        _A.BREAK_OFF,
        _S.FLYING,
        cause=_force,
    ),
    _told(
        "peak_force", "executive", _A.BREAK_OFF, "limits.peak_force_n", "an impact's peak was over the limit"
    ),
    _told(
        "wall_not_met",
        "executive",
        _A.BREAK_OFF,
        "guard.wall_overrun_m, guard.wall_late_s, limits.collision_timeout_s",
        "the wall was not met where or when it should have been",
    ),
    _told(
        "wall_met_early",
        "executive",
        _A.BREAK_OFF,
        "guard.wall_early_m",
        "a contact well before the planned wall",
    ),
    _told("unplanned_hit", "executive", _A.BREAK_OFF, "", "an impact where the plan has none"),
    _told(
        "no_peak",
        "executive",
        _A.BREAK_OFF,
        "detection.peak_wait_s",
        "a contact whose force does not fall again",
    ),
    _told(
        "lock_not_settled",
        "executive",
        _A.BREAK_OFF,
        "",
        "the lock is not in the planned mode in the approach or at the impact",
    ),
    _told(
        "lock_late",
        "executive",
        _A.BREAK_OFF,
        "",
        "the lock is not in the planned mode when holding still just stops short of the wall",
    ),
    _told(
        "lock_not_ready",
        "executive",
        _A.LAND,
        "lock.timeout_s",
        "the lock did not reach the planned mode before the approach",
    ),
    _told(
        "climb_timeout",
        "executive",
        _A.LAND,
        "flying.ready_timeout_s",
        "the altitude was not reached in time",
    ),
    _told(
        "transit_timeout",
        "executive",
        _A.HOLD,
        "flying.ready_timeout_s",
        "the run-up point was not reached in time",
    ),
    _told(
        "goal_not_reached",
        "executive",
        _A.LAND,
        "goal.hold_s, limits.collision_timeout_s",
        "the goal could not be held in time",
    ),
    _told(
        "not_ready",
        "executive",
        _A.GIVE_UP,
        "flying.ready_timeout_s",
        "telemetry or lock are not ready on the ground",
    ),
    _told(
        "offboard_refused", "executive", _A.GIVE_UP, "flying.ready_timeout_s", "PX4 does not go into offboard"
    ),
    _told("arming_refused", "executive", _A.GIVE_UP, "flying.ready_timeout_s", "PX4 does not arm"),
    _told("operator", "core", _A.BREAK_OFF, "", "the operator asks to land (Ctrl-C)"),
    _told("operator_ground", "core", _A.LAND, "", "the operator stops the flight before take-off"),
    _told(
        "operator_release",
        "core",
        _A.RELEASE,
        "",
        "the operator lets go of the vehicle (second Ctrl-C)",
        person=True,
    ),
    _told("world_died", "core", _A.RELEASE, "", "the simulated vehicle is gone"),
    _told("mission_fault", "core", _A.LAND, "", "an exception in the mission's own code"),
)

RULES_BY_NAME = {rule.name: rule for rule in RULES}


def in_scope(rule: Rule, phase: Phase) -> bool:
    """Whether a rule is judged in a phase."""
    if rule.scope is Scope.ALWAYS:
        return True
    if phase in ON_GROUND:  # there the executive's time-outs judge
        return False
    return rule.scope is Scope.AIR or phase not in (Phase.OVERRULED, Phase.LANDING)


def table() -> str:
    """The rules as a Markdown table, one row each."""
    rows = ["| rule | fires when | threshold | action | judged by |", "|---|---|---|---|---|"]
    for rule in RULES:
        scope = f"{rule.judge}, {rule.scope.value}" if rule.cause is not None else rule.judge
        keys = ", ".join(f"`{key}`" for key in rule.threshold.split(", ") if key) or "-"
        action = rule.action.name.lower().replace("_", " ")
        rows.append(f"| `{rule.name}` | {rule.says} | {keys} | {action} | {scope} |")
    return "\n".join(rows) + "\n"
