"""The core's decisions, sample by sample: phases, recovery, guard. No world, no clock."""

import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.records import (
    ActuatorSample,
    CommandResult,
    ContactRequest,
    EstimatorSample,
    FlightMode,
    ForceEstimate,
    GuardEvent,
    HealthReport,
    ImpactOnset,
    ImpactPeak,
    Input,
    LandedState,
    LockCommand,
    LockPermission,
    LockPhase,
    MissionEnd,
    Mode,
    OdometrySample,
    Output,
    Phase,
    PhaseChange,
    Request,
    Setpoint,
    StatusSample,
    StatusText,
    Tick,
    TorqueEstimate,
    VehicleAction,
    VehicleCommand,
    WallEstimate,
)
from dart_flight.config.mission import load_mission
from dart_flight.core.mission.phases import ON_GROUND, TRANSITIONS, PhaseTrigger
from dart_flight.core.mission.recovery import recovery_point
from dart_flight.core.pace import BATCH_S
from dart_flight.core.sense.detector import ExpectedContact
from dart_flight.core.sense.senses import Senses
from dart_flight.planning.contact_fit import ContactFitter
from dart_flight.recording.anchor import MissionFrameReader
from tests.core.conftest import HOVER, ROOT, SINGLE, HandFedCore, core_in, known, of_kind
from tests.core.guard_causes import fly_to_acrylic


def test_offboard_is_requested_only_while_setpoints_are_streaming(hand_fed: HandFedCore) -> None:
    hand_fed.set_lock(Mode.RIGID)
    out = hand_fed.run(0.5)
    first_request = next(i for i, o in enumerate(out) if isinstance(o, VehicleCommand))
    assert out[first_request].action is VehicleAction.OFFBOARD  # type: ignore[union-attr]
    assert len(of_kind(Setpoint, out[:first_request])) >= 10
    assert not of_kind(VehicleCommand, [o for o in out if getattr(o, "action", None) is VehicleAction.ARM])


def test_a_command_is_repeated_until_telemetry_confirms_it(hasty_core: HandFedCore) -> None:
    """An acknowledgement is not enough: without telemetry the mission is given up in the end."""
    hasty_core.set_lock(Mode.RIGID)
    out = hasty_core.run(5.0)
    requests = [o for o in of_kind(VehicleCommand, out) if o.action is VehicleAction.OFFBOARD]
    assert len(requests) >= 3
    ends = of_kind(MissionEnd, out)
    assert [(e.outcome, e.reason) for e in ends] == [
        ("aborted", "offboard_refused: PX4 refused offboard mode")
    ]
    assert of_kind(PhaseChange, out)[-1].reason == "PX4 refused offboard mode"


def test_the_frame_follows_an_estimate_that_moves_on_the_ground(hand_fed: HandFedCore) -> None:
    """PX4 reset its height by 1.15 m between offboard and arming, and would fly that much too high."""
    hand_fed.enter_arming()
    hand_fed.position_ned = (0.2, 0.1, 1.15)
    hand_fed.run(0.3)
    hand_fed.set_status(armed=True)
    hand_fed.run(4.0)
    climb = next(c for c in of_kind(PhaseChange, hand_fed.outputs) if c.after is Phase.CLIMB)
    assert climb.reason == "confirmed by telemetry; the position estimate moved by 1.17 m on the ground"
    last = of_kind(Setpoint, hand_fed.outputs)[-1]
    # Height is relative to the vehicle on the ground; a surveyed room stays in place.
    assert last.position_ned == pytest.approx((0.2, 0.1, 1.15 - hand_fed.core.mission.altitude_m), abs=1e-6)
    reader = MissionFrameReader(hand_fed.core.mission)
    for record in hand_fed.records:
        reader.add(record)
    assert known(reader.frame).point_from_ned((0.2, 0.1, 1.15)) == pytest.approx((0.2, -0.1, 0.0), abs=1e-9)


def test_small_motion_of_the_estimate_does_not_move_the_frame(hand_fed: HandFedCore) -> None:
    hand_fed.set_lock(Mode.RIGID)
    hand_fed.run(0.5)
    hand_fed.set_status(flight_mode=FlightMode.OFFBOARD)
    hand_fed.position_ned = (0.0, 0.0, 0.04)
    hand_fed.run(0.2)
    hand_fed.set_status(armed=True)
    hand_fed.run(4.0)
    altitude_m = hand_fed.core.mission.altitude_m
    assert of_kind(Setpoint, hand_fed.outputs)[-1].position_ned[2] == pytest.approx(-altitude_m, abs=1e-6)


