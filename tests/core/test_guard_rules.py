"""The table of the guard's rules: each rule fires on its cause, and not if it is removed from the table."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from itertools import product
from pathlib import Path

import msgspec
import pytest

from dart_flight.base.geometry import Vec3, quaternion_from_euler
from dart_flight.base.records import (
    EstimatorSample,
    FlightMode,
    GuardEvent,
    LockCommand,
    MissionEnd,
    Mode,
    OdometrySample,
    Output,
    Override,
    Phase,
    PhaseChange,
    Request,
    Setpoint,
    Silence,
    StatusText,
    Tick,
    VehicleAction,
    VehicleCommand,
)
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.core import flight_core
from dart_flight.core.guard.estimator_watch import ESTIMATOR_BAD_S, VELOCITY_JUMP_M_S
from dart_flight.core.guard.flight_conditions import FlightConditions
from dart_flight.core.guard.rule import Rule, Scope, in_scope
from dart_flight.core.guard.rules import (
    _ALTITUDE_SLACK_M,
    _SPEED_TOLERANCE,
    ALTITUDE_TOLERANCE_M,
    BATTERY_LOW_S,
    IMU_STUCK_S,
    RULES,
)
from dart_flight.core.guard.second_vehicle import POSITION_JUMP_M
from dart_flight.core.mission import executive
from dart_flight.core.mission.position_loop import STOP_TIME_S
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.sense.senses import IMPACT_WINDOW_S, Sensed
from tests.core.conftest import RULES_WITHOUT_JUMP, HandFedCore, core_in, known, of_kind
from tests.core.guard_causes import ACTIONS, CAUSES, delay_telemetry, fly_to_acrylic, request, rigid_pulse


@pytest.mark.parametrize("force_ned", [(250.0, 0.0, 0.0), (0.0, 250.0, 0.0), (0.0, 0.0, -250.0)])
def test_an_imu_clipped_on_any_axis_is_reported(force_ned: Vec3) -> None:
    c = core_in(Phase.APPROACH)
    c.force_ned = force_ned
    c.run(0.3)
    assert "imu_clipped" in c.fired_rules


def jump_position(c: HandFedCore) -> None:
    c.shift(east_m=-0.4)


def reset_estimator(c: HandFedCore) -> None:
    c.reset_estimator()
    c.shift(north_m=0.08)


def tilt_over(c: HandFedCore) -> None:
    c.q = quaternion_from_euler(1.2, 0.0, 0.0)


@pytest.mark.parametrize(
    ("first", "then", "rule"),
    [(jump_position, reset_estimator, "estimator_reset"), (jump_position, tilt_over, "tilt")],
)
def test_a_further_fault_is_recorded_once_while_the_guard_holds(
    first: Callable[[HandFedCore], None], then: Callable[[HandFedCore], None], rule: str
) -> None:
    """The action does not change, but whoever reads the log must know."""
    c = core_in(Phase.APPROACH)
    c.run(1.0)
    c.use_rules(RULES)
    first(c)
    c.run(0.2)
    assert c.fired[0].action is Override.HOLD
    before = len(c.fired)
    then(c)
    c.run(0.2)
    recorded = [event for event in c.fired[before:] if event.rule == rule]
    assert [event.action for event in recorded] == [Override.NONE]
    assert c.core.override is Override.HOLD


def climb_out(c: HandFedCore) -> None:
    c.position_ned = (*c.position_ned[:2], -2.4)


empty_battery = CAUSES["battery"].fly


def switch_to(mode: FlightMode, text: str = "") -> Callable[[HandFedCore], None]:
    def switch(c: HandFedCore) -> None:
        if text:
            c.feed(StatusText(c.t_us, c.t_us, "critical", text))
        c.set_status(flight_mode=mode)

    return switch


slow_down_odometry = CAUSES["stream_rate"].fly


def end_odometry(c: HandFedCore) -> None:
    c.odometry_every = 10_000
    c.run(0.7)


@pytest.mark.parametrize(
    ("first", "then", "reason", "others"),
    [
        (tilt_over, climb_out, "tilt", {"altitude"}),
        (CAUSES["position_delayed"].fly, jump_position, "position_delayed", {"estimator_jump"}),
        (jump_position, empty_battery, "estimator_jump", {"battery"}),
        (CAUSES["heading_reset"].fly, climb_out, "heading_reset", {"altitude"}),
        # A later rule that explains the first one.
        (slow_down_odometry, end_odometry, "odometry_silent", {"stream_rate"}),
        (slow_down_odometry, delay_telemetry, "telemetry_late", {"stream_rate"}),
        # A release.
        (tilt_over, switch_to(FlightMode.MANUAL), "pilot", {"tilt"}),
        (tilt_over, switch_to(FlightMode.LAND, "Failsafe activated"), "px4_failsafe", {"tilt"}),
        (empty_battery, request(Request.RELEASE), "operator_release", {"battery"}),
    ],
)
def test_the_reason_is_the_first_rule_or_the_one_that_explains_it(
    first: Callable[[HandFedCore], None], then: Callable[[HandFedCore], None], reason: str, others: set[str]
) -> None:
    c = core_in(Phase.APPROACH)
    if first is CAUSES["position_delayed"].fly:
        first(c)  # the cause lets the velocity jump
        c.use_rules(RULES)
    else:
        c.run(1.0)
        c.use_rules(RULES)
        first(c)
    c.run(0.2)
    (before,) = {event.rule for event in c.fired if event.action is not Override.NONE}
    then(c)
    c.run(0.3)
    assert known(c.guard.reason).partition(":")[0] == reason
    assert {before, *(event.rule for event in c.fired)} >= {reason, *others}


def test_every_rule_has_a_cause_here() -> None:
    assert set(CAUSES) == {rule.name for rule in RULES}


def test_each_cause_has_the_action_that_was_decided_for_it() -> None:
    decided = {name: action for action, names in ACTIONS.items() for name in names.split()}
    assert {rule.name: rule.action for rule in RULES} == decided


@pytest.mark.parametrize("rule", RULES, ids=lambda r: r.name)
def test_a_rule_fires_on_its_cause_and_is_reported(rule: Rule) -> None:
    c = CAUSES[rule.name].fire(RULES if rule.name == "estimator_jump" else RULES_WITHOUT_JUMP)
    events = c.fired
    mine = [e for e in events if e.rule == rule.name]
    assert len(mine) == 1, [(e.rule, e.detail) for e in events]
    assert mine[0].action == rule.action
    assert mine[0].detail.rpartition(" | ")[2] == CAUSES[rule.name].detail
    after = c.outputs[c.outputs.index(mine[0]) :]
    if rule.action is Override.RELEASE:
        assert any(isinstance(o, Silence) for o in after)
        assert not any(isinstance(o, Setpoint | VehicleCommand) for o in after)
        end = of_kind(MissionEnd, after)[0]
        assert end.outcome == ("released" if rule.by_person else "aborted")
        assert known(end.reason).startswith(rule.name)
    elif rule.action is not Override.GIVE_UP:
        assert c.core.override is rule.action
        assert c.core.phase in (Phase.OVERRULED, Phase.DONE)


def test_the_position_delay_is_not_checked_without_a_limit() -> None:
    """Vehicles in old logs have no such limit."""
    c = core_in(Phase.APPROACH, settings={"vehicle.guard.position_delay_s": None})
    CAUSES["position_delayed"].fly(c)
    assert not c.fired


def test_a_mode_mismatch_is_only_reported_if_the_mission_continues() -> None:
    c = core_in(Phase.APPROACH)
    rigid_pulse(c)
    (event,) = c.fired
    assert (event.rule, event.action) == ("mode_felt", Override.NONE)
    assert "contact with wall wood indicates rigid arms, but the lock reports flexible" in event.detail
    assert c.core.override is Override.NONE
    assert c.core.phase is Phase.RECOVERY


@pytest.mark.rest
@pytest.mark.parametrize("rule", RULES, ids=lambda r: r.name)
def test_a_removed_rule_is_not_reported(rule: Rule) -> None:
    c = CAUSES[rule.name].fire(tuple(r for r in RULES_WITHOUT_JUMP if r is not rule))
    assert rule.name not in c.fired_rules


def test_no_rule_fires_in_a_quiet_flight() -> None:
    c = core_in(Phase.APPROACH)
    c.run(1.0)
    assert not c.fired


@pytest.mark.parametrize("mode", [Mode.RIGID, Mode.FLEXIBLE])
def test_a_contact_after_a_recovery_needs_the_planned_mode_of_the_lock(mode: Mode) -> None:
    """A vehicle that does not close on the wall has no late lock, but it may still touch the wall."""
    c = core_in(Phase.APPROACH)
    fly_to_acrylic(c)
    c.set_lock(mode)
    c.position_ned, c.velocity_ned = (1.65, 0.9, -1.0), (0.0, 0.0, 0.0)
    c.run(0.3)
    assert not c.fired
    c.pulse((-20.0, 0.0))
    found = c.fired_details
    phases = [o.after for o in of_kind(PhaseChange, c.outputs)][-2:]
    if mode is Mode.RIGID:
        assert (found, phases) == ([], [Phase.CONTACT, Phase.RECOVERY])
    else:
        assert found == [("lock_not_settled", "contact with wall acrylic while the lock is not rigid")]
        assert phases == [Phase.RECOVERY, Phase.OVERRULED]


def test_a_wall_that_the_recovery_does_not_reach_is_given_up_after_a_timeout() -> None:
    c = core_in(Phase.APPROACH, settings={"limits.collision_timeout_s": 0.6})
    fly_to_acrylic(c)
    c.set_lock(Mode.RIGID)
    c.velocity_ned = (0.0, 0.0, 0.0)
    c.run(0.4)
    assert "wall_not_met" not in set(c.fired_rules)
    c.run(0.3)
    assert [e.detail for e in c.fired if e.rule == "wall_not_met"] == [
        "the recovery did not reach wall acrylic in time"
    ]


def test_the_mission_may_record_but_not_command_in_the_step_of_a_rule() -> None:
    c, proposal = core_in(Phase.APPROACH), Proposal()
    t_us = c.t_us
    record = PhaseChange(t_us, Phase.APPROACH, Phase.CONTACT, "impact", 1)
    commands: list[Output] = [
        Setpoint(t_us, t_us, (1.0, 0.0, -1.0), 0.0),
        VehicleCommand(t_us, VehicleAction.OFFBOARD),
        LockCommand(t_us, Mode.RIGID),
    ]
    proposal.outputs += [*commands, record]
    proposal.add_finding("wall_not_met", "by hand")
    out = c.guard.review(Tick(t_us), c.core.state, Sensed(), c.core.phase, proposal)
    assert of_kind(GuardEvent, out)
    assert record in out
    assert not [o for o in out if o in commands]


@pytest.mark.parametrize(
    ("found", "events"),
    [
        (("climb_timeout", "wall_not_met"), ["climb_timeout"]),
        (("wall_not_met", "climb_timeout"), ["wall_not_met", "climb_timeout"]),
        (("wall_not_met", "no_peak"), ["wall_not_met"]),
    ],
)
def test_a_weaker_finding_does_not_follow_a_stronger_one_in_one_step(
    found: tuple[str, str], events: list[str]
) -> None:
    c, proposal = core_in(Phase.APPROACH), Proposal()
    for name in found:
        proposal.add_finding(name, "by hand")
    out = c.guard.review(Tick(c.t_us), c.core.state, Sensed(), c.core.phase, proposal)
    assert [o.rule for o in of_kind(GuardEvent, out)] == events
    assert c.guard.action is (Override.LAND if "climb_timeout" in found else Override.BREAK_OFF)


@pytest.mark.parametrize(("axis", "side"), list(product((0, 1), (0, 1))))
def test_a_vehicle_must_be_able_to_stop_inside_the_bounds(axis: int, side: int) -> None:
    mission = load_mission(packaged("missions", "hover.yaml"))
    watch, limit_m = FlightConditions(mission), (mission.bounds.x, mission.bounds.y)[axis][side]
    outwards = 1.0 if side else -1.0

    def excess_m(inside_m: float, speed_m_s: float) -> float:
        position, velocity = [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]
        position[axis], velocity[axis] = limit_m - outwards * inside_m, outwards * speed_m_s
        watch.state.position = (position[0], position[1], position[2])
        watch.state.velocity = (velocity[0], velocity[1], velocity[2])
        return watch.stop_excess_m()

    for speed_m_s in (1.0, 2.0):
        assert excess_m(STOP_TIME_S * speed_m_s - 0.2, speed_m_s) == pytest.approx(0.2)
    assert (excess_m(STOP_TIME_S + 0.05, 1.0), excess_m(0.3, -1.0)) == (0.0, 0.0)


@pytest.mark.parametrize(("outside_m", "rules"), [(-0.01, []), (0.01, ["altitude"])])
@pytest.mark.parametrize("above", [True, False])
@pytest.mark.parametrize(
    ("hits_wall", "tolerance_m"), [(False, _ALTITUDE_SLACK_M), (True, ALTITUDE_TOLERANCE_M)]
)
def test_an_altitude_slightly_outside_the_flight_space_is_tolerated(
    hits_wall: bool, tolerance_m: float, above: bool, outside_m: float, rules: list[str]
) -> None:
    """The vertical force of a contact moves the vehicle."""
    c = HandFedCore()
    c.fly_to_wood()
    if hits_wall:
        c.pulse((-10.0, -16.0))
    low, high = c.core.mission.bounds.z
    up_m = high + tolerance_m + outside_m if above else low - tolerance_m - outside_m
    c.position_ned = (*c.position_ned[:2], -up_m)
    c.run(0.05)
    assert c.fired_rules == rules


@pytest.mark.parametrize(("share", "rules"), [(0.99, []), (1.01, ["speed"])])
def test_a_speed_slightly_above_its_limit_is_tolerated(share: float, rules: list[str]) -> None:
    c = core_in(Phase.APPROACH)
    c.velocity_ned = (0.0, 0.0, -share * _SPEED_TOLERANCE * c.core.mission.limits.speed_m_s)
    c.run(0.05)
    assert c.fired_rules == rules


WINDOW_US = round(1e6 * IMPACT_WINDOW_S)


@pytest.mark.parametrize(("later_us", "just_after"), [(WINDOW_US - 1, True), (WINDOW_US, False)])
def test_an_impact_excuses_the_estimator_for_a_limited_time(later_us: int, just_after: bool) -> None:
    c = core_in(Phase.APPROACH)
    c.pulse((0.0, -30.0))
    watch = c.conditions
    watch.state.now_us = known(watch.impact).t_us + later_us
    assert watch.just_after_impact is just_after


def test_a_reset_count_without_a_step_is_no_reset() -> None:
    c = core_in(Phase.APPROACH)
    c.reset_estimator()
    c.run(0.12)
    # A later step that is too small for `estimator_jump` is unrelated.
    c.shift(north_m=0.08)
    c.run(0.1)
    assert c.fired == []


@pytest.mark.parametrize(("more_m_s", "jumps"), [(0.1, True), (-0.1, False)])
def test_a_velocity_jump_is_an_estimator_jump(more_m_s: float, jumps: bool) -> None:
    c = core_in(Phase.APPROACH)
    c.use_rules(RULES)
    c.velocity_ned = (VELOCITY_JUMP_M_S + more_m_s, 0.0, 0.0)
    c.run(0.016)
    detail = f"velocity jumped by {VELOCITY_JUMP_M_S + more_m_s:.2f} m/s, limit {VELOCITY_JUMP_M_S:g} m/s"
    assert [e.detail for e in c.fired if e.rule == "estimator_jump"] == [detail] * jumps


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("along", "jumps"), [(1.0, False), (-1.0, True)])
def test_a_position_is_compared_with_its_extrapolation_by_velocity(
    axis: int, along: float, jumps: bool
) -> None:
    """Between two sparse samples, the motion is no jump forwards, but twice the motion is one backwards."""
    c, moved_m = core_in(Phase.TRANSIT), 0.85 * POSITION_JUMP_M
    fast, there = [0.0, 0.0, 0.0], list(c.position_ned)
    fast[axis] = moved_m / 0.09
    for away_m, after_us in ((0.0, 8000), (along * moved_m, 90_000)):
        there[axis], c.t_us = there[axis] + away_m, c.t_us + after_us
        position, velocity = (there[0], there[1], there[2]), (fast[0], fast[1], fast[2])
        c.feed(OdometrySample(c.t_us, c.t_us, position, velocity))
    message = f"position jumped by {2 * moved_m:.2f} m, limit {POSITION_JUMP_M:g} m"
    assert c.conditions.estimator.jump == (message if jumps else "")


@pytest.mark.parametrize("name", ["estimator_jump", "estimator_reset", "estimator_flags"])
def test_the_estimator_is_not_checked_shortly_after_an_impact(name: str) -> None:
    c = HandFedCore()
    c.fly_to_wood()
    c.pulse((-10.0, -16.0))
    c.set_lock(Mode.RIGID)
    c.run(0.15)
    c.use_rules(RULES)  # only now, because a teleport is a jump as well
    # One disturbance at a time: of two rules with the same action, only the first is reported.
    if name == "estimator_flags":
        c.feed(EstimatorSample(c.t_us, c.t_us, healthy=False))
    else:
        c.shift(north_m=0.4 if name == "estimator_jump" else 0.1)
    if name == "estimator_reset":
        c.reset_estimator()
    c.run(0.5)
    assert name not in c.fired_rules


def test_findings_of_other_modules_are_in_the_rule_table() -> None:
    names = {rule.name: rule for rule in RULES}
    found = set[str]()
    for source in Path(executive.__file__).parent.glob("*.py"):
        found |= set(re.findall(r'[fF]inding\(\s*"(\w+)"', source.read_text()))
    found |= set(re.findall(r'Finding\(\s*"(\w+)"', inspect.getsource(flight_core)))
    assert found == {name for name, rule in names.items() if rule.condition.cause is None}


def test_a_finding_without_a_rule_is_a_fault_of_the_mission() -> None:
    """A finding of a rule that exists, but not in this guard's table, is ignored."""
    c = core_in(Phase.APPROACH, rules=tuple(rule for rule in RULES_WITHOUT_JUMP if rule.name != "no_peak"))
    names = ["no_peak"]
    c.report_findings(names)
    c.run(0.02)
    assert (names, c.fired) == ([], [])
    names.append("no_such_rule")
    c.run(0.02)
    (event,) = c.fired
    assert (event.rule, event.action) == ("mission_fault", Override.LAND)
    assert "KeyError: 'no_such_rule'" in event.detail


