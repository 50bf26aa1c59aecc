"""The state machine with a modelled servo in simulated time: its rules, its faults, its properties."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.records import LockPhase, LockState, Mode
from dart_flight.config.vehicle import LimitSwitch, LockConfig, LockStartup
from dart_flight.lock.drivers.mock import MockDriver, MockFaults
from dart_flight.lock.servo import ServoFaults
from dart_flight.lock.state_machine import (
    NOT_PERMITTED,
    TRANSITIONS,
    CommandRefused,
    DriverReading,
    LockStateMachine,
    SetPulse,
    describe,
    status_text,
)

from .conftest import BOTH_SWITCHES
from .rigs import MockRig

Vary = Callable[..., LockConfig]
RIGID_SWITCH = LimitSwitch(chip="/dev/gpiochip0", rigid_line=23)


class Bench(MockRig):
    """The mock driver and its session, polled every 10 ms of simulated time."""

    POLL_US = 10_000

    def __init__(
        self, config: LockConfig, faults: MockFaults | None = None, pulse_us: float | None = None
    ) -> None:
        self._faults, self._pulse_us = faults, pulse_us
        super().__init__(config)

    def make_driver(self) -> MockDriver:
        self.mock = MockDriver(self.config, self.clock_us, faults=self._faults, pulse_us=self._pulse_us)
        return self.mock

    @property
    def state(self) -> LockState:
        return self.session.state


def homed(config: LockConfig, faults: MockFaults | None = None) -> Bench:
    """Return a bench that has homed to flexible, with locking permitted and `faults` injected."""
    bench = Bench(config)
    bench.session.start()
    assert bench.run(1.0).phase is LockPhase.SETTLED
    bench.session.permit(True)
    bench.mock.inject(faults or MockFaults())
    return bench


def locking(config: LockConfig) -> LockStateMachine:
    """Return a machine whose pulse for locking has just been sent, at time 0."""
    machine = LockStateMachine(config)
    machine.permit(0, True)
    machine.command(0, Mode.RIGID)
    machine.confirm_sent(0, config.servo.pulse_us(Mode.RIGID))
    return machine


def test_a_travel_without_switches_settles_after_the_catalogues_time(vary: Vary) -> None:
    bench = homed(vary())
    started_us = bench.t_us
    assert bench.session.command(Mode.RIGID) is None
    assert (bench.state.phase, bench.state.mode) == (LockPhase.TRAVELLING, Mode.RIGID)
    assert bench.state.commanded_us == started_us
    state = bench.run(1.0)
    assert (state.phase, state.mode, state.feedback) == (LockPhase.SETTLED, Mode.RIGID, False)
    assert state.settled_us is not None
    # The catalogue's 0.285 s and a margin of 0.03 s, at the next poll.
    assert 0.315e6 <= state.settled_us - started_us <= 0.325e6
    assert bench.horn() is Mode.RIGID
    assert describe(state) == "rigid: settled (no feedback)"
    assert status_text(state) == "lock rigid: settled (no feedback)"


def test_a_switch_confirms_the_arrival_without_the_margin(vary: Vary) -> None:
    bench = homed(vary(limit_switch=BOTH_SWITCHES))
    started_us = bench.t_us
    state = bench.travel(Mode.RIGID, 1.0)
    assert (state.phase, state.mode, state.feedback) == (LockPhase.SETTLED, Mode.RIGID, True)
    assert state.settled_us is not None
    assert 0.28e6 <= state.settled_us - started_us <= 0.33e6
    assert bench.horn() is Mode.RIGID


def test_an_end_without_a_switch_has_no_feedback(vary: Vary) -> None:
    bench = homed(vary(limit_switch=RIGID_SWITCH))
    assert not bench.state.feedback
    assert bench.travel(Mode.RIGID, 1.0).feedback
    state = bench.travel(Mode.FLEXIBLE, 1.0)
    assert (state.phase, state.mode, state.feedback) == (LockPhase.SETTLED, Mode.FLEXIBLE, False)


# --- refusals ----------------------------------------------------------------------------------------


def test_locking_is_refused_until_permitted(vary: Vary) -> None:
    bench = Bench(vary())
    bench.session.start()
    bench.run(1.0)
    assert bench.session.command(Mode.RIGID) == CommandRefused("rigid", NOT_PERMITTED)
    assert bench.state.phase is LockPhase.SETTLED
    assert bench.state.mode is Mode.FLEXIBLE
    assert bench.state.reason == f"refused rigid: {NOT_PERMITTED}"
    bench.run(1.0)
    assert bench.horn() is Mode.FLEXIBLE
    bench.session.permit(True)
    assert bench.session.command(Mode.RIGID) is None
    assert bench.state.reason is None


def test_unlocking_needs_no_permission(vary: Vary) -> None:
    bench = homed(vary())
    bench.travel(Mode.RIGID, 1.0)
    bench.session.permit(False)
    assert bench.session.command(Mode.FLEXIBLE) is None
    assert bench.run(1.0).mode is Mode.FLEXIBLE


def test_a_reversal_is_refused_during_a_travel_and_a_repetition_is_ignored(vary: Vary) -> None:
    bench = homed(vary())
    bench.travel(Mode.RIGID, 0.1)
    travelling = bench.state
    assert bench.session.command(Mode.RIGID) is None
    assert bench.state is travelling
    refused = bench.session.command(Mode.FLEXIBLE)
    assert refused == CommandRefused("flexible", "travelling to rigid")
    assert bench.session.release() == CommandRefused("release", "travelling to rigid")
    assert bench.run(0.5).mode is Mode.RIGID


def test_a_contact_during_locking_retracts_the_rods(vary: Vary) -> None:
    bench = homed(vary())
    bench.travel(Mode.RIGID, 0.15)
    bench.session.permit(False)
    assert (bench.state.phase, bench.state.mode) == (LockPhase.TRAVELLING, Mode.FLEXIBLE)
    assert bench.state.reason == "contact while locking"
    state = bench.run(0.5)
    assert (state.phase, state.mode) == (LockPhase.SETTLED, Mode.FLEXIBLE)
    assert bench.horn() is Mode.FLEXIBLE


def test_a_contact_does_not_affect_locked_or_unlocking_arms(vary: Vary) -> None:
    bench = homed(vary())
    bench.travel(Mode.RIGID, 0.5)
    settled = bench.state
    bench.session.permit(False)
    assert bench.state is settled
    bench.session.command(Mode.FLEXIBLE)
    travelling = bench.state
    bench.session.permit(True)
    bench.session.permit(False)
    assert bench.state is travelling


# --- faults ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("faults", "reason"),
    [
        (MockFaults(servo=ServoFaults(stuck=True)), "the flexible limit switch did not open within 1.5 s"),
        (
            MockFaults(servo=ServoFaults(stall_fraction=0.4)),
            "the rigid limit switch did not close within 1.5 s",
        ),
        (MockFaults(servo=ServoFaults(slow=6.0)), "the rigid limit switch did not close within 1.5 s"),
        (MockFaults(switch_silent=True), "the rigid limit switch did not close within 1.5 s"),
        (MockFaults(brown_out=True), "the controller lost the pulse; the controller restarted"),
        (MockFaults(unplugged=True), "the controller does not answer (unplugged)"),
    ],
)
def test_every_fault_is_detected_with_switches(vary: Vary, faults: MockFaults, reason: str) -> None:
    bench = homed(vary(limit_switch=BOTH_SWITCHES), faults)
    state = bench.travel(Mode.RIGID, 2.0)
    assert (state.phase, state.mode, state.feedback) == (LockPhase.FAULT, None, False)
    assert state.reason == reason
    assert not any(s.phase is LockPhase.SETTLED and s.mode is Mode.RIGID for s in bench.states)


@pytest.mark.parametrize(
    ("faults", "settles"),
    [
        (MockFaults(servo=ServoFaults(stuck=True)), True),
        (MockFaults(servo=ServoFaults(stall_fraction=0.4)), True),
        (MockFaults(servo=ServoFaults(slow=6.0)), True),
        (MockFaults(brown_out=True), False),
        (MockFaults(unplugged=True), False),
    ],
)
def test_without_switches_only_a_fault_of_the_controller_is_detected(
    vary: Vary, faults: MockFaults, settles: bool
) -> None:
    bench = homed(vary(), faults)
    state = bench.travel(Mode.RIGID, 0.4)
    assert (bench.fault is None) is settles
    if settles:  # without feedback
        assert (state.phase, state.mode, state.feedback) == (LockPhase.SETTLED, Mode.RIGID, False)
        assert bench.horn() is not Mode.RIGID


def test_the_mock_reports_its_restart_until_the_next_command(vary: Vary) -> None:
    bench = homed(vary(), MockFaults(brown_out=True))
    bench.travel(Mode.RIGID, 0.4)
    assert bench.mock.read().errors == ("the controller restarted",)
    bench.mock.inject(MockFaults())
    bench.session.command(Mode.RIGID)
    assert bench.mock.read().errors == ()
    assert bench.run(1.0).phase is LockPhase.SETTLED


def test_a_command_clears_a_fault(vary: Vary) -> None:
    bench = homed(vary(limit_switch=BOTH_SWITCHES), MockFaults(servo=ServoFaults(stuck=True)))
    assert bench.travel(Mode.RIGID, 2.0).phase is LockPhase.FAULT
    bench.mock.inject(MockFaults())
    state = bench.travel(Mode.FLEXIBLE, 0.5)
    assert (state.phase, state.mode, state.feedback) == (LockPhase.SETTLED, Mode.FLEXIBLE, True)


def test_a_slow_servo_with_a_switch_settles_late(vary: Vary) -> None:
    bench = homed(vary(limit_switch=BOTH_SWITCHES), MockFaults(servo=ServoFaults(slow=3.0)))
    started_us = bench.t_us
    assert bench.travel(Mode.RIGID, 0.8).phase is LockPhase.TRAVELLING
    state = bench.run(0.5)
    assert state.phase is LockPhase.SETTLED
    assert state.settled_us is not None
    assert 0.84e6 < state.settled_us - started_us < 0.9e6


def test_a_switch_that_opens_at_rest_is_a_fault(vary: Vary) -> None:
    bench = homed(vary(limit_switch=BOTH_SWITCHES))
    bench.travel(Mode.RIGID, 0.5)
    bench.mock.inject(MockFaults(switch_silent=True))
    bench.run(0.02)
    assert bench.state.phase is LockPhase.SETTLED  # a bounce is no fault
    bench.run(0.03)
    assert bench.fault == "the rigid limit switch has opened"


def test_a_bouncing_switch_neither_confirms_nor_causes_a_fault(vary: Vary) -> None:
    machine = locking(vary(limit_switch=BOTH_SWITCHES))
    for t_us in range(10_000, 1_000_000, 10_000):
        closed = (t_us // 10_000) % 2 == 0
        machine.reading(t_us, DriverReading(1980.0, rigid_switch=closed, flexible_switch=False))
        assert machine.state.phase is LockPhase.TRAVELLING


def test_a_clamped_pulse_is_a_fault(vary: Vary) -> None:
    machine = locking(vary())
    machine.reading(400_000, DriverReading(1900.0, errors=("protocol error",)))
    assert machine.state.phase is LockPhase.TRAVELLING
    machine.step(1_500_000)
    assert (machine.state.phase, machine.state.reason) == (
        LockPhase.FAULT,
        "the controller outputs 1900 us instead of 1980 us; protocol error",
    )


@pytest.mark.parametrize(
    ("sent_us", "reading_us", "reason"),
    [
        (None, 400_000, "the driver did not accept the command within 1.5 s"),
        (10_000, None, "the driver reported nothing within 1.5 s"),
        (10_000, 200_000, "after the travel time, no reading arrived within 1.5 s of the command"),
    ],
)
def test_a_command_without_a_timely_reading_is_a_fault(
    vary: Vary, sent_us: int | None, reading_us: int | None, reason: str
) -> None:
    machine = LockStateMachine(vary())
    machine.command(0, Mode.FLEXIBLE)
    if sent_us is not None:
        machine.confirm_sent(sent_us, 1020.0)
    if reading_us is not None:
        machine.reading(reading_us, DriverReading(1020.0))
    for t_us in range(400_000, 1_490_000, 10_000):
        machine.step(t_us)
        assert machine.state.phase is LockPhase.TRAVELLING
    machine.step(1_500_000)
    assert (machine.state.phase, machine.state.reason) == (LockPhase.FAULT, reason)


def test_the_travel_time_starts_when_the_driver_first_accepts_the_travels_pulse(vary: Vary) -> None:
    machine = LockStateMachine(vary())
    machine.confirm_sent(0, 1020.0)  # before any travel
    machine.command(0, Mode.FLEXIBLE)
    assert machine.due_us is None
    machine.confirm_sent(5_000, 1980.0)  # another pulse
    assert machine.due_us is None
    for t_us in (10_000, 200_000):
        machine.confirm_sent(t_us, 1020.0)
        assert machine.due_us == 10_000 + 315_000
    phases = []
    for t_us in (320_000, 330_000):
        machine.reading(t_us, DriverReading(1020.0))
        phases.append(machine.state.phase)
    assert phases == [LockPhase.TRAVELLING, LockPhase.SETTLED]
    assert machine.due_us is None


def test_both_states_of_a_slow_reading_are_reported(vary: Vary, monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver confirms the arrival, but so late that the state is no longer valid."""
    quick = homed(vary(limit_switch=BOTH_SWITCHES))
    quick.session.command(Mode.RIGID)
    started_us = quick.t_us
    settled_us = quick.run(1.0).settled_us
    assert settled_us is not None
    bench = homed(vary(limit_switch=BOTH_SWITCHES))
    bench.session.command(Mode.RIGID)
    bench.run((settled_us - started_us) * 1e-6 - 0.01)
    read = bench.mock.read

    def slow() -> DriverReading:
        reading = read()
        bench.t_us += 2_000_000
        return reading

    monkeypatch.setattr(bench.mock, "read", slow)
    bench.states.clear()
    bench.run(0.01)
    assert [state.phase for state in bench.states] == [LockPhase.SETTLED, LockPhase.FAULT]


