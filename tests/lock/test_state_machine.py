"""The state machine with a modelled servo in simulated time: its rules and its faults."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from dart_flight.base.records import LockPhase, Mode
from dart_flight.config.vehicle import LockConfig, LockStartup
from dart_flight.lock.drivers.mock import MockFaults
from dart_flight.lock.servo import ServoFaults
from dart_flight.lock.state_machine import (
    NOT_PERMITTED,
    TRANSITIONS,
    CommandRefused,
    DriverReading,
    LockStateMachine,
    describe,
    status_text,
)

from .conftest import BOTH_SWITCHES, RIGID_SWITCH
from .rigs import MockRig, Vary


class Bench(MockRig):
    """The mock driver and its session, polled every 10 ms of simulated time."""

    POLL_US = 10_000


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


def test_a_switch_confirms_the_arrival_without_the_margin(vary: Vary) -> None:
    bench = homed(vary(limit_switch=BOTH_SWITCHES))
    started_us = bench.t_us
    state = bench.travel(Mode.RIGID, 1.0)
    assert (state.phase, state.mode, state.feedback) == (LockPhase.SETTLED, Mode.RIGID, True)
    assert state.settled_us is not None
    assert 0.28e6 <= state.settled_us - started_us <= 0.33e6
    assert bench.horn() is Mode.RIGID


# --- scripts -----------------------------------------------------------------------------------------

ACTIONS: dict[str, Callable[[Bench], object]] = {
    "lock": lambda bench: bench.session.command(Mode.RIGID),
    "unlock": lambda bench: bench.session.command(Mode.FLEXIBLE),
    "permit": lambda bench: bench.session.permit(True),
    "contact": lambda bench: bench.session.permit(False),
    "release": lambda bench: bench.session.release(),
    "lose-pulse": lambda bench: bench.mock.release(),
    "silence": lambda bench: bench.mock.inject(MockFaults(switch_silent=True)),
    "repair": lambda bench: bench.mock.inject(MockFaults()),
    "wait": lambda bench: None,
}
LOCKED, UNLOCKED = "rigid: settled (no feedback)", "flexible: settled (no feedback)"
CONFIRMED, OPEN = "rigid: settled", "flexible: settled"  # by a switch
LOCKING, UNLOCKING = "travelling to rigid", "travelling to flexible"
REFUSED = f"{UNLOCKED}; refused rigid: {NOT_PERMITTED}"
NOT_CLOSED = "fault; the rigid limit switch did not close within 1.5 s"
NOT_OPEN = "fault; the flexible limit switch did not open within 1.5 s"
LOST, UNPLUGGED = "fault; the controller lost the pulse", "fault; the controller does not answer (unplugged)"
RESTARTED = f"{LOST}; the controller restarted"
FAULTS = {
    "healthy": MockFaults(),
    "slow": MockFaults(servo=ServoFaults(slow=6.0)),
    "stuck": MockFaults(servo=ServoFaults(stuck=True)),
    "stalled": MockFaults(servo=ServoFaults(stall_fraction=0.4)),
    "silent": MockFaults(switch_silent=True),
    "brown-out": MockFaults(brown_out=True),
    "unplugged": MockFaults(unplugged=True),
}
NONE, RIGID, BOTH = None, RIGID_SWITCH, BOTH_SWITCHES

# From a lock that has homed to flexible, with locking permitted: switches, fault, and pairs of an action with
# the seconds until the look at the state, and the description of the state.
# fmt: off
SCRIPTS: dict[str, tuple[Any, ...]] = {
    "an end without a switch has no feedback": (
        RIGID, "healthy", ("wait 0", UNLOCKED), ("lock 1", CONFIRMED), ("unlock 1", UNLOCKED)),
    "locking is refused until it is permitted": (
        NONE, "healthy", ("contact 0", UNLOCKED), ("lock 1", REFUSED), ("permit 0", REFUSED),
        ("lock 0.5", LOCKED)),
    "unlocking needs no permission": (
        NONE, "healthy", ("lock 1", LOCKED), ("contact 0", LOCKED), ("unlock 1", UNLOCKED)),
    "during a travel a repetition is ignored, a reversal and a release are refused": (
        NONE, "healthy", ("lock 0.1", LOCKING), ("lock 0", LOCKING),
        ("unlock 0", f"{LOCKING}; refused flexible: travelling to rigid"),
        ("release 0", f"{LOCKING}; refused release: travelling to rigid"), ("wait 0.5", LOCKED)),
    "a contact during locking retracts the rods": (
        NONE, "healthy", ("lock 0.15", LOCKING), ("contact 0", f"{UNLOCKING}; contact while locking"),
        ("wait 0.5", UNLOCKED)),
    "a contact affects neither locked nor unlocking arms": (
        NONE, "healthy", ("lock 0.5", LOCKED), ("contact 0", LOCKED), ("unlock 0", UNLOCKING),
        ("permit 0", UNLOCKING), ("contact 0", UNLOCKING)),
    "switches detect a stuck servo": (BOTH, "stuck", ("lock 2", NOT_OPEN)),
    "switches detect a stalled servo": (BOTH, "stalled", ("lock 2", NOT_CLOSED)),
    "switches detect a slow servo": (BOTH, "slow", ("lock 2", NOT_CLOSED)),
    "silent switches are detected": (BOTH, "silent", ("lock 2", NOT_CLOSED)),
    "a brown-out is detected": (BOTH, "brown-out", ("lock 2", RESTARTED)),
    "an unplugged controller is detected": (BOTH, "unplugged", ("lock 2", UNPLUGGED)),
    "a brown-out is detected without switches": (NONE, "brown-out", ("lock 0.4", RESTARTED)),
    "an unplugged controller is detected without switches": (NONE, "unplugged", ("lock 0.4", UNPLUGGED)),
    "a stuck servo is not detected without switches": (NONE, "stuck", ("lock 0.4", LOCKED)),
    "a stalled servo is not detected without switches": (NONE, "stalled", ("lock 0.4", LOCKED)),
    "a slow servo is not detected without switches": (NONE, "slow", ("lock 0.4", LOCKED)),
    "a command clears a fault": (
        BOTH, "stuck", ("lock 2", NOT_OPEN), ("repair 0", NOT_OPEN), ("unlock 0.5", OPEN)),
    "a switch that opens at rest is a fault, and a bounce is none": (
        BOTH, "healthy", ("lock 0.5", CONFIRMED), ("silence 0.02", CONFIRMED),
        ("wait 0.03", "fault; the rigid limit switch has opened")),
    "a switch confirms every travel for the debounce time, even at the end already": (
        BOTH, "healthy", ("release 0.5", f"{OPEN}; pulses off"), ("unlock 0.01", UNLOCKING),
        ("wait 0.05", OPEN)),
    "a release keeps the state, and the next command travels again": (
        NONE, "healthy", ("release 0.5", f"{UNLOCKED}; pulses off"), ("unlock 0", UNLOCKING),
        ("wait 0.5", UNLOCKED)),
    "the pulse is watched again after a release and a command": (
        NONE, "healthy", ("release 0", f"{UNLOCKED}; pulses off"), ("unlock 0.5", UNLOCKED),
        ("unlock 0", UNLOCKED), ("lose-pulse 0.1", LOST)),  # the second command begins no travel
}
# fmt: on


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_leads_through_the_expected_states(vary: Vary, name: str) -> None:
    switches, fault, *script = SCRIPTS[name]
    bench = homed(vary(limit_switch=switches), FAULTS[fault])
    for step, says in script:
        action, seconds = step.split()
        ACTIONS[action](bench)
        assert describe(bench.run(float(seconds))) == says, step
        assert (bench.output_us() is None) is ("pulses off" in says or "lost the pulse" in says), step
        # Only a faulty servo without switches is elsewhere than reported.
        if bench.state.phase is LockPhase.SETTLED:
            true = bench.horn() is bench.state.mode
            assert true is (FAULTS[fault].servo == ServoFaults() or bench.state.feedback), step
    locks = any(says in (LOCKED, CONFIRMED) for _, says in script)
    assert any(s.phase is LockPhase.SETTLED and s.mode is Mode.RIGID for s in bench.states) is locks


def test_a_refused_command_is_returned_with_its_reason(vary: Vary) -> None:
    bench = homed(vary())
    bench.session.permit(False)
    assert bench.session.command(Mode.RIGID) == CommandRefused("rigid", NOT_PERMITTED)
    assert bench.session.release() is None
    bench.session.permit(True)
    assert bench.session.command(Mode.RIGID) is None
    assert bench.session.command(Mode.FLEXIBLE) == CommandRefused("flexible", "travelling to rigid")
    assert bench.session.release() == CommandRefused("release", "travelling to rigid")


# --- faults ------------------------------------------------------------------------------------------


def test_the_mock_reports_its_restart_until_the_next_command(vary: Vary) -> None:
    bench = homed(vary(), MockFaults(brown_out=True))
    bench.travel(Mode.RIGID, 0.4)
    assert bench.mock.read().errors == ("the controller restarted",)
    bench.mock.inject(MockFaults())
    bench.session.command(Mode.RIGID)
    assert bench.mock.read().errors == ()
    assert bench.run(1.0).phase is LockPhase.SETTLED


def test_a_slow_servo_with_a_switch_settles_late(vary: Vary) -> None:
    bench = homed(vary(limit_switch=BOTH_SWITCHES), MockFaults(servo=ServoFaults(slow=3.0)))
    started_us = bench.t_us
    assert bench.travel(Mode.RIGID, 0.8).phase is LockPhase.TRAVELLING
    state = bench.run(0.5)
    assert state.phase is LockPhase.SETTLED
    assert state.settled_us is not None
    assert 0.84e6 < state.settled_us - started_us < 0.9e6


LOST_PULSE = DriverReading(None)
AT_FLEXIBLE, AT_RIGID = DriverReading(1020.0), DriverReading(1980.0)
CLAMPED = DriverReading(1900.0, errors=("protocol error",))
NOT_ACCEPTED = "fault; the driver did not accept the command within 1.5 s"
SILENT = "fault; the driver reported nothing within 1.5 s"
TOO_EARLY = "fault; no reading that confirms the travel arrived within 1.5 s of the command"
BAD_PULSE = "fault; the controller outputs 1900 us instead of 1980 us; protocol error"

# Inputs of the machine with their times, and the description of its state after them: a mode is a command, a
# number is a pulse that the driver has accepted, None is a step.
# fmt: off
TIMELINES: dict[str, tuple[tuple[int, Any, str], ...]] = {
    "a command that the driver does not accept is a fault": (
        (0, Mode.FLEXIBLE, UNLOCKING), (1490, None, UNLOCKING), (1500, None, NOT_ACCEPTED)),
    "a driver that reports nothing is a fault": (
        (0, Mode.FLEXIBLE, UNLOCKING), (10, 1020.0, UNLOCKING), (1490, None, UNLOCKING),
        (1500, None, SILENT)),
    "a reading before the end of the travel time does not suffice": (
        (0, Mode.FLEXIBLE, UNLOCKING), (10, 1020.0, UNLOCKING), (200, AT_FLEXIBLE, UNLOCKING),
        (1490, None, UNLOCKING), (1500, None, TOO_EARLY)),
    "a clamped pulse is a fault": (
        (0, Mode.RIGID, LOCKING), (0, 1980.0, LOCKING), (400, CLAMPED, LOCKING), (1500, None, BAD_PULSE)),
    "the travel time starts when the driver first accepts the travel's pulse": (
        (0, 1020.0, "unknown"), (0, Mode.FLEXIBLE, UNLOCKING), (5, 1980.0, UNLOCKING),
        (10, 1020.0, UNLOCKING), (200, 1020.0, UNLOCKING), (320, AT_FLEXIBLE, UNLOCKING),
        (330, AT_FLEXIBLE, UNLOCKED)),
    "a reading from before the command is ignored": (  # it was delivered after the command
        (0, Mode.FLEXIBLE, UNLOCKING), (15, 1020.0, UNLOCKING), (0, LOST_PULSE, UNLOCKING),
        (20, LOST_PULSE, UNLOCKING), (40, LOST_PULSE, LOST)),
    "a fault does not shorten the next travel's debounce time": (
        (0, Mode.FLEXIBLE, UNLOCKING), (0, 1020.0, UNLOCKING), (0, LOST_PULSE, UNLOCKING),
        (20, LOST_PULSE, LOST), (100, Mode.FLEXIBLE, UNLOCKING),
        (100, 1020.0, UNLOCKING), (110, LOST_PULSE, UNLOCKING), (120, AT_FLEXIBLE, UNLOCKING),
        (420, AT_FLEXIBLE, UNLOCKED)),
}
# fmt: on


@pytest.mark.parametrize("name", TIMELINES)
def test_a_timeline_leads_through_the_expected_states(vary: Vary, name: str) -> None:
    machine = LockStateMachine(vary())
    machine.permit(0, True)
    for t_ms, given, says in TIMELINES[name]:
        t_us = 1000 * t_ms
        if isinstance(given, Mode):
            machine.command(t_us, given)
        elif isinstance(given, DriverReading):
            machine.reading(t_us, given)
        elif given is None:
            machine.step(t_us)
        else:
            machine.confirm_sent(t_us, given)
        assert describe(machine.state) == says, (t_ms, given)


def test_a_travel_is_due_its_time_after_the_accepted_pulse(vary: Vary) -> None:
    machine = LockStateMachine(vary())
    machine.command(0, Mode.FLEXIBLE)
    assert machine.due_us is None
    machine.confirm_sent(10_000, 1020.0)
    assert machine.due_us == 10_000 + 315_000
    machine.reading(330_000, AT_FLEXIBLE)
    assert machine.due_us is None


def test_a_bouncing_switch_neither_confirms_nor_causes_a_fault(vary: Vary) -> None:
    machine = locking(vary(limit_switch=BOTH_SWITCHES))
    for t_us in range(10_000, 1_000_000, 10_000):
        closed = (t_us // 10_000) % 2 == 0
        machine.reading(t_us, DriverReading(1980.0, rigid_switch=closed, flexible_switch=False))
        assert machine.state.phase is LockPhase.TRAVELLING


def test_both_states_of_a_slow_reading_are_reported(vary: Vary) -> None:
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

    def read_slowly() -> DriverReading:
        reading = read()
        bench.t_us += 2_000_000
        return reading

    bench.mock.read = read_slowly  # type: ignore[method-assign]
    bench.states.clear()
    bench.run(0.01)
    assert [state.phase for state in bench.states] == [LockPhase.SETTLED, LockPhase.FAULT]


def test_a_confirmed_state_needs_readings_to_stay_confirmed(vary: Vary) -> None:
    bench = homed(vary(limit_switch=BOTH_SWITCHES))
    bench.session.machine.step(bench.t_us + 1_400_000)
    assert bench.state.phase is LockPhase.SETTLED
    bench.session.machine.step(bench.t_us + 1_600_000)
    assert bench.fault == "the driver gave no reading for 1.6 s"
    without_switch = homed(vary())
    without_switch.session.machine.step(without_switch.t_us + 60_000_000)
    assert without_switch.state.phase is LockPhase.SETTLED


# --- pulses off, start-up ----------------------------------------------------------------------------


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


def test_homing_to_rigid_needs_permission(vary: Vary) -> None:
    bench = Bench(vary(home_mode=Mode.RIGID))
    assert bench.session.start() == CommandRefused("rigid", NOT_PERMITTED)
    assert bench.state.phase is LockPhase.UNKNOWN


NO_POSITION = "unknown; no position found: "


@pytest.mark.parametrize(
    ("reading", "says"),
    [
        (None, f"{NO_POSITION}the driver gave no reading"),
        (LOST_PULSE, "unknown; the servo's position is unknown: its pulses are off"),
        (DriverReading(1500.0), f"{NO_POSITION}the pulse of 1500 us belongs to neither end"),
        (AT_RIGID, LOCKED),
        (DriverReading(None, rigid_switch=True), CONFIRMED),
        (DriverReading(1020.0, flexible_switch=True), OPEN),
        (
            DriverReading(1020.0, rigid_switch=True),
            f"{NO_POSITION}pulse and rigid limit switch contradict each other",
        ),
        (
            DriverReading(None, rigid_switch=True, flexible_switch=True),
            f"{NO_POSITION}both limit switches are closed",
        ),
    ],
)
def test_adoption_requires_a_consistent_reading(vary: Vary, reading: DriverReading | None, says: str) -> None:
    machine = LockStateMachine(vary(startup=LockStartup.ADOPT))
    assert machine.start(0, reading) == []
    if reading is not None and machine.state.phase is LockPhase.TRAVELLING:
        # The last process may have died during the travel, so the machine waits for its end.
        assert machine.permit(10_000, False) == [], "a contact does not retract adopted rods"
        for t_us in range(20_000, 400_000, 10_000):
            machine.reading(t_us, reading)
    assert describe(machine.state) == says


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