@pytest.mark.parametrize(
    ("phase", "scopes"),
    [
        (Phase.READYING, {Scope.ALWAYS, Scope.GROUND}),
        (Phase.ARMING, {Scope.ALWAYS, Scope.GROUND}),
        (Phase.CLIMB, {Scope.ALWAYS, Scope.AIR, Scope.GUIDED, Scope.FLYING}),
        (Phase.RECOVERY, {Scope.ALWAYS, Scope.AIR, Scope.GUIDED, Scope.FLYING}),
        (Phase.LANDING, {Scope.ALWAYS, Scope.AIR}),
        (Phase.OVERRULED, {Scope.ALWAYS, Scope.AIR, Scope.GUIDED}),
        (Phase.DONE, set[Scope]()),
    ],
)
def test_a_scope_selects_the_phases_in_which_a_rule_is_evaluated(phase: Phase, scopes: set[Scope]) -> None:
    assert {scope for scope in Scope if in_scope(RULES[0]._replace(scope=scope), phase)} == scopes


def test_the_table_of_the_manual_names_scope_and_inputs_of_each_rule() -> None:
    page = (Path(__file__).parents[2] / "docs/guard.md").read_text("utf-8")
    generated = page.partition("<!-- begin: guard rules -->")[2].partition("<!-- end -->")[0]
    header, _, *rows = generated.strip().splitlines()
    assert header == "| rule | fires when | threshold | action | evaluated by |"
    assert [row.split("`")[1] for row in rows] == [rule.name for rule in RULES]
    by_name = {row.split("`")[1]: row for row in rows}
    assert by_name["imu_stuck"].endswith(f" | {IMU_STUCK_S:g} s | land | guard, in the air |")
    assert by_name["peak_force"].endswith(" | `limits.peak_force_n` | break off | mission |")
    for name, kinds in (("altitude", "`OdometrySample`"), ("disarmed", "`StatusSample`, `ActuatorSample`")):
        assert by_name[name].endswith(f", immediately after {kinds} |")


