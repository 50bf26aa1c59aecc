"""The shell of the core in every flight: it steps the core, records, and carries out the core's commands.

The worlds differ in two parts of the shell. The transport delivers the commands to the vehicle: over MAVSDK
(`app`) or in process (`fast`). The time (`timing`) is real, in lockstep, or simulated in process. A replay
has no shell, because it carries out nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final, Protocol

import msgspec

from dart_flight.base.records import (
    ContactAnswer,
    ContactRequest,
    ForceEstimate,
    FrameAnchor,
    Input,
    LockCommand,
    LockPermission,
    MissionEnd,
    Output,
    Phase,
    PhaseChange,
    PlanAnswer,
    PlanRequest,
    PosesWithheld,
    Record,
    Setpoint,
    SetpointSent,
    Silence,
    TorqueEstimate,
    VehicleAction,
    VehicleCommand,
    WallEstimate,
)
from dart_flight.core.pace import Pace
from dart_flight.run.timing import RealTime

Observe = Callable[[Record, int], None]
# Outputs that are not executed: setpoints are sent separately, and estimates are not commands.
_NOT_CARRIED: Final = (Setpoint, ForceEstimate, TorqueEstimate)


class Transport(Protocol):
    """Delivers the core's commands to the vehicle; its methods must not block or raise."""

    def send(self, setpoint: Setpoint) -> None:
        """Send a setpoint immediately."""

    def act(self, action: VehicleAction) -> None:
        """Start an action; its `CommandResult` becomes an input."""

    def fall_silent(self) -> None:
        """Send no more setpoints."""

    def enter(self, phase: Phase) -> None:
        """Note a new phase of the mission."""

    def finish(self) -> None:
        """Note the mission's end."""


class LockOrders(Protocol):
    """The interface through which the core commands the lock."""

    def obey(self, order: LockCommand | LockPermission) -> None: ...


class Poses(Protocol):
    """The interface through which the core commands the motion capture."""

    def withhold(self, *, attitude_only: bool) -> None: ...


class PlannerLink(Protocol):
    """A planner that runs outside the core and returns its answers to the core as inputs."""

    def send(self, item: PlanRequest | ContactRequest | WallEstimate | FrameAnchor) -> None: ...


class Core(Protocol):
    """A `FlightCore`, or a wrapper with the same interface."""

    @property
    def pace(self) -> Pace:
        """Whether the next inputs are to be processed in batches or immediately."""

    def step(self, item: Input) -> list[Output]:
        """Advance by one input."""


class Shell:
    """Steps the core, numbers inputs, passes inputs and outputs to an observer, and carries out commands.

    Args:
        observe: receives each input with the input's number. Afterwards it receives, with the same number,
            each output and note (such as `SetpointSent`) that the input causes.

    Attributes:
        lock, poses: None if the vehicle has no lock or no motion capture.
        planners: planners by the kind of request that they answer.
    """

    def __init__(self, core: Core, transport: Transport, observe: Observe, time: RealTime) -> None:
        self.core, self.time = core, time
        self.lock: LockOrders | None = None
        self.poses: Poses | None = None
        self.planners: Mapping[type, PlannerLink] = {}
        self._transport, self._observe = transport, observe
        self._number = 0
        self._held: Setpoint | None = None

    def step(self, item: Input, *, more: bool = False) -> None:
        """Step the core with an input and carry out the core's outputs, setpoints first.

        If another input follows immediately (`more`), hold the setpoint of this step, because the next step
        may replace it.
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
            self._held = None  # once the core has decided to fall silent, no setpoint may follow
        elif not more:
            self._send_held()
        self._observe(item, number)
        for output in outputs:
            self._observe(output, number)
            if type(output) not in _NOT_CARRIED:
                self._send_held()
                self.execute(output)
        for note in sent:
            self._observe(note, number)

    def note(self, record: Record) -> None:
        """Pass a record that is neither input nor output, such as truth, to the observer."""
        self._observe(record, self._number)

    def execute(self, output: Output) -> None:
        """Start a command that is not a setpoint, without waiting for its completion."""
        if isinstance(output, VehicleCommand):
            self.time.open_command()
            self._transport.act(output.action)
        elif isinstance(output, LockCommand | LockPermission):
            if self.lock is not None:
                self.lock.obey(output)
        elif isinstance(output, PlanRequest | ContactRequest | WallEstimate | FrameAnchor):
            planner = self.planners.get(ContactRequest if isinstance(output, ContactRequest) else PlanRequest)
            if planner is not None:
                if isinstance(output, PlanRequest | ContactRequest):
                    self.time.open_request(output)
                planner.send(output)
        elif isinstance(output, PosesWithheld):
            if self.poses is not None:
                self.poses.withhold(attitude_only=output.attitude_only)
        elif isinstance(output, PhaseChange):
            self._transport.enter(output.after)
        elif isinstance(output, Silence | MissionEnd):
            self._transport.fall_silent()
            self.time.end()
            if isinstance(output, MissionEnd):
                self._transport.finish()

    def due_answers(self) -> list[PlanAnswer | ContactAnswer]:
        """Remove and return the planners' answers that are due, as inputs received now."""
        return [
            msgspec.structs.replace(answer, received_us=self.time.host_us())
            for answer in self.time.due_answers()
        ]

    def _send(self, setpoint: Setpoint) -> SetpointSent | None:
        """Send a recovery setpoint now and return its latency; hold any other setpoint for `_send_held`."""
        if not setpoint.recovery:
            self._held = setpoint
            return None
        self._held = None
        self._transport.send(setpoint)
        sent_us = self.time.host_us()
        return SetpointSent(setpoint.t_us, sent_us, sent_us - setpoint.trigger_received_us)

    def _send_held(self) -> None:
        if self._held is not None:
            self._transport.send(self._held)
            self._held = None
