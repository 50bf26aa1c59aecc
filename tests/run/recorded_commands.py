"""A transport of the core's shell that records the commands instead of sending them."""

from __future__ import annotations

from dart_flight.base.records import Phase, Setpoint, VehicleAction


class RecordedCommands:
    """A transport of the core's shell.

    Attributes:
        calls: setpoints, actions and phases; `silence` and `end` for the calls without a value.
    """

    def __init__(self) -> None:
        self.calls: list[object] = []

    def send(self, setpoint: Setpoint) -> None:
        self.calls.append(setpoint)

    def act(self, action: VehicleAction) -> None:
        self.calls.append(action)

    def enter(self, phase: Phase) -> None:
        self.calls.append(phase)

    def fall_silent(self) -> None:
        self.calls.append("silence")

    def finish(self) -> None:
        self.calls.append("end")