def test_thresholds_named_in_the_table_exist() -> None:
    c = HandFedCore()
    mission, vehicle = c.core.mission, c.core.mission.vehicle
    assert vehicle.lock is not None
    places = {
        "guard": vehicle.guard,
        "flying": vehicle.flying,
        "lock": vehicle.lock,
        "detection": vehicle.detection,
        "estimation": vehicle.estimation,
        "limits": mission.limits,
        "bounds_m": mission.bounds,
        "goal": mission.goal,
        "mode_mismatch": mission,
        "mocap": vehicle.mocap,
        "collisions[]": mission.collisions[0],
    }
    for rule in RULES:
        for key in filter(None, rule.condition.threshold.split(", ")):
            if key.startswith("streams:") or key[0].isdigit():
                continue
            section, *names = key.split(".")
            node = places[section]
            for name in names:
                assert name in {f.name for f in msgspec.structs.fields(node)}, key
                node = getattr(node, name)


@pytest.mark.parametrize(
    ("left", "says"),
    [
        ({"battery_remaining": 0.1, "battery_v": 15.0}, ["10 %, 15.0 V"]),
        ({"battery_remaining": 0.1}, ["10 %"]),
        ({"battery_remaining": 0.5, "battery_v": 12.9}, ["50 %, 12.9 V"]),
        ({"battery_v": 12.9}, ["12.9 V"]),
        ({"battery_remaining": 0.5, "battery_v": 15.0}, []),
        ({}, []),
    ],
)
def test_a_battery_is_low_by_its_charge_or_its_voltage(left: dict[str, float], says: list[str]) -> None:
    c = core_in(Phase.APPROACH)
    c.set_status(**left)
    c.run(BATTERY_LOW_S + 0.2)
    assert c.fired_details == [("battery", words) for words in says]


