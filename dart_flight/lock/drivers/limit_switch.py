"""Limit switches at the ends of the travel, on GPIO lines, through libgpiod's Python package (version 2).

A switch closes to ground. By default, the line is therefore pulled up and active low.
"""

from __future__ import annotations

import importlib
import sys
from typing import Any, Final, Protocol

import msgspec

from dart_flight.config.vehicle import LimitSwitch
from dart_flight.lock.drivers import Driver, DriverError
from dart_flight.lock.state_machine import DriverReading

_INSTALL: Final = f"{sys.executable} -m pip install 'gpiod>=2'"


class SwitchReader(Protocol):
    """Reader of the limit switches; raises `DriverError` if a switch cannot be read."""

    def read(self) -> tuple[bool | None, bool | None]:
        """Return (rigid, flexible): True if the end's switch is closed, None if the end has no switch."""

    def close(self) -> None:
        """Release the lines."""


class GpioLimitSwitch:
    """The configured lines of a GPIO chip, requested at the first reading."""

    def __init__(self, config: LimitSwitch) -> None:
        self._config = config
        self._request: Any = None
        try:
            self._gpiod: Any = importlib.import_module("gpiod")
        except ModuleNotFoundError:
            raise DriverError(
                f"a limit switch needs libgpiod's Python package: {_INSTALL}", ("limit_switch",)
            ) from None
        except ImportError as error:
            raise DriverError(f"cannot load the gpiod package: {error}", ("limit_switch",)) from None
        if not hasattr(self._gpiod, "request_lines"):
            raise DriverError(
                f"a limit switch needs version 2 of the gpiod package: {_INSTALL}",
                ("limit_switch",),
            )

    def read(self) -> tuple[bool | None, bool | None]:
        config, line = self._config, self._gpiod.line
        try:
            if self._request is None:
                lines = tuple(n for n in (config.rigid_line, config.flexible_line) if n is not None)
                bias = line.Bias.PULL_UP if config.active_low else line.Bias.PULL_DOWN
                settings = self._gpiod.LineSettings(
                    direction=line.Direction.INPUT, bias=bias, active_low=config.active_low
                )
                self._request = self._gpiod.request_lines(
                    config.chip, consumer="dart-flight lock", config={lines: settings}
                )
            rigid, flexible = (
                None if n is None else self._request.get_value(n) == line.Value.ACTIVE
                for n in (config.rigid_line, config.flexible_line)
            )
        except (OSError, ValueError, self._gpiod.RequestReleasedError) as error:
            self.close()
            raise DriverError(f"limit switch on {config.chip}: {error}", ("limit_switch", "chip")) from None
        return rigid, flexible

    def close(self) -> None:
        request, self._request = self._request, None
        if request is not None:
            request.release()


class DriverWithLimitSwitch:
    """A driver whose readings include the limit switches."""

    def __init__(self, driver: Driver, switches: SwitchReader) -> None:
        self._driver = driver
        self._switches = switches

    def open(self) -> None:
        self._driver.open()
        self._switches.read()

    def set_pulse(self, pulse_us: float) -> None:
        self._driver.set_pulse(pulse_us)

    def release(self) -> None:
        self._driver.release()

    def read(self) -> DriverReading:
        reading = self._driver.read()
        rigid, flexible = self._switches.read()
        return msgspec.structs.replace(reading, rigid_switch=rigid, flexible_switch=flexible)

    def close(self) -> None:
        self._switches.close()
        self._driver.close()