def test_the_core_waits_for_the_lock_before_it_sends_setpoints(hand_fed: HandFedCore) -> None:
    out = hand_fed.run(1.0)
    assert of_kind(LockCommand, out)[0].mode is Mode.RIGID
    assert not of_kind(Setpoint, out)
    assert hand_fed.core.phase is Phase.READYING


def test_one_impact_gives_one_onset_one_peak_and_one_setpoint(hand_fed: HandFedCore) -> None:
    hand_fed.fly_to_wood()
    out = hand_fed.pulse((-10.0, -16.0)) + hand_fed.run(0.1)
    assert len(of_kind(ImpactOnset, out)) == 1
    peaks = of_kind(ImpactPeak, out)
    assert len(peaks) == 1
    assert peaks[0].normal_force_n == pytest.approx(16.0, rel=0.03)
    assert peaks[0].tangential_force_n == pytest.approx(-10.0, rel=0.03)
    recovery = [o for o in of_kind(Setpoint, out) if o.recovery]
    assert len(recovery) == 1
    # In NED: y of the mission is west. Away from the wall by 0.025 * 16, onward by 0.12 * 10.
    north, east, down = recovery[0].position_ned
    assert north == pytest.approx(0.93 + 1.2, abs=0.06)
    assert east == pytest.approx(1.1 - 0.4, abs=0.06)
    assert down == pytest.approx(-1.0, abs=1e-6)
    # The setpoint is sent in the step that detects the peak.
    assert out.index(recovery[0]) - out.index(peaks[0]) <= 2


@pytest.mark.parametrize("along_n", [-10.0, 10.0])
def test_the_peak_force_comes_from_the_samples_if_no_pulse_fits(
    hand_fed: HandFedCore, monkeypatch: pytest.MonkeyPatch, along_n: float
) -> None:
    # The fit fails for no smooth pulse, and the peak of any other is not known exactly.
    monkeypatch.setattr("dart_flight.core.sense.detector.fit_normal", lambda *_: None)
    hand_fed.fly_to_wood()
    (peak,) = of_kind(ImpactPeak, hand_fed.pulse((along_n, -16.0)) + hand_fed.run(0.1))
    assert peak.normal_force_n == pytest.approx(16.0, rel=0.05)
    assert peak.tangential_force_n == pytest.approx(along_n, rel=0.05)


def test_force_bias_and_constant_torque_are_learned_only_in_free_flight(hand_fed: HandFedCore) -> None:
    """The ground and a wall also push."""
    senses = hand_fed.senses

    def learns(seconds: float) -> tuple[bool, bool]:
        """Return whether the thrust scale of the bias and the noise of the torque change in this time."""
        scale = senses.motion.hover.scale
        torques = of_kind(TorqueEstimate, hand_fed.run(seconds))
        assert torques
        return senses.motion.hover.scale != scale, len({one.noise_frd_nm for one in torques}) > 1

    hand_fed.enter_arming()
    assert learns(0.1) == (False, False)
    hand_fed.enter_climb()
    assert learns(0.1) == (True, True)
    hand_fed.position_ned = (0.0, 0.0, -1.0)
    hand_fed.run(1.0)
    hand_fed.force_ned = (-30.0, 0.0, 0.0)
    hand_fed.run(0.02)
    assert senses.detector.in_contact
    assert learns(0.1) == (False, False)
    assert senses.detector.in_contact
    # Every input of a contact reports the contact, not only the IMU samples.
    for item in (Tick(hand_fed.t_us), hand_fed.status, EstimatorSample(hand_fed.t_us, hand_fed.t_us)):
        assert senses.update(item, ExpectedContact()).in_contact


def test_the_position_delay_is_not_measured_in_a_contact_and_two_seconds_after_it(
    hand_fed: HandFedCore,
) -> None:
    """A measurement needs 13 odometry samples, 50 ms apart."""
    hand_fed.finish_climb()
    hand_fed.run(1.0)
    delay = hand_fed.senses.delay
    before = delay.figures
    hand_fed.run(0.1)
    assert delay.figures != before
    hand_fed.pulse((-30.0, 0.0))
    hand_fed.run(0.1)
    before = delay.figures
    hand_fed.run(2.4)
    assert delay.figures == before
    hand_fed.run(0.5)
    assert delay.figures != before