def test_a_battery_that_recovers_restarts_its_timer() -> None:
    """Repeated short current peaks are no low battery."""
    c = core_in(Phase.APPROACH)
    for _ in range(4):
        c.set_status(battery_v=12.9)
        c.run(0.6 * BATTERY_LOW_S)
        c.set_status(battery_v=15.0)
        c.run(0.1)
    assert not c.fired


def test_short_faults_do_not_add_up() -> None:
    c = core_in(Phase.APPROACH)
    for _ in range(6):
        c.feed(EstimatorSample(c.t_us, c.t_us, healthy=False))
        c.run(0.7 * ESTIMATOR_BAD_S)
        c.feed(EstimatorSample(c.t_us, c.t_us, healthy=True))
        c.run(0.05)
        c.noise_m_s2 = 0.0
        c.run(0.6 * IMU_STUCK_S)
        c.noise_m_s2 = 1e-4
        c.run(0.01)
    assert not c.fired


@pytest.mark.parametrize(
    ("position", "velocity", "words"),
    [
        ((1e33, 0.0, 0.0), (0.0, 0.0, 0.0), "implausible position: 1e+33 m from the origin at 0 m/s"),
        ((0.0, 0.0, -1.0), (0.0, -1e9, 0.0), "implausible position: 1 m from the origin at 1e+09 m/s"),
    ],
)
def test_an_implausible_position_is_reported_and_not_used(position: Vec3, velocity: Vec3, words: str) -> None:
    c = HandFedCore(rules=RULES)
    c.run(0.5)
    c.feed(OdometrySample(c.t_us + 1000, c.t_us + 1000, position, velocity))  # on the ground: rejected
    assert known(c.core.state.odometry).position_ned == c.position_ned
    c = core_in(Phase.CLIMB, rules=RULES)
    c.run(0.004)
    assert c.core.phase is Phase.CLIMB
    before = c.core.state.position
    c.feed(OdometrySample(c.t_us + 1000, c.t_us + 1000, position, velocity))
    assert c.fired_details == [("estimator_jump", words)]
    assert c.core.state.position == before
