"""A simulated vehicle on the ground whose link loses some answers about parameters."""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import msgspec

from dart_flight.base.records import FlightMode
from dart_flight.config.parameter_file import Value
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.embedded_autopilot import TICK_S
from tests.doubles.vehicle_peer import VehiclePeer


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


class ParameterVehicle(VehiclePeer):
    """`with ParameterVehicle(mission, port, losses) as vehicle`: a vehicle that sends to a UDP port.

    Args:
        mission: path of the mission with the vehicle.
        port: UDP port on this host.
        losses: defects.
        system: MAVLink system id.
        ground_port: UDP port of a ground station, or None.

    Attributes:
        values: parameters of the vehicle, which a test may change before the start.
        requests: number of requests for a parameter by name.
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
        ports = (port,) if ground_port is None else (port, ground_port)
        super().__init__(load_flyable(mission), ports, system)
        self._losses = losses or Losses()
        self._modes: list[FlightMode] = []
        self._silent, self._writes, self._written_s = False, 0, 0.0
        self.requests = 0
        self.has_shown = threading.Event()
        self.values = self.autopilot.parameters
        self.answers |= {
            "PARAM_REQUEST_LIST": self._list,
            "PARAM_REQUEST_READ": self._read,
            "PARAM_SET": self._set,
        }

    def show_modes(self, modes: Iterable[tuple[FlightMode, float]]) -> None:
        """Have the autopilot report each mode for some of its time, seconds, and then the last mode."""
        self._modes = [mode for mode, seconds in modes for _ in range(round(seconds / TICK_S))]

    def tick(self) -> None:
        super().tick()
        if self._modes:
            self.autopilot.mode = self._modes.pop(0)
            if not self._modes:
                self.has_shown.set()

    def exchange(self) -> None:
        if self._writes and self.autopilot.now_s - self._written_s > 2.0:
            self.values |= dict(self._losses.limits)
        if not self._silent:
            super().exchange()

    def _entries(self, *indices: int) -> list[Any]:
        """Return entries of the list of parameters, without the one that is always lost."""
        names = [name for name in self.values if name not in self._losses.unlisted]
        kept = (index for index in indices if index != self._losses.broken_index)
        return [self.endpoint.parameter(names[index], index, len(names)) for index in kept]

    def _list(self, _: Any) -> Iterable[Any]:
        listed = len(self.values.keys() - set(self._losses.unlisted))
        return self._entries(*range(round(listed * (1.0 - self._losses.share))))

    def _read(self, request: Any) -> Iterable[Any] | None:
        if request.param_index >= 0:
            return self._entries(request.param_index)
        self.requests += 1
        name = request.param_id.rstrip("\x00")
        if name in self._losses.mute:
            return []
        if name in self._losses.unlisted:
            return [self.endpoint.parameter(name, 65535, len(self.values) - len(self._losses.unlisted))]
        return None

    def _set(self, _: Any) -> Iterable[Any] | None:
        if self._writes == self._losses.dies_after:
            self._silent = True
            return []
        self._writes, self._written_s = self._writes + 1, self.autopilot.now_s
        return None