@pytest.mark.parametrize(("closing_m_s", "estimated"), [(0.1, True), (0.01, False), (-0.1, False)])
def test_a_contact_without_closing_speed_gives_no_wall_estimate(
    hand_fed: HandFedCore, closing_m_s: float, estimated: bool
) -> None:
    hand_fed.fly_to_wood()
    hand_fed.velocity_ned = (0.5, closing_m_s, 0.0)
    hand_fed.run(0.05)
    hand_fed.pulse((-10.0, -16.0))
    hand_fed.position_ned, hand_fed.velocity_ned = (1.0, 1.0, -1.0), (0.0, 0.0, 0.0)
    (request,) = of_kind(ContactRequest, hand_fed.run(0.2))
    answer = ContactFitter(hand_fed.core.mission.vehicle).answer(request)
    assert bool(answer.problem) is not estimated
    (estimate,) = of_kind(WallEstimate, hand_fed.feed(answer))
    assert (estimate.log_odds != 0.0) is estimated
    assert estimate.problem == answer.problem


def test_the_lock_never_moves_in_contact_or_before_the_arms_have_relaxed(hand_fed: HandFedCore) -> None:
    hand_fed.fly_to_wood()
    out = hand_fed.pulse((-10.0, -16.0))
    assert [p.permitted for p in of_kind(LockPermission, out)] == [False]
    assert not of_kind(LockCommand, out)
    hand_fed.position_ned = (1.0, 1.0, -1.0)
    end_us = hand_fed.t_us
    out = hand_fed.run(0.15)
    permission = of_kind(LockPermission, out)[0]
    command = of_kind(LockCommand, out)[0]
    assert permission.permitted
    assert command.mode is Mode.RIGID
    lock = known(hand_fed.core.mission.vehicle.lock)
    relaxation_us = lock.relaxation_s * 1e6
    assert command.t_us - end_us >= relaxation_us - 8000  # the contact ends a sample or two before the pulse


@pytest.mark.parametrize(
    ("phase", "fired"), [(LockPhase.TRAVELLING, [("lock_late", "break_off")]), (LockPhase.SETTLED, [])]
)
def test_only_a_late_lock_breaks_off_the_next_collision(
    hand_fed: HandFedCore, phase: LockPhase, fired: list[tuple[str, str]]
) -> None:
    hand_fed.enter_approach()
    fly_to_acrylic(hand_fed)
    hand_fed.set_lock(Mode.RIGID, phase)
    hand_fed.velocity_ned = (1.0, 0.0, 0.0)
    out = hand_fed.run(0.3)
    assert hand_fed.fired_actions == fired
    if fired:
        assert of_kind(Setpoint, out)[-1].position_ned[0] < 1.65 - 0.45  # back from the acrylic wall


# --- the guard (its rules one by one: test_guard_rules.py) ------------------------------------------------


def test_a_silent_imu_is_reported_within_its_timeout(hand_fed: HandFedCore) -> None:
    hand_fed.enter_approach()
    hand_fed.silent.add("imu")
    start = hand_fed.t_us
    hand_fed.run(0.3)
    latest_us = 1e6 * (hand_fed.core.mission.vehicle.guard.imu_timeout_s + BATCH_S)
    assert hand_fed.fired[0].t_us - start <= latest_us


def test_a_px4_failsafe_aborts_the_flight_and_a_pilot_releases_it(hand_fed: HandFedCore) -> None:
    hand_fed.enter_approach()
    hand_fed.feed(StatusText(hand_fed.t_us, hand_fed.t_us, "critical", "Failsafe activated"))
    out = hand_fed.set_status(flight_mode=FlightMode.LAND)
    end = of_kind(MissionEnd, out)[0]
    assert end.outcome == "aborted"
    other = core_in(Phase.APPROACH)
    other.set_status(flight_mode=FlightMode.HOLD)
    end = of_kind(MissionEnd, other.run(0.11))[0]  # long enough to exclude another vehicle's mode
    assert end.outcome == "released"