def test_a_reading_from_before_the_command_is_ignored(vary: Vary) -> None:
    machine = LockStateMachine(vary())
    machine.command(0, Mode.FLEXIBLE)
    machine.confirm_sent(15_000, 1020.0)
    machine.reading(0, DriverReading(None))  # measured before the command, delivered after it
    phases = []
    for t_us in (20_000, 40_000):
        machine.reading(t_us, DriverReading(None))
        phases.append(machine.state.phase)
    assert phases == [LockPhase.TRAVELLING, LockPhase.FAULT]


def test_a_confirmed_state_needs_readings_to_stay_confirmed(vary: Vary) -> None:
    bench = homed(vary(limit_switch=BOTH_SWITCHES))
    machine = bench.session.machine
    machine.step(bench.t_us + 1_400_000)
    assert machine.state.phase is LockPhase.SETTLED
    machine.step(bench.t_us + 1_600_000)
    assert (machine.state.phase, machine.state.reason) == (
        LockPhase.FAULT,
        "the driver gave no reading for 1.6 s",
    )


def test_a_state_without_a_switch_needs_no_further_readings(vary: Vary) -> None:
    bench = homed(vary())
    bench.session.machine.step(bench.t_us + 60_000_000)
    assert bench.state.phase is LockPhase.SETTLED


