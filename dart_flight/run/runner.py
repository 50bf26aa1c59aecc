"""The one way in which a shell steps the core and hands out what follows.

The app (real time, MAVSDK) and the fast world (simulated time, in process) differ in where inputs come from
and in what carries commands out (`CommandSink`), in nothing else: numbers, order and what is recorded are
the same.
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
# Setpoints have left already; the estimates come with every IMU sample and are no commands.
_NOT_CARRIED: Final = (Setpoint, ForceEstimate, TorqueEstimate)


class CommandSink(Protocol):
    """What carries the core's commands out; nothing here may block or raise."""

    def send(self, setpoint: Setpoint) -> None:
        """A setpoint, at once."""

    def execute(self, output: Output) -> None:
        """Every other output but the estimates; records that are no commands are passed over."""


class Core(Protocol):
    """What is stepped: a `FlightCore`, or something of the same shape around one."""

    @property
    def pace(self) -> Pace:
        """How soon the next inputs have to be stepped."""

    def step(self, item: Input) -> list[Output]:
        """Advance by one input."""


class CoreRunner:
    """Steps the core: numbers inputs, hands out outputs, shows both to the observer.

    Args:
        core: the flight core.
        sink: carries out what it wants.
        observe: sees every input with its number, then every output and note with the number of its input.
        host_us: the host's monotonic clock, microseconds; simulated in the fast world.
    """

    def __init__(self, core: Core, sink: CommandSink, observe: Observe, host_us: Callable[[], int]) -> None:
        self.core = core
        self._sink, self._observe, self._host_us = sink, observe, host_us
        self._number = 0
        self._held: Setpoint | None = None

    def take(self, item: Input, *, more: bool = False) -> None:
        """Step the core with an input and hand out what follows; setpoints leave before anything else.

        Args:
            item: the input.
            more: another one follows at once. A setpoint waits for what that makes of it: one that is
                replaced a moment later need not leave.
        """
        number = self._number
        self._number += 1
        outputs = self.core.step(item)
        sent = [self._send(output) for output in outputs if isinstance(output, Setpoint)]
        if any(isinstance(output, Silence) for output in outputs):
            self._held = None  # nothing leaves once that is decided
        elif not more:
            self._send_held()
        self._observe(item, number)
        for output in outputs:
            self._observe(output, number)
            if not isinstance(output, _NOT_CARRIED):
                self._send_held()
                self._sink.execute(output)
        for note in sent:
            if note is not None:
                self._observe(note, number)

    def note(self, record: Record) -> None:
        """Show a record that is neither input nor output: truth, at the number of the next input."""
        self._observe(record, self._number)

    def _send(self, setpoint: Setpoint) -> SetpointSent | None:
        """Those of the recovery leave at once; others as soon as it is known that none follows at once."""
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