def test_mission_commands_are_ignored_after_the_guard_has_fired(hand_fed: HandFedCore) -> None:
    hand_fed.enter_approach()
    hand_fed.request(Request.LAND)
    out = hand_fed.run(4.0)
    assert {o.position_ned for o in of_kind(Setpoint, out)} == {of_kind(Setpoint, out)[0].position_ned}
    assert next(o.action for o in of_kind(VehicleCommand, out)) is VehicleAction.LAND
    hand_fed.set_status(flight_mode=FlightMode.LAND, landed=LandedState.ON_GROUND)
    hand_fed.run(0.1)
    # One report may come from another vehicle.
    assert not of_kind(MissionEnd, hand_fed.set_status(armed=False))
    end = of_kind(MissionEnd, hand_fed.run(0.21))[0]
    assert (end.outcome, end.reason) == ("aborted", "operator: landing requested")


def test_the_touchdown_of_a_guards_landing_is_no_impact(hand_fed: HandFedCore) -> None:
    hand_fed.enter_approach()
    hand_fed.request(Request.LAND)  # breaks off first, then lands
    hand_fed.run(0.5)
    assert of_kind(ImpactOnset, hand_fed.pulse((-10.0, -16.0)))  # still in the air: a wall behind it counts
    hand_fed.run(4.0)
    assert VehicleAction.LAND in {o.action for o in of_kind(VehicleCommand, hand_fed.outputs)}
    hand_fed.set_status(flight_mode=FlightMode.LAND)
    assert not of_kind(ImpactOnset, hand_fed.pulse((-10.0, -16.0)) + hand_fed.run(0.5))


def test_no_impact_is_reported_once_a_rule_lands(hand_fed: HandFedCore) -> None:
    hand_fed.enter_approach()
    hand_fed.silent.add("imu")
    assert [g.action for g in of_kind(GuardEvent, hand_fed.run(0.3))] == ["land"]
    hand_fed.silent.clear()
    assert not of_kind(ImpactOnset, hand_fed.pulse((-10.0, -16.0)) + hand_fed.run(0.5))


def test_only_a_stronger_action_replaces_the_active_one(hand_fed: HandFedCore) -> None:
    hand_fed.enter_approach()
    hand_fed.request(Request.LAND)
    hand_fed.silent.add("imu")
    hand_fed.run(0.3)
    hand_fed.request(Request.LAND)
    events = of_kind(GuardEvent, hand_fed.outputs)
    assert [g.action for g in events] == ["break_off", "land"]
    (overruled,) = (p for p in of_kind(PhaseChange, hand_fed.outputs) if p.after is Phase.OVERRULED)
    assert overruled.reason == "operator: landing requested"


def test_an_exception_in_the_mission_code_leads_to_a_landing(hand_fed: HandFedCore) -> None:
    hand_fed.enter_approach()
    hand_fed.break_mission()
    out = hand_fed.run(0.1)
    events = of_kind(GuardEvent, out)
    assert [(e.rule, e.action) for e in events] == [("mission_fault", "land")]
    assert "ZeroDivisionError" in events[0].detail
    assert "in raises" in events[0].detail  # where it was raised
    assert events[0].detail.count("File ") == 2  # and the caller
    assert of_kind(VehicleCommand, out)[0].action is VehicleAction.LAND


@pytest.mark.parametrize(
    ("parts", "commands"),
    [(("_evaluate", "record_override"), [VehicleAction.LAND]), (("_evaluate", "_fly"), [])],
)
def test_no_exception_leaves_the_core_if_the_landing_after_a_fault_fails_too(
    parts: tuple[str, ...], commands: list[VehicleAction]
) -> None:
    """Without setpoints, PX4's failsafe lands the vehicle."""
    c = core_in(Phase.APPROACH)
    c.break_guard(*parts)
    out = c.run(0.1)
    assert [o.action for o in of_kind(VehicleCommand, out)] == commands
    assert not of_kind(Setpoint, out)


def report_unknown_findings(c: HandFedCore) -> None:
    c.report_findings(["no_such_rule"] * 1000)