def test_a_fault_does_not_shorten_the_next_travels_debounce_time(vary: Vary) -> None:
    """The debounce time starts again with the new travel."""
    machine = LockStateMachine(vary())
    machine.command(0, Mode.FLEXIBLE)
    for t_us in (0, 20_000, 40_000):
        machine.confirm_sent(0, 1020.0)
        machine.reading(t_us, DriverReading(None))
    assert machine.state.phase is LockPhase.FAULT
    machine.command(100_000, Mode.FLEXIBLE)
    machine.confirm_sent(100_000, 1020.0)
    machine.reading(110_000, DriverReading(None))  # the controller needs a moment
    phases = []
    for t_us in (120_000, 420_000):
        machine.reading(t_us, DriverReading(1020.0))
        phases.append(machine.state.phase)
    assert phases == [LockPhase.TRAVELLING, LockPhase.SETTLED]


def test_a_switch_must_confirm_every_travel_for_the_debounce_time(vary: Vary) -> None:
    """This holds even if the horn is already there, as after the pulses were off."""
    bench = homed(vary(limit_switch=BOTH_SWITCHES))
    bench.session.release()
    bench.run(0.5)
    assert bench.travel(Mode.FLEXIBLE, 0.01).phase is LockPhase.TRAVELLING
    state = bench.run(0.05)
    assert (state.phase, state.feedback) == (LockPhase.SETTLED, True)


