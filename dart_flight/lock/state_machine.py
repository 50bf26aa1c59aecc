"""The lock's state machine: its known state, and the commands that it permits.

This file performs no I/O and reads no clock. Every input carries its time, an integer in microseconds on the
core's time base. Only `_transition` changes the phase, and only as the table `TRANSITIONS` allows.
`docs/lock.md` shows the table as a diagram.

The servo has no position feedback. `settled` means three things: the driver accepted the command, the travel
time with its margin is over, and a later reading still shows the commanded pulse. Only a limit switch sets
`feedback=True`. If an end has a switch, the lock settles at that end only when the switch closes.

A shell calls `start` once, then `command` and `permit` as the core requests. The shell executes the returned
actions in order. After `Driver.set_pulse` has returned, the shell answers a `SetPulse` with `confirm_sent`.
If the driver failed, the shell answers with `driver_failed`. Every 20 to 50 ms or sooner, the shell supplies
a `reading`, stamped with the time *before* the reading, and calls `step`. `state` is a new object after every
change.
"""

from __future__ import annotations

from enum import StrEnum

import msgspec

from dart_flight.base.records import LockPhase, LockState, Mode
from dart_flight.config.vehicle import LockConfig, LockStartup
from dart_flight.lock.servo import mode_of

# --- inputs and outputs ------------------------------------------------------------------------------


class DriverReading(msgspec.Struct, frozen=True):
    """State that a driver reports; a switch is None if that end has no switch.

    Attributes:
        pulse_us: current output pulse width, read from the hardware if possible. The value is None if the
            pulses are off, or if the hardware cannot be read and nothing was commanded yet.
        rigid_switch: whether the limit switch at the rigid end is closed.
        flexible_switch: whether the limit switch at the flexible end is closed.
        errors: error messages of the hardware.
    """

    pulse_us: float | None
    rigid_switch: bool | None = None
    flexible_switch: bool | None = None
    errors: tuple[str, ...] = ()

    def switch(self, mode: Mode) -> bool | None:
        return self.rigid_switch if mode is Mode.RIGID else self.flexible_switch


class SetPulse(msgspec.Struct, frozen=True):
    """Command to the driver: output this pulse width."""

    pulse_us: float
    mode: Mode


class PulsesOff(msgspec.Struct, frozen=True):
    """Command to the driver: switch the pulses off."""


class CommandRefused(msgspec.Struct, frozen=True):
    """Notice to the caller that a command was refused. The driver receives no command."""

    what: str
    reason: str


Action = SetPulse | PulsesOff | CommandRefused

# --- the table ---------------------------------------------------------------------------------------


class LockEvent(StrEnum):
    """Events that can change the phase."""

    COMMANDED = "commanded"
    FOUND = "found at start-up"
    ARRIVED = "arrived"
    CONTACT = "contact while locking"
    TIMED_OUT = "timed out"
    DISPLACED = "pulse lost or switch open"
    DRIVER_FAILED = "driver failed"


TRANSITIONS: dict[LockPhase, dict[LockEvent, LockPhase]] = {
    LockPhase.UNKNOWN: {
        LockEvent.COMMANDED: LockPhase.TRAVELLING,
        LockEvent.FOUND: LockPhase.TRAVELLING,
        LockEvent.DRIVER_FAILED: LockPhase.FAULT,
    },
    LockPhase.TRAVELLING: {
        LockEvent.ARRIVED: LockPhase.SETTLED,
        LockEvent.CONTACT: LockPhase.TRAVELLING,
        LockEvent.TIMED_OUT: LockPhase.FAULT,
        LockEvent.DISPLACED: LockPhase.FAULT,
        LockEvent.DRIVER_FAILED: LockPhase.FAULT,
    },
    LockPhase.SETTLED: {
        LockEvent.COMMANDED: LockPhase.TRAVELLING,
        LockEvent.DISPLACED: LockPhase.FAULT,
        LockEvent.DRIVER_FAILED: LockPhase.FAULT,
    },
    LockPhase.FAULT: {
        LockEvent.COMMANDED: LockPhase.TRAVELLING,
    },
}

NOT_PERMITTED = "the arms are in contact or have not sprung back"
SETTLED_TEXT = {True: "settled", False: "settled (no feedback)"}