@pytest.mark.parametrize(
    ("sabotage", "error"),
    [
        (lambda c: c.break_guard("observe"), "ZeroDivisionError: guard"),
        (lambda c: c.break_guard("_evaluate"), "ZeroDivisionError: guard"),
        (report_unknown_findings, "KeyError: 'no_such_rule'"),
    ],
    ids=["observation", "evaluation", "finding without a rule"],
)
def test_a_guard_that_fails_in_every_step_lands(
    hand_fed: HandFedCore, sabotage: Callable[[HandFedCore], None], error: str
) -> None:
    """Records are kept, and commands that were not reviewed are withheld."""
    hand_fed.enter_prepare()
    before = len(hand_fed.outputs)
    sabotage(hand_fed)
    hand_fed.set_lock(Mode.FLEXIBLE)
    hand_fed.run(0.02)
    out = hand_fed.outputs[before:]
    assert [o.after for o in of_kind(PhaseChange, out)] == [Phase.APPROACH, Phase.OVERRULED]
    (event,) = of_kind(GuardEvent, out)
    assert (event.rule, event.action) == ("mission_fault", "land")
    assert error in event.detail
    assert not of_kind(Setpoint, out) + of_kind(LockCommand, out)
    assert [o.action for o in of_kind(VehicleCommand, out)] == [VehicleAction.LAND]
    assert not of_kind(GuardEvent, hand_fed.run(2.0))
    hand_fed.set_status(flight_mode=FlightMode.LAND, landed=LandedState.ON_GROUND, armed=False)
    (end,) = of_kind(MissionEnd, hand_fed.run(2.0))
    assert (end.outcome, end.reason) == ("aborted", f"mission_fault: {event.detail}")


def test_an_exception_in_the_guard_at_the_end_of_the_mission_aborts_the_flight() -> None:
    """The vehicle has landed, so the guard commands nothing."""
    c = HandFedCore(SINGLE)
    c.leave_single_wall()
    c.position_ned = (0.4, -1.0, -1.0)  # at the goal
    c.run(10.5)
    assert c.core.phase is Phase.LANDING
    c.set_status(flight_mode=FlightMode.LAND, landed=LandedState.ON_GROUND, armed=False)
    review = c.guard.review

    def fails_at_the_end(*step: Any) -> list[Output]:
        if c.core.phase is Phase.DONE:
            raise ZeroDivisionError("guard")
        return review(*step)

    c.guard.review = fails_at_the_end  # type: ignore[method-assign, assignment]
    c.run(0.3)
    assert (c.core.phase, c.core.end) == (Phase.DONE, None)
    c.guard.review = review  # type: ignore[method-assign]
    out = c.run(0.5)
    (end,) = of_kind(MissionEnd, out)
    assert end.outcome == "aborted"
    assert end.reason is not None
    assert end.reason.startswith("mission_fault: ")
    assert "ZeroDivisionError: guard" in end.reason
    assert c.core.end is end
    assert not of_kind(PhaseChange, out) + of_kind(Setpoint, out) + of_kind(VehicleCommand, out)


@pytest.mark.parametrize("shift_us", [0, -1_000_000])
def test_samples_whose_stamps_do_not_advance_are_ignored(hand_fed: HandFedCore, shift_us: int) -> None:
    hand_fed.enter_approach()
    estimates = of_kind(ForceEstimate, hand_fed.outputs)
    t_us = hand_fed.t_us
    hand_fed.t_us += shift_us - 4000
    hand_fed.run(0.004)
    assert of_kind(ForceEstimate, hand_fed.outputs) == estimates
    hand_fed.t_us = t_us


# --- the table and the law --------------------------------------------------------------------------------


def test_every_phase_is_reachable_and_can_be_left() -> None:
    reached = set(TRANSITIONS.values()) | {Phase.READYING}
    assert reached == set(Phase)
    for phase in Phase:
        outs = [event for (before, event) in TRANSITIONS if before is phase]
        assert bool(outs) == (phase is not Phase.DONE)
        if phase not in (Phase.DONE,):
            assert PhaseTrigger.OVERRULE in outs
        if phase in ON_GROUND:
            assert PhaseTrigger.GIVEN_UP in outs


unit = st.floats(0.0, 2.0 * math.pi).map(lambda a: (math.cos(a), math.sin(a)))


