"""A simulated vehicle on the ground whose link loses some answers about parameters."""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import msgspec

from dart_flight.base.records import FlightMode
from dart_flight.base.thread_context import ThreadContext
from dart_flight.config.parameter_file import Value
from dart_flight.config.vehicle import LockDriver
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.embedded_autopilot import TICK_S
from dart_flight.sim.mavlink_endpoint import Link, MavlinkEndpoint
from dart_flight.sim.served_world import ticks_in_real_time
from dart_flight.sim.simulated_vehicle import SimulatedVehicle


class Losses(msgspec.Struct):
    """Defects of the vehicle's link and parameters.

    Attributes:
        mute: names of parameters whose values are never sent.
        unlisted: names of parameters that are missing from the list, although they can be read.
        share: share of the list's entries that is lost at its first transmission, from the end of the list.
        broken_index: index of the list's entry that is always lost, or None.
        dies_after: number of writes after which the vehicle is silent, or None.
        limits: values that parameters take two seconds after the last write.
    """

    mute: Collection[str] = ()
    unlisted: Collection[str] = ()
    share: float = 0.0
    broken_index: int | None = None
    dies_after: int | None = None
    limits: Mapping[str, Value] = {}


class _LossyEndpoint(MavlinkEndpoint):
    losses = Losses()
    silent = False
    writes, written_s = 0, 0.0
    requests = 0  # by name

    def exchange(self) -> None:
        if self.writes and self.autopilot.now_s - self.written_s > 2.0:
            self.autopilot.parameters |= dict(self.losses.limits)
        if not self.silent:
            super().exchange()

    def _handle_message(self, link: Link, message: Any) -> None:
        kind = message.get_type()
        names = [name for name in self.autopilot.parameters if name not in self.losses.unlisted]
        if kind == "PARAM_REQUEST_LIST":
            for index, name in enumerate(names[: round(len(names) * (1.0 - self.losses.share))]):
                self._send_entry(link, name, index, len(names))
            return
        if kind == "PARAM_REQUEST_READ":
            if message.param_index >= 0:
                self._send_entry(link, names[message.param_index], message.param_index, len(names))
                return
            self.requests += 1
            name = message.param_id.rstrip("\x00")
            if name in self.losses.mute:
                return
            if name in self.losses.unlisted:
                self._send_entry(link, name, 65535, len(names))
                return
        if kind == "PARAM_SET":
            if self.writes == self.losses.dies_after:
                self.silent = True
                return
            self.writes, self.written_s = self.writes + 1, self.autopilot.now_s
        super()._handle_message(link, message)

    def _send_entry(self, link: Link, name: str, index: int, count: int) -> None:
        if index != self.losses.broken_index:
            value = self._param_value(name, index)
            value.param_count = count
            self._send(link, value)


class ParameterVehicle(ThreadContext):
    """`with ParameterVehicle(mission, port, losses) as vehicle`: a vehicle that sends to a UDP port.

    Args:
        mission: path of the mission with the vehicle.
        port: UDP port on this host.
        losses: defects.
        system: MAVLink system id.
        ground_port: UDP port of a ground station, or None.

    Attributes:
        values: parameters of the vehicle, which a test may change before the start.
        has_shown: set after the last mode of `show_modes` has begun.
    """

    def __init__(
        self,
        mission: str,
        port: int,
        losses: Losses | None = None,
        system: int = 1,
        ground_port: int | None = None,
    ) -> None:
        super().__init__()
        ports = (port,) if ground_port is None else (port, ground_port)
        self._vehicle = SimulatedVehicle(load_flyable(mission), 1, LockDriver.PX4)
        self._endpoint = _LossyEndpoint(self._vehicle.autopilot, ports, system=system)
        self._endpoint.losses = losses or Losses()
        self._modes: list[FlightMode] = []
        self.has_shown = threading.Event()
        self.values = self._vehicle.autopilot.parameters

    @property
    def requests(self) -> int:
        """Number of requests for a parameter by name."""
        return self._endpoint.requests

    def show_modes(self, modes: Iterable[tuple[FlightMode, float]]) -> None:
        """Have the autopilot report each mode for some of its time, seconds, and then the last mode."""
        self._modes = [mode for mode, seconds in modes for _ in range(round(seconds / TICK_S))]

    def _run(self) -> None:
        for _ in ticks_in_real_time():
            if self._stop.is_set():
                return
            self._vehicle.advance()
            if self._modes:
                self._vehicle.autopilot.mode = self._modes.pop(0)
                if not self._modes:
                    self.has_shown.set()
            self._endpoint.exchange()

    def _close(self) -> None:
        self._endpoint.close()
