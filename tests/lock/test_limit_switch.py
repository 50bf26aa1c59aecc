"""Limit switches on a double of the gpiod package (compared with gpiod 2.5)."""

from __future__ import annotations

import sys
from enum import Enum
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from dart_flight.config.vehicle import LimitSwitch, LockDriver
from dart_flight.lock.drivers import DriverError
from dart_flight.lock.drivers.limit_switch import GpioLimitSwitch
from tests.lock.rigs import MakeRig


class Value(Enum):
    INACTIVE = 0
    ACTIVE = 1


class Request:
    def __init__(self, levels: dict[int, bool], active_low: bool) -> None:
        self.levels, self.active_low, self.released = levels, active_low, False

    def get_value(self, line: int) -> Value:
        if line not in self.levels:
            raise OSError(5, "Input/output error")
        return Value.ACTIVE if self.levels[line] is not self.active_low else Value.INACTIVE

    def release(self) -> None:
        self.released = True


@pytest.fixture
def gpiod(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A double of gpiod; `levels` holds the electrical level of each line, high for an open switch."""
    module: Any = ModuleType("gpiod")
    module.levels = {23: True, 24: True}
    module.requests, module.opened = [], list[Request]()
    module.line = SimpleNamespace(
        Value=Value,
        Direction=Enum("Direction", "AS_IS INPUT OUTPUT"),
        Bias=Enum("Bias", "AS_IS UNKNOWN DISABLED PULL_UP PULL_DOWN"),
    )
    module.RequestReleasedError = type("RequestReleasedError", (Exception,), {})
    module.LineSettings = SimpleNamespace

    def request_lines(path: str, config: dict[tuple[int, ...], Any], consumer: str) -> Request:
        if path != "/dev/gpiochip0":
            raise FileNotFoundError(2, "No such file or directory")
        ((lines, settings),) = config.items()
        module.requests.append((path, lines, settings, consumer))
        request = Request(module.levels, settings.active_low)
        module.opened.append(request)
        return request

    module.request_lines = request_lines
    monkeypatch.setitem(sys.modules, "gpiod", module)
    return module


def test_both_lines_are_read(gpiod: Any) -> None:
    switches = GpioLimitSwitch(LimitSwitch("/dev/gpiochip0", rigid_line=23, flexible_line=24))
    assert switches.read() == (False, False)
    gpiod.levels[23] = False  # closed to ground
    assert switches.read() == (True, False)
    (request,) = gpiod.requests
    assert request[1] == (23, 24)
    assert request[2].bias.name == "PULL_UP"
    assert request[2].direction.name == "INPUT"


def test_a_single_active_high_line_is_read(gpiod: Any) -> None:
    switches = GpioLimitSwitch(LimitSwitch("/dev/gpiochip0", flexible_line=24, active_low=False))
    assert switches.read() == (None, True)
    assert gpiod.requests[0][2].bias.name == "PULL_DOWN"


def test_a_failed_line_raises_a_driver_error_and_is_requested_again(gpiod: Any) -> None:
    with pytest.raises(DriverError, match="limit switch on /dev/gpiochip7") as caught:
        GpioLimitSwitch(LimitSwitch("/dev/gpiochip7", rigid_line=23)).read()
    assert caught.value.key == ("limit_switch", "chip")
    switches = GpioLimitSwitch(LimitSwitch("/dev/gpiochip0", rigid_line=23))
    del gpiod.levels[23]
    with pytest.raises(DriverError, match="Input/output error"):
        switches.read()
    gpiod.levels[23] = False
    assert switches.read() == (True, None)
    assert len(gpiod.requests) == 2


def test_a_driver_reads_the_switches_and_releases_their_lines_when_it_is_closed(
    gpiod: Any, make_rig: MakeRig
) -> None:
    """Otherwise the next process finds the lines in use."""
    rig = make_rig(LockDriver.PX4, limit_switch=LimitSwitch("/dev/gpiochip0", rigid_line=23))
    for number in range(2):
        rig.driver.open()
        rig.driver.set_pulse(1980.0)
        reading = rig.driver.read()
        assert (reading.pulse_us, reading.rigid_switch, reading.flexible_switch) == (1980.0, False, None)
        rig.driver.close()
        assert [request.released for request in gpiod.opened] == [True] * (number + 1)


def test_a_missing_chip_is_reported_when_the_driver_is_opened(gpiod: Any, make_rig: MakeRig) -> None:
    """The error must not wait for the first reading in flight."""
    rig = make_rig(LockDriver.PX4, limit_switch=LimitSwitch("/dev/gpiochip7", rigid_line=23))
    with pytest.raises(DriverError, match="limit switch on /dev/gpiochip7"):
        rig.driver.open()
    assert gpiod.requests == []


def test_a_missing_gpiod_package_is_reported_with_the_install_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "gpiod", None)
    with pytest.raises(DriverError, match="-m pip install 'gpiod>=2'"):
        GpioLimitSwitch(LimitSwitch("/dev/gpiochip0", rigid_line=23))


def test_version_1_of_the_gpiod_package_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gpiod", ModuleType("gpiod"))
    with pytest.raises(DriverError, match="version 2 of the gpiod package"):
        GpioLimitSwitch(LimitSwitch("/dev/gpiochip0", rigid_line=23))


def test_a_gpiod_package_that_fails_to_load_is_not_reported_as_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "gpiod.py").write_text("raise ImportError('libgpiod.so.3: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "gpiod", raising=False)
    with pytest.raises(DriverError, match=r"cannot load the gpiod package: libgpiod\.so\.3"):
        GpioLimitSwitch(LimitSwitch("/dev/gpiochip0", rigid_line=23))
