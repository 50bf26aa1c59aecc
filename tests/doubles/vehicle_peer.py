"""A scripted vehicle: the simulated vehicle on a thread, with a table of answers before its own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from dart_flight.base.thread_context import ThreadContext
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import LockDriver
from dart_flight.sim.embedded_autopilot import Autopilot
from dart_flight.sim.mavlink_endpoint import Link, MavlinkEndpoint
from dart_flight.sim.served_world import ticks_in_real_time
from dart_flight.sim.simulated_vehicle import SimulatedVehicle

Answers = Mapping[str, Callable[[Any], Iterable[Any] | None]]
ANY = "*"  # key of the answer to every other kind of message


class TableEndpoint(MavlinkEndpoint):
    """An endpoint that answers by a table; None in place of the replies: the vehicle itself answers.

    Args:
        autopilot: see `MavlinkEndpoint`.
        ports: see `MavlinkEndpoint`.
        answers: functions that return the replies to a message, by its kind.
        system: see `MavlinkEndpoint`.
    """

    def __init__(
        self, autopilot: Autopilot, ports: tuple[int, ...], answers: Answers, system: int = 1
    ) -> None:
        super().__init__(autopilot, ports, system=system)
        self._answers = answers

    def parameter(self, name: str, index: int, count: int) -> Any:
        """Return the message with a parameter's value."""
        value = self._param_value(name, index)
        value.param_count = count
        return value

    def send(self, message: Any) -> None:
        """Send a message on the first link."""
        self._send(self.links[0], message)

    def _handle_message(self, link: Link, message: Any) -> None:
        answer = self._answers.get(message.get_type(), self._answers.get(ANY))
        replies = None if answer is None else answer(message)
        if replies is None:
            super()._handle_message(link, message)
        for reply in replies or ():
            self._send(link, reply)


class VehiclePeer(ThreadContext):
    """`with VehiclePeer(mission, (port,)) as vehicle`: a vehicle that sends to UDP ports in real time.

    A subclass extends `answers`, `tick` and `exchange`.

    Attributes:
        autopilot: the vehicle's autopilot.
        endpoint: its MAVLink endpoint.
        answers: functions that return the replies to a message, by its kind.
    """

    def __init__(self, mission: Mission, ports: tuple[int, ...], system: int = 1) -> None:
        super().__init__()
        self._vehicle = SimulatedVehicle(mission, 1, LockDriver.PX4)
        self.autopilot = self._vehicle.autopilot
        self.answers: dict[str, Callable[[Any], Iterable[Any] | None]] = {}
        self.endpoint = TableEndpoint(self.autopilot, ports, self.answers, system)

    def tick(self) -> None:
        """Advance the vehicle by one tick."""
        self._vehicle.advance()

    def exchange(self) -> None:
        """Receive and send the messages of a tick."""
        self.endpoint.exchange()

    def _run(self) -> None:
        for _ in ticks_in_real_time():
            if self._stop.is_set():
                return
            self.tick()
            self.exchange()

    def _close(self) -> None:
        self.endpoint.close()
