"""The serial driver and an emulated Maestro behind a pseudo-terminal: real pyserial, real bytes."""

from __future__ import annotations

import itertools
import time
from collections.abc import Container
from pathlib import Path

import pytest
import serial

from dart_flight.base.records import LockPhase, Mode
from dart_flight.config.vehicle import LockDriver
from dart_flight.lock.drivers import DriverError
from dart_flight.lock.drivers.maestro import MaestroDriver, error_names
from tests.lock.rigs import MaestroRig, MakeRig, Vary
from tests.real_time import TooSlow


@pytest.fixture
def rig(make_rig: MakeRig) -> MaestroRig:
    """A controller on channel 2, with the servo between its ends."""
    rig: MaestroRig = make_rig(LockDriver.MAESTRO, maestro={"channel": 2})
    return rig


def test_the_bytes_on_the_wire_match_the_maestros_protocol(make_rig: MakeRig) -> None:
    rig = make_rig(LockDriver.MAESTRO, maestro={"channel": 5, "speed_limit_us_s": 1000.0})
    rig.driver.open()
    rig.driver.set_pulse(1500.0)  # 6000 quarters: low seven bits 0x70, high seven 0x2E
    assert rig.driver.read().pulse_us == 1500.0
    rig.driver.release()
    assert rig.driver.read().pulse_us is None
    # fmt: off
    assert bytes(rig.controller.received) == bytes((
        0xA1, 0xA1,                    # clear earlier errors
        0x87, 5, 40, 0, 0xA1, 0xA1,    # 1000 us/s are 40 steps of 25 us/s
        0x84, 5, 0x70, 0x2E, 0xA1, 0xA1,
        0x90, 5, 0x90, 5, 0xA1, 0xA1,
        0x84, 5, 0, 0, 0xA1, 0xA1,     # 0 stops the pulses
        0x90, 5, 0x90, 5, 0xA1, 0xA1,
    ))
    # fmt: on


def test_the_lock_settles_only_after_the_speed_limited_travel(make_rig: MakeRig) -> None:
    rig = make_rig(LockDriver.MAESTRO, maestro={"speed_limit_us_s": 1000.0})
    rig.begin(1.2)
    started_us = rig.t_us
    rig.session.command(Mode.RIGID)
    rig.run(0.5)
    assert rig.controller.output_us() == pytest.approx(1520.0, abs=11.0)
    assert rig.session.state.phase is LockPhase.TRAVELLING
    state = rig.run(0.7)
    assert (state.phase, state.mode) == (LockPhase.SETTLED, Mode.RIGID)
    assert state.settled_us is not None
    assert state.settled_us - started_us == pytest.approx(990_000, abs=21_000)  # 960 us at 1000 us/s, margin
    assert rig.horn() is Mode.RIGID


@pytest.mark.parametrize("bit", range(6))
def test_a_serial_error_repeats_the_command(rig: MaestroRig, bit: int) -> None:
    rig.driver.open()
    rig.controller.set_errors(1 << bit)
    rig.driver.set_pulse(1500.0)
    assert bytes(rig.controller.received).count(bytes((0x84, 2, 0x70, 0x2E))) == 2
    assert rig.controller.output_us() == 1500.0
    assert rig.driver.read().errors == ()


def test_errors_are_reported_once_in_words(rig: MaestroRig) -> None:
    rig.driver.open()
    rig.controller.set_errors(0b1_0000_0010)
    assert rig.driver.read().errors == ("serial overrun error", "script program counter error")
    assert rig.driver.read().errors == ()
    assert error_names(0) == ()


def test_a_channel_that_the_controller_lacks_is_a_driver_error(rig: MaestroRig) -> None:
    rig.controller.channel = 4
    with pytest.raises(DriverError, match="the controller reports serial protocol error"):
        rig.driver.set_pulse(1500.0)


@pytest.mark.parametrize(
    "noise", [b"\x70", b"\x17\x70", b"\x00", b"\x00\x00", b"\xff\xff\xff", b"\x70\x17\x70\x17", bytes(200)]
)
def test_garbage_before_an_answer_is_detected_and_the_request_repeated(rig: MaestroRig, noise: bytes) -> None:
    rig.driver.set_pulse(1500.0)
    rig.controller.add_noise(noise)
    assert rig.driver.read().pulse_us == 1500.0


def test_garbage_already_on_the_line_is_ignored(rig: MaestroRig) -> None:
    rig.driver.set_pulse(1500.0)
    rig.controller.say(b"\x00\x10" * 40)
    time.sleep(0.01)
    assert rig.driver.read().pulse_us == 1500.0


def test_persistent_garbage_is_a_fault_that_the_next_command_clears(rig: MaestroRig) -> None:
    rig.begin()
    rig.controller.add_noise(*(bytes((17 + i, 3 * i)) for i in range(8)))
    rig.session.command(Mode.RIGID)
    assert rig.session.state.phase is LockPhase.FAULT
    assert "no valid answer" in (rig.session.state.reason or "")
    rig.run(0.4)
    assert rig.travel(Mode.RIGID).phase is LockPhase.SETTLED


@pytest.mark.parametrize(
    ("late", "problem"), [({1}, None), ({1, 2, 4}, None), (range(1, 99), "the port accepts no bytes")]
)
def test_a_write_that_a_busy_computer_delays_is_repeated(
    rig: MaestroRig, late: Container[int], problem: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """pyserial writes, and reports a timeout if the thread was suspended after that."""
    rig.driver.open()
    write, writes = serial.Serial.write, itertools.count(1)

    def write_late(port: serial.Serial, data: bytes) -> int | None:
        written = write(port, data)
        if next(writes) in late:
            raise serial.SerialTimeoutException("Write timeout")
        return written

    monkeypatch.setattr(serial.Serial, "write", write_late)
    if problem is not None:
        with pytest.raises(DriverError, match=problem):
            rig.driver.set_pulse(1500.0)
        return
    rig.driver.set_pulse(1500.0)
    assert rig.controller.output_us() == 1500.0


def test_a_silent_controller_raises_a_driver_error_within_1_5_s(rig: MaestroRig) -> None:
    rig.driver.open()
    rig.controller.mute()
    started_s = time.monotonic()
    with pytest.raises(DriverError, match="no valid answer"):
        rig.driver.read()
    if time.monotonic() - started_s > 1.5:
        raise TooSlow("the driver waits for more than 1.5 s")
    rig.controller.mute(False)
    assert rig.driver.read().pulse_us is None


def test_an_unusable_port_is_a_driver_error(vary: Vary, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    for port in (file, tmp_path):
        driver = MaestroDriver(vary(maestro={"port": str(port)}))
        with pytest.raises(DriverError, match="cannot open") as caught:
            driver.open()
        assert caught.value.key == ("maestro", "port")
        assert "\n" not in str(caught.value)


def test_a_port_without_write_permission_is_a_driver_error(
    vary: Vary, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Tests may run as root, for whom every file is writable.
    monkeypatch.setattr("os.access", lambda path, mode: False)
    (tmp_path / "port").write_text("")
    with pytest.raises(DriverError, match="is not writable; add the user to the dialout group") as caught:
        MaestroDriver(vary(maestro={"port": str(tmp_path / "port")})).open()
    assert caught.value.key == ("maestro", "port")


def test_a_port_in_use_is_a_driver_error(rig: MaestroRig) -> None:
    rig.driver.open()
    second = MaestroDriver(rig.config)
    with pytest.raises(DriverError, match="cannot open") as caught:
        second.open()
    assert caught.value.key == ("maestro", "port")