# --- pulses off, start-up ----------------------------------------------------------------------------


def test_release_keeps_the_state_and_the_next_command_travels_again(vary: Vary) -> None:
    bench = homed(vary())
    assert bench.session.release() is None
    state = bench.run(0.5)
    assert (state.phase, state.reason) == (LockPhase.SETTLED, "pulses off")
    assert bench.mock.read().pulse_us is None
    bench.session.command(Mode.FLEXIBLE)
    assert bench.state.phase is LockPhase.TRAVELLING
    assert bench.run(0.5).phase is LockPhase.SETTLED
    assert bench.mock.read().pulse_us == 1020.0


def test_the_pulse_is_monitored_again_after_a_release_and_a_command(vary: Vary) -> None:
    bench = homed(vary())
    bench.session.release()
    bench.session.command(Mode.FLEXIBLE)
    settled = bench.run(0.5)
    assert settled.phase is LockPhase.SETTLED
    assert bench.session.command(Mode.FLEXIBLE) is None
    assert bench.state is settled  # already at the end, so no new travel begins
    bench.mock.release()  # without the session's knowledge
    bench.run(0.1)
    assert bench.fault == "the controller lost the pulse"


def test_the_mock_loses_its_pulse_during_the_travel_unless_it_was_released(vary: Vary) -> None:
    bench = homed(vary(), MockFaults(brown_out=True))
    bench.session.command(Mode.RIGID)
    started_us = bench.t_us
    far_us = bench.mock.horn_pulse_us(started_us + 10_000_000)  # not read in between
    assert far_us == pytest.approx(1020.0 + 960.0 * 0.06 / 0.285)
    other = homed(vary(), MockFaults(brown_out=True))
    other.mock.set_pulse(1980.0)
    other.t_us += 10_000
    other.mock.release()
    other.t_us += 1_000_000
    assert other.mock.read().errors == ()