def describe(state: LockState) -> str:
    """Return a lock state for people, such as `rigid: settled (no feedback)`."""
    if state.phase is LockPhase.SETTLED:
        text = f"{state.mode}: {SETTLED_TEXT[state.feedback]}"
    elif state.phase is LockPhase.TRAVELLING:
        text = f"travelling to {state.mode}"
    else:
        text = str(state.phase)
    return text if state.reason is None else f"{text}; {state.reason}"


def status_text(state: LockState) -> str:
    """Return a lock state for MAVLink's STATUSTEXT, which holds 50 bytes."""
    return f"lock {describe(state)}".encode("ascii", "replace")[:50].decode()


def _run_start(before_us: int | None, t_us: int) -> int:
    """Return the start of the current run of readings: `before_us`, or `t_us` if the run begins now."""
    return t_us if before_us is None else before_us


# --- the machine -------------------------------------------------------------------------------------


class LockStateMachine:
    """State machine of the locking mechanism; the module's docstring describes how a shell uses it."""

    def __init__(self, config: LockConfig, t_us: int = 0) -> None:
        self.config = config
        self._state = LockState(t_us=t_us, phase=LockPhase.UNKNOWN, mode=None)
        self._permitted = False
        self._target: Mode | None = None  # commanded or found mode; kept in a fault for comparison
        self._pulses_off = False  # whether readings without pulses are expected
        self._begun_us = t_us  # time at which the current travel began
        self._sent_us: int | None = None  # time from which the driver outputs the target's pulse
        self._closed_since_us: int | None = None  # time at which the target's switch closed during a travel
        self._wrong_since_us: int | None = None  # time at which the pulse or a switch became wrong
        self._last_reading_us = t_us
        self._last: DriverReading | None = None

    @property
    def state(self) -> LockState:
        return self._state

    @property
    def due_us(self) -> int | None:
        """Earliest time at which a reading can settle the travel, microseconds; None without a travel."""
        if self._state.phase is not LockPhase.TRAVELLING or self._sent_us is None:
            return None
        return self._sent_us + round(self.config.switch_time_s * 1e6)

    # -- inputs: commands --

    def start(self, t_us: int, reading: DriverReading | None) -> list[Action]:
        """Home the lock, or adopt the position in the driver's first `reading`, as configured.

        The lock adopts the end whose limit switch is closed. If no switch is closed but the hardware outputs
        the pulse of an end, the lock adopts that end. The lock then waits until one travel time after `t_us`,
        because the servo may still move. If there is no such switch or pulse, or the inputs contradict each
        other, the lock stays `unknown`. A command stored by the last run does not prove the position of the
        horn.
        """
        if self.config.startup is LockStartup.HOME:
            return self.command(t_us, self.config.home_mode)
        found, reason = self._find_position(reading)
        if found is None:
            self._replace(t_us, reason=reason)
            return []
        self._begin(t_us, found, LockEvent.FOUND, commanded_us=None)
        self._pulses_off = reading is not None and reading.pulse_us is None
        self._sent_us = t_us
        return []

    def command(self, t_us: int, mode: Mode) -> list[Action]:
        """Move to a mode, or return a `CommandRefused`."""
        phase = self._state.phase
        if phase is LockPhase.TRAVELLING and self._target is not mode:
            return self._refuse(t_us, mode, f"travelling to {self._target}")
        if (
            mode is self._target
            and not self._pulses_off
            and phase in (LockPhase.TRAVELLING, LockPhase.SETTLED)
        ):
            return []
        if mode is Mode.RIGID and not self._permitted:
            return self._refuse(t_us, mode, NOT_PERMITTED)
        self._begin(t_us, mode, LockEvent.COMMANDED, commanded_us=t_us)
        return [SetPulse(self.config.servo.pulse_us(mode), mode)]

    def release(self, t_us: int) -> list[Action]:
        """Switch the pulses off; friction then holds the horn. The command is refused during a travel."""
        if self._state.phase is LockPhase.TRAVELLING:
            return self._refuse(t_us, "release", f"travelling to {self._target}")
        before = self._state.reason if self._state.phase is LockPhase.FAULT else None
        if not self._pulses_off:
            self._replace(t_us, reason=f"{before}; pulses off" if before else "pulses off")
        self._pulses_off = True
        return [PulsesOff()]

    def permit(self, t_us: int, permitted: bool) -> list[Action]:
        """Set whether locking is permitted: the arms are not in contact and have sprung back.

        Initially locking is not permitted. If the permission ends while the lock moves to rigid, the machine
        unlocks again, because the rods must not move into the slots during a contact.
        """
        self._permitted = permitted
        locking = self._state.phase is LockPhase.TRAVELLING and self._target is Mode.RIGID
        if permitted or not locking or self._state.commanded_us is None:
            return []
        self._begin(t_us, Mode.FLEXIBLE, LockEvent.CONTACT, commanded_us=t_us, reason=str(LockEvent.CONTACT))
        return [SetPulse(self.config.servo.pulse_us(Mode.FLEXIBLE), Mode.FLEXIBLE)]

    # -- inputs: results and time --

    def confirm_sent(self, t_us: int, pulse_us: float) -> None:
        """Start the travel time: the driver has accepted `SetPulse(pulse_us)`."""
        if self._state.phase is LockPhase.TRAVELLING and self._at_target(pulse_us) and self._sent_us is None:
            self._sent_us = t_us

    def driver_failed(self, t_us: int, reason: str) -> None:
        self._transition(t_us, LockEvent.DRIVER_FAILED, reason=reason)

    def reading(self, t_us: int, reading: DriverReading) -> None:
        """Process a driver's reading; `t_us` is the time before the driver was read."""
        self._last, self._last_reading_us = reading, t_us
        if self._state.phase is LockPhase.TRAVELLING:
            self._read_travelling(t_us, reading)
        elif self._state.phase is LockPhase.SETTLED:
            self._read_settled(t_us, reading)
        self.step(t_us)

    def step(self, t_us: int) -> None:
        phase = self._state.phase
        if phase is LockPhase.TRAVELLING and t_us - self._begun_us >= self.config.timeout_s * 1e6:
            self._transition(t_us, LockEvent.TIMED_OUT, reason=self._timeout_reason())
        elif phase is LockPhase.SETTLED and self._state.feedback:
            silent_s = (t_us - self._last_reading_us) * 1e-6
            if silent_s > self.config.timeout_s:
                self._transition(
                    t_us, LockEvent.DRIVER_FAILED, reason=f"the driver gave no reading for {silent_s:.1f} s"
                )

    # -- evaluation of readings --

    def _read_travelling(self, t_us: int, reading: DriverReading) -> None:
        target, due_us = self._target, self.due_us
        if target is None or self._sent_us is None or due_us is None or t_us < self._sent_us:
            return  # the reading was made before the command
        if self._fault_has_lasted(t_us, not self._pulses_off and reading.pulse_us is None):
            self._transition(
                t_us, LockEvent.DISPLACED, reason=self._fault_reason("the controller lost the pulse", reading)
            )
            return
        own, other = reading.switch(target), reading.switch(target.other)
        self._closed_since_us = _run_start(self._closed_since_us, t_us) if own else None
        if other or not self._pulse_is_expected(reading):
            return
        if own is None:
            if t_us >= due_us:
                self._transition(t_us, LockEvent.ARRIVED, feedback=False)
        elif self._closed_since_us is not None and self._has_lasted(self._closed_since_us, t_us):
            self._transition(t_us, LockEvent.ARRIVED, feedback=True)

    def _read_settled(self, t_us: int, reading: DriverReading) -> None:
        target = self._target
        if target is None:
            return
        fault = ""
        if reading.switch(target) is False:
            fault = f"the {target} limit switch has opened"
        elif reading.switch(target.other):
            fault = f"the {target.other} limit switch has closed"
        elif reading.pulse_us is None and not self._pulses_off:
            fault = "the controller lost the pulse"
        elif not self._pulse_is_expected(reading):
            fault = f"the controller outputs {reading.pulse_us:.0f} us"
        if self._fault_has_lasted(t_us, bool(fault)):
            self._transition(t_us, LockEvent.DISPLACED, reason=self._fault_reason(fault, reading))

    def _fault_has_lasted(self, t_us: int, wrong: bool) -> bool:
        self._wrong_since_us = _run_start(self._wrong_since_us, t_us) if wrong else None
        return self._wrong_since_us is not None and self._has_lasted(self._wrong_since_us, t_us)

    def _has_lasted(self, since_us: int, t_us: int) -> bool:
        return t_us - since_us >= self.config.debounce_s * 1e6

    def _pulse_is_expected(self, reading: DriverReading) -> bool:
        if reading.pulse_us is None:
            return self._pulses_off
        return self._at_target(reading.pulse_us)

    def _at_target(self, pulse_us: float) -> bool:
        if self._target is None:
            return False
        return abs(pulse_us - self.config.servo.pulse_us(self._target)) <= self.config.servo.tolerance_us

    @staticmethod
    def _fault_reason(text: str, reading: DriverReading) -> str:
        return "; ".join((text, *reading.errors))

    def _timeout_reason(self) -> str:
        target, last = self._target, self._last
        within = f"within {self.config.timeout_s:g} s"
        if target is None or self._sent_us is None:
            return f"the driver did not accept the command {within}"
        if last is None or self._last_reading_us < self._sent_us:
            return f"the driver reported nothing {within}"
        if last.switch(target.other):
            return f"the {target.other} limit switch did not open {within}"
        if last.switch(target) is False:
            return f"the {target} limit switch did not close {within}"
        if not self._pulse_is_expected(last):
            shown = "no pulses" if last.pulse_us is None else f"{last.pulse_us:.0f} us"
            wanted = f"{self.config.servo.pulse_us(target):.0f} us"
            return self._fault_reason(f"the controller outputs {shown} instead of {wanted}", last)
        return f"no reading that confirms the travel arrived {within} of the command"

    def _find_position(self, reading: DriverReading | None) -> tuple[Mode | None, str]:
        if reading is None:
            return None, "no position found: the driver gave no reading"
        closed = [mode for mode in Mode if reading.switch(mode)]
        by_pulse = None if reading.pulse_us is None else mode_of(self.config.servo, reading.pulse_us)
        if len(closed) > 1:
            return None, "no position found: both limit switches are closed"
        if closed and reading.pulse_us is not None and by_pulse is not closed[0]:
            return None, f"no position found: pulse and {closed[0]} limit switch contradict each other"
        if closed:
            return closed[0], ""
        if by_pulse is not None:
            return by_pulse, ""
        if reading.pulse_us is None:
            return None, "the servo's position is unknown: its pulses are off"
        return None, f"no position found: the pulse of {reading.pulse_us:.0f} us belongs to neither end"

    # -- changes --

    def _begin(
        self, t_us: int, mode: Mode, event: LockEvent, *, commanded_us: int | None, reason: str | None = None
    ) -> None:
        self._target = mode
        self._pulses_off = False
        self._begun_us = t_us
        self._sent_us = None
        self._closed_since_us = None
        self._transition(t_us, event, commanded_us=commanded_us, reason=reason)

    def _transition(
        self,
        t_us: int,
        event: LockEvent,
        *,
        reason: str | None = None,
        feedback: bool = False,
        commanded_us: int | None = None,
    ) -> None:
        """Change the phase according to the table (only here); an event without an entry has no effect."""
        after = TRANSITIONS[self._state.phase].get(event)
        if after is None:
            return
        travelling = after is LockPhase.TRAVELLING
        self._wrong_since_us = None
        self._state = LockState(
            t_us=t_us,
            phase=after,
            mode=self._target if after in (LockPhase.TRAVELLING, LockPhase.SETTLED) else None,
            commanded_us=commanded_us if travelling else self._state.commanded_us,
            settled_us=t_us if after is LockPhase.SETTLED else None,
            feedback=feedback,
            reason=reason,
        )

    def _refuse(self, t_us: int, what: str, reason: str) -> list[Action]:
        self._replace(t_us, reason=f"refused {what}: {reason}")
        return [CommandRefused(str(what), reason)]

    def _replace(self, t_us: int, reason: str) -> None:
        if self._state.reason != reason:
            self._state = msgspec.structs.replace(self._state, t_us=t_us, reason=reason)
