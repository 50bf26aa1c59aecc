"""The runner of every flight: it steps the core and carries out the core's outputs.

The app (MAVSDK) and the fast world (in process) differ only in the source of inputs and in the receiver of
commands (`CommandSink`). Both number, order and record the inputs in the same way.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol

from dart_flight.base.records import (
    ForceEstimate,
    Input,
    Output,
    Record,
    Setpoint,
    SetpointSent,
    Silence,
    TorqueEstimate,
)
from dart_flight.core.pace import Pace

Observe = Callable[[Record, int], None]
# Outputs that are not executed: setpoints are sent separately, and estimates are not commands.
_NOT_CARRIED: Final = (Setpoint, ForceEstimate, TorqueEstimate)


class CommandSink(Protocol):
    """Receiver of the core's commands; its methods must not block or raise."""

    def send(self, setpoint: Setpoint) -> None:
        """Send a setpoint at once."""

    def execute(self, output: Output) -> None:
        """Carry out a command that is not a setpoint. Ignore records that are not commands."""


class Core(Protocol):
    """A `FlightCore`, or a wrapper with the same interface."""

    @property
    def pace(self) -> Pace:
        """Whether the core must process the next inputs in batches or immediately."""

    def step(self, item: Input) -> list[Output]:
        """Advance by one input."""


class CoreRunner:
    """Runner that steps the core, numbers inputs, and passes inputs and outputs to an observer.

    Args:
        observe: receives each input with the input's number. Afterwards it receives, with the same number,
            each output and note (such as `SetpointSent`) that the input causes.
        host_us: returns the host's monotonic time; the fast world simulates it.
    """

    def __init__(self, core: Core, sink: CommandSink, observe: Observe, host_us: Callable[[], int]) -> None:
        self.core = core
        self._sink, self._observe, self._host_us = sink, observe, host_us
        self._number = 0
        self._held: Setpoint | None = None

    def step(self, item: Input, *, more: bool = False) -> None:
        """Step the core with an input and carry out the core's outputs, setpoints first.

        If another input follows at once (`more`), the setpoint of this step is not sent yet, because the next
        step may replace it.
        """
        number = self._number
        self._number += 1
        outputs = self.core.step(item)
        sent: list[SetpointSent] = []
        silent = False
        for output in outputs:  # compare types, because `isinstance` is slow for a record of another kind
            if type(output) is Setpoint:
                note = self._send(output)
                if note is not None:
                    sent.append(note)
            elif type(output) is Silence:
                silent = True
        if silent:
            self._held = None  # send no setpoint once the core has decided to fall silent
        elif not more:
            self._send_held()
        self._observe(item, number)
        for output in outputs:
            self._observe(output, number)
            if type(output) not in _NOT_CARRIED:
                self._send_held()
                self._sink.execute(output)
        for note in sent:
            self._observe(note, number)

    def note(self, record: Record) -> None:
        """Pass a record that is neither input nor output, such as truth, to the observer."""
        self._observe(record, self._number)

    def _send(self, setpoint: Setpoint) -> SetpointSent | None:
        """Send a recovery setpoint at once and return its latency; store any other for `_send_held`."""
        if not setpoint.recovery:
            self._held = setpoint
            return None
        self._held = None
        self._sink.send(setpoint)
        sent_us = self._host_us()
        return SetpointSent(setpoint.t_us, sent_us, sent_us - setpoint.trigger_received_us)

    def _send_held(self) -> None:
        if self._held is not None:
            self._sink.send(self._held)
            self._held = None