def test_homing_moves_the_lock_to_the_home_mode(vary: Vary) -> None:
    bench = Bench(vary(), pulse_us=1700.0)
    assert bench.session.start() is None
    assert bench.run(1.0).mode is Mode.FLEXIBLE
    assert bench.horn() is Mode.FLEXIBLE


def test_homing_to_rigid_needs_permission(vary: Vary) -> None:
    bench = Bench(vary(home_mode=Mode.RIGID))
    assert bench.session.start() == CommandRefused("rigid", NOT_PERMITTED)
    assert bench.state.phase is LockPhase.UNKNOWN


@pytest.mark.parametrize(
    ("reading", "mode", "feedback", "reason"),
    [
        (None, None, False, "no position found: the driver gave no reading"),
        (DriverReading(None), None, False, "the servo's position is unknown: its pulses are off"),
        (
            DriverReading(1500.0),
            None,
            False,
            "no position found: the pulse of 1500 us belongs to neither end",
        ),
        (DriverReading(1980.0), Mode.RIGID, False, None),
        (DriverReading(None, rigid_switch=True), Mode.RIGID, True, None),
        (DriverReading(1020.0, flexible_switch=True), Mode.FLEXIBLE, True, None),
        (
            DriverReading(1020.0, rigid_switch=True),
            None,
            False,
            "no position found: pulse and rigid limit switch contradict each other",
        ),
        (
            DriverReading(None, rigid_switch=True, flexible_switch=True),
            None,
            False,
            "no position found: both limit switches are closed",
        ),
    ],
)
def test_adoption_requires_a_consistent_reading(
    vary: Vary, reading: DriverReading | None, mode: Mode | None, feedback: bool, reason: str | None
) -> None:
    machine = LockStateMachine(vary(startup=LockStartup.ADOPT))
    assert machine.start(0, reading) == []
    if mode is None or reading is None:
        assert (machine.state.phase, machine.state.mode) == (LockPhase.UNKNOWN, None)
        assert machine.state.reason == reason
        return
    # The last process may have died during the travel, so the machine waits for its end.
    assert machine.state.phase is LockPhase.TRAVELLING
    for t_us in range(10_000, 400_000, 10_000):
        machine.reading(t_us, reading)
    assert (machine.state.phase, machine.state.mode) == (LockPhase.SETTLED, mode)
    assert machine.state.feedback is feedback


def test_a_contact_does_not_retract_adopted_rigid_rods(vary: Vary) -> None:
    machine = LockStateMachine(vary(startup=LockStartup.ADOPT))
    machine.start(0, DriverReading(1980.0))
    assert machine.permit(10_000, False) == []
    assert machine.state.mode is Mode.RIGID


def test_a_driver_that_cannot_be_opened_is_a_fault(vary: Vary) -> None:
    bench = Bench(vary(), MockFaults(unplugged=True))
    bench.session.start()
    assert bench.fault == "the controller does not answer (unplugged)"


