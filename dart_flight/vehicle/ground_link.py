"""A blocking connection for work on the ground: move an output, read parameters."""

from __future__ import annotations

from collections.abc import Iterable
from types import TracebackType
from typing import Any

from mavsdk.component_type import ComponentType
from mavsdk.logging import log_subscribe
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.param import Param

from dart_flight.vehicle.session import VehicleError, log_quietly


class GroundLink:
    """`with GroundLink(url, timeout_s) as link: link.set_actuator(1, 0.5)`.

    Raises:
        VehicleError: on entering, when the URL cannot be opened or no autopilot answers.
    """

    def __init__(self, url: str, timeout_s: float) -> None:
        self._url, self._timeout_s = url, timeout_s
        self._mavsdk: Any = None

    def __enter__(self) -> GroundLink:
        log_subscribe(log_quietly)
        self._mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER))
        try:
            self._mavsdk.add_any_connection_with_handle(self._url)
            system = self._mavsdk.first_autopilot(self._timeout_s)
        except Exception as error:
            self._mavsdk.destroy()
            raise VehicleError(f"cannot open {self._url}: {error}") from error
        if system is None:
            self._mavsdk.destroy()
            raise VehicleError(f"no autopilot on {self._url} within {self._timeout_s:g} s")
        self._action, self._param = Action(system), Param(system)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._mavsdk.destroy()

    def set_actuator(self, index: int, value: float) -> None:
        """Command a peripheral output, -1 to 1; an acknowledgement says nothing about movement."""
        self._action.set_actuator(index, value)

    def read_parameters(self, names: Iterable[str]) -> dict[str, float]:
        """Values of the parameters that the vehicle has, whole numbers or not; others are left out."""
        values = {}
        for name in names:
            for read in (self._param.get_param_int, self._param.get_param_float):
                try:
                    values[name] = float(read(name))
                except Exception:  # not there, or of the other kind
                    continue
                break
        return values
