"""A VehicleSession on doubles of MAVSDK's plugins, as the fixtures of this room provide it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from dart_flight.base.records import Input
from dart_flight.vehicle import vehicle_session as module
from dart_flight.vehicle.clock import Clock
from dart_flight.vehicle.vehicle_session import VehicleSession


class Plugin:
    """A double of a MAVSDK plugin, which keeps every call and the subscribed callbacks by their names."""

    def __init__(self, answers: dict[str, Callable[..., Any]]) -> None:
        self.calls: list[tuple[str, tuple[Any, ...]]] = []
        self.callbacks: dict[str, Callable[[Any, Any], None]] = {}
        self.answers = answers

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            self.calls.append((name, arguments))
            if name.startswith("subscribe_"):
                key = arguments[0] if len(arguments) > 1 else name.removeprefix("subscribe_")
                self.callbacks[key] = arguments[-1]
            return self.answers[name](*arguments) if name in self.answers else None

        return call


class SessionRig:
    """A VehicleSession on doubles of the plugins.

    Args:
        answers: functions that answer the plugins' calls, by name.
        systems: ids of the systems on the link; the first is the vehicle's.
        clock: clock of the session; None: its own.

    Attributes:
        plugins: the doubles, by name.
        delivered: records of the session, in order.
    """

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        answers: dict[str, Callable[..., Any]],
        systems: Sequence[int] = (1,),
        clock: Clock | None = None,
    ) -> None:
        self.plugins: dict[str, Plugin] = {}
        for name in ("Offboard", "Action", "MavlinkDirect", "Events"):
            plugin = self.plugins[name] = Plugin(answers)
            monkeypatch.setattr(module, name, lambda _, plugin=plugin: plugin)
        self.delivered: list[Input] = []
        found = [
            SimpleNamespace(get_system_id=lambda number=number: number, has_autopilot=lambda: True)
            for number in systems
        ]

        async def get_systems() -> list[Any]:
            return found

        mavsdk = SimpleNamespace(get_systems=get_systems)
        self.session = VehicleSession(mavsdk, found[0], self.delivered.append, clock)

    def records_of(self, kind: type[Any]) -> list[Any]:
        return [item for item in self.delivered if isinstance(item, kind)]

    def subscribe(self, motors: int = 4, uses_esc: bool = True) -> SessionRig:
        """Subscribe to all streams of a vehicle."""
        estimation = SimpleNamespace(uses_esc=uses_esc, thrust_source=None)
        self.session.subscribe(estimation, motors, lowest_battery_v=14.0)  # type: ignore[arg-type]
        return self

    def publish(self, plugin: str, stream: str, value: Any) -> None:
        self.plugins[plugin].callbacks[stream](value, None)

    def receive(self, stream: str, **fields: object) -> None:
        """Deliver a message of the autopilot's component."""
        self.publish("MavlinkDirect", stream, message(**fields))


def message(system: int = 1, component: int = 1, /, **fields: object) -> Any:
    """Return a message of MAVSDK, by default of the autopilot's component."""
    return SimpleNamespace(system_id=system, component_id=component, fields_json=json.dumps(fields))


MakeSession = Callable[..., SessionRig]