# --- transition table, properties ---------------------------------------------------------------------


def test_every_phase_is_reached_and_left() -> None:
    assert set(TRANSITIONS) == set(LockPhase)
    reached = {after for row in TRANSITIONS.values() for after in row.values()}
    assert reached == set(LockPhase) - {LockPhase.UNKNOWN}
    assert all(TRANSITIONS.values())


def test_the_status_text_fits_into_50_ascii_bytes(vary: Vary) -> None:
    bench = homed(vary(limit_switch=BOTH_SWITCHES), MockFaults(servo=ServoFaults(stuck=True)))
    bench.session.command(Mode.RIGID)
    text = status_text(bench.run(2.0))
    assert text == "lock fault; the flexible limit switch did not open"
    assert len(text.encode()) == 50


faults = st.builds(
    MockFaults,
    servo=st.builds(
        ServoFaults,
        stuck=st.booleans(),
        slow=st.sampled_from([1.0, 1.0, 2.5, 9.0]),
        stall_fraction=st.none() | st.floats(0.0, 1.0),
    ),
    unplugged=st.booleans(),
    brown_out=st.booleans(),
    switch_silent=st.booleans(),
)
script_steps = st.one_of(
    st.tuples(st.just("command"), st.sampled_from(Mode)),
    st.tuples(st.just("permit"), st.booleans()),
    st.tuples(st.just("inject"), faults),
    st.tuples(st.just("release"), st.none()),
    st.tuples(st.just("run"), st.floats(0.0, 0.7)),
)


@given(
    script=st.lists(script_steps, max_size=25),
    switches=st.sampled_from([None, BOTH_SWITCHES, RIGID_SWITCH]),
    adopt=st.booleans(),
    horn_us=st.floats(1020.0, 1980.0),
)
def test_the_reported_state_is_true_after_any_script(
    *,
    lock_config: LockConfig,
    vary: Vary,
    script: list[tuple[str, object]],
    switches: LimitSwitch | None,
    adopt: bool,
    horn_us: float,
) -> None:
    startup = LockStartup.ADOPT if adopt else LockStartup.HOME
    bench = Bench(vary(limit_switch=switches, startup=startup), pulse_us=horn_us)
    bench.session.start()
    permitted = False
    for action, value in script:
        before = bench.state
        if action == "command":
            assert isinstance(value, Mode)
            refused = bench.session.command(value)
            if value is Mode.RIGID and not permitted and refused is None:
                assert bench.state is before  # no new travel has begun
        elif action == "permit":
            permitted = bool(value)
            bench.session.permit(permitted)
        elif action == "inject":
            assert isinstance(value, MockFaults)
            bench.mock.inject(value)
        elif action == "release":
            bench.session.release()
        else:
            assert isinstance(value, float)
            for _ in range(round(value * 100)):
                bench.run(0.01)
                state = bench.state
                assert (state.phase is LockPhase.SETTLED) == (state.settled_us is not None)
                assert (state.mode is None) == (state.phase in (LockPhase.UNKNOWN, LockPhase.FAULT))
                assert state.feedback <= (state.phase is LockPhase.SETTLED)
                if state.phase is LockPhase.SETTLED and state.feedback:
                    assert bench.horn() is state.mode
                if state.phase is LockPhase.TRAVELLING:
                    assert state.t_us >= bench.t_us - round(lock_config.timeout_s * 1e6)


@given(
    events=st.lists(st.tuples(st.sampled_from(["rigid", "flexible", "on", "off"]), st.integers(0, 400_000)))
)
def test_a_rigid_pulse_is_never_sent_without_permission(
    lock_config: LockConfig, events: list[tuple[str, int]]
) -> None:
    machine = LockStateMachine(lock_config)
    t_us, permitted, pulse = 0, False, 1020.0
    for event, elapsed in events:
        t_us += elapsed
        machine.reading(t_us, DriverReading(pulse))
        if event in ("on", "off"):
            permitted = event == "on"
            actions = machine.permit(t_us, permitted)
        else:
            actions = machine.command(t_us, Mode(event))
        for action in actions:
            if isinstance(action, SetPulse):
                assert permitted or action.mode is Mode.FLEXIBLE
                pulse = action.pulse_us
                machine.confirm_sent(t_us, pulse)
        if not permitted and machine.state.phase is LockPhase.TRAVELLING:
            assert machine.state.mode is Mode.FLEXIBLE