@given(unit, st.floats(0.1, 300.0), st.floats(-100.0, 100.0), st.floats(0.001, 0.2), st.floats(0.0, 0.2))
def test_the_recovery_setpoint_is_always_away_from_the_wall(
    normal: tuple[float, float], fn: float, ft: float, an: float, at: float
) -> None:
    x, y = recovery_point((1.0, 2.0), normal, (fn, ft), (an, at))
    away = (x - 1.0) * normal[0] + (y - 2.0) * normal[1]
    along = (x - 1.0) * normal[1] - (y - 2.0) * normal[0]
    assert away == pytest.approx(an * fn, rel=1e-9)
    assert away > 0.0
    assert along == pytest.approx(-at * ft, rel=1e-9, abs=1e-12)  # onward: against the friction force


# --- why PX4 refuses ---------------------------------------------------------------------------------------


def end_reason(outputs: list[Output]) -> str:
    (end,) = of_kind(MissionEnd, outputs)
    return str(end.reason)


def test_a_refusal_includes_the_reports_of_px4(hasty_core: HandFedCore) -> None:
    hasty_core.set_lock(Mode.RIGID)
    hasty_core.run(2.0)
    t_us = hasty_core.t_us
    hasty_core.feed(
        HealthReport(t_us, t_us, False, ("Heading estimate invalid",), ("No manual control input",))
    )
    hasty_core.feed(StatusText(t_us, t_us, "critical", "Arming denied: Resolve system health failures first"))
    hasty_core.feed(StatusText(t_us, t_us, "info", "logging: opened log file"))
    assert end_reason(hasty_core.run(10.0)) == (
        "offboard_refused: PX4 refused offboard mode; PX4 reports: Heading estimate invalid, "
        "Arming denied: Resolve system health failures first; also No manual control input"
    )


@pytest.mark.parametrize(
    "item",
    [
        ActuatorSample(1, 5, (HOVER,) * 4),
        EstimatorSample(1, 5, healthy=True),
        OdometrySample(1, 5, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        StatusSample(1, 5),
    ],
    ids=lambda i: type(i).__name__,
)
def test_every_px4_sample_updates_the_host_time(item: Input) -> None:
    senses = Senses(load_mission(ROOT / "missions" / "paper_dual_collision.yaml").vehicle)
    senses.update(item, ExpectedContact())
    assert senses.state.host_us == 5


def test_an_old_status_text_does_not_explain_a_refusal(hand_fed: HandFedCore) -> None:
    hand_fed.set_lock(Mode.RIGID)
    hand_fed.run(0.2)
    hand_fed.feed(StatusText(hand_fed.t_us, hand_fed.t_us, "warning", "compass swung"))
    assert end_reason(hand_fed.run(25.0)) == "offboard_refused: PX4 refused offboard mode"


def test_px4s_answer_is_reported_if_there_is_no_status_text(hasty_core: HandFedCore) -> None:
    hasty_core.set_lock(Mode.RIGID)
    hasty_core.run(1.0)
    hasty_core.feed(CommandResult(hasty_core.t_us, "offboard", False, "COMMAND_DENIED"))
    assert (
        end_reason(hasty_core.run(5.0))
        == "offboard_refused: PX4 refused offboard mode; PX4 answers: COMMAND_DENIED"
    )


def test_findings_for_other_modes_are_reported_if_there_is_no_other_reason(hasty_core: HandFedCore) -> None:
    hasty_core.set_lock(Mode.RIGID)
    hasty_core.feed(HealthReport(hasty_core.t_us, hasty_core.t_us, True, (), ("No offboard signal",)))
    assert end_reason(hasty_core.run(5.0)).endswith("; PX4 gives no reason, but reports: No offboard signal")


def test_an_uncertain_px4_position_prevents_a_flight_to_a_wall(hasty_core: HandFedCore) -> None:
    hasty_core.set_status(landed=LandedState.ON_GROUND)
    hasty_core.set_lock(Mode.RIGID)
    hasty_core.feed(EstimatorSample(hasty_core.t_us, hasty_core.t_us, healthy=True, position_sd_m=0.23))
    why = "not_ready: standard deviation of the position 0.23 m, limit 0.10 m"
    assert end_reason(hasty_core.run(5.0)) == why


def test_an_unready_lock_is_not_attributed_to_px4(hasty_core: HandFedCore) -> None:
    hasty_core.run(1.0)
    hasty_core.feed(HealthReport(hasty_core.t_us, hasty_core.t_us, False, ("Battery low",), ()))
    assert end_reason(hasty_core.run(5.0)) == "not_ready: the lock is not rigid"
