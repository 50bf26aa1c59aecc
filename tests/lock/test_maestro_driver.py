"""The serial driver and an emulated Maestro behind a pseudo-terminal: real pyserial, real bytes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dart_flight.base.records import LockPhase, LockState, Mode
from dart_flight.config.vehicle import LockConfig, LockDriver, LockStartup
from dart_flight.lock.drivers import Driver, DriverError, make_driver
from dart_flight.lock.drivers.maestro import MaestroDriver, error_names
from dart_flight.lock.lock_session import LockSession
from dart_flight.lock.servo import ServoFaults, mode_of
from tests.doubles.emulated_maestro import EmulatedMaestro

Vary = Callable[..., LockConfig]


class Rig:
    """An emulated controller and its driver on a simulated clock; bytes are exchanged in real time."""

    def __init__(self, config: LockConfig, controller: EmulatedMaestro, clock: list[int]) -> None:
        self.config, self.controller, self._clock = config, controller, clock
        self.driver = MaestroDriver(config)
        self.states: list[LockState] = []
        self.session = LockSession(config, self.driver, lambda: clock[0], self.states.append)

    @property
    def t_us(self) -> int:
        return self._clock[0]

    def run(self, seconds: float) -> LockState:
        for _ in range(round(seconds * 50)):
            self._clock[0] += 20_000
            self.session.poll()
        return self.session.state

    def horn(self) -> Mode | None:
        return mode_of(self.config.servo, self.controller.horn_us())


MakeRig = Callable[..., Rig]


@pytest.fixture
def make_rig(vary: Vary, tmp_path: Path) -> Iterator[MakeRig]:
    open_rigs: list[Rig] = []

    def make(speed_limit_us_s: float = 0.0, channel: int = 2, **changes: object) -> Rig:
        link = tmp_path / "maestro"
        maestro = {
            "port": str(link),
            "channel": channel,
            "speed_limit_us_s": speed_limit_us_s,
            "reply_timeout_s": 0.2,  # allows for a busy test computer; a real controller answers within 1 ms
        }
        config = vary(driver=LockDriver.MAESTRO, maestro=maestro, **changes)
        clock = [1_000_000]
        controller = EmulatedMaestro(config.servo, link, lambda: clock[0], channel=channel, horn_us=1300.0)
        controller.plug()
        rig = Rig(config, controller, clock)
        open_rigs.append(rig)
        return rig

    yield make
    for rig in open_rigs:
        rig.driver.close()
        rig.controller.unplug()


def test_the_bytes_on_the_wire_match_the_maestros_protocol(make_rig: MakeRig) -> None:
    rig = make_rig(speed_limit_us_s=1000.0, channel=5)
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


def test_toggles_move_the_modelled_servo_within_the_travel_time(make_rig: MakeRig) -> None:
    rig = make_rig()
    assert isinstance(make_driver(rig.config), Driver)
    rig.session.start()
    rig.session.permit(True)
    assert rig.run(0.4).mode is Mode.FLEXIBLE
    for mode in (Mode.RIGID, Mode.FLEXIBLE, Mode.RIGID):
        started_us = rig.t_us
        rig.session.command(mode)
        state = rig.run(0.4)
        assert (state.phase, state.mode, state.feedback) == (LockPhase.SETTLED, mode, False)
        assert rig.horn() is mode
        assert state.settled_us is not None
        assert 315_000 <= state.settled_us - started_us <= 335_000


def test_the_lock_settles_only_after_the_speed_limited_travel(make_rig: MakeRig) -> None:
    rig = make_rig(speed_limit_us_s=1000.0)
    rig.session.start()
    rig.session.permit(True)
    rig.run(1.2)
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
def test_a_serial_error_repeats_the_command(make_rig: MakeRig, bit: int) -> None:
    rig = make_rig()
    rig.driver.open()
    rig.controller.set_errors(1 << bit)
    rig.driver.set_pulse(1500.0)
    assert bytes(rig.controller.received).count(bytes((0x84, 2, 0x70, 0x2E))) == 2
    assert rig.controller.output_us() == 1500.0
    assert rig.driver.read().errors == ()


def test_errors_are_reported_once_in_words(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.driver.open()
    rig.controller.set_errors(0b1_0000_0010)
    assert rig.driver.read().errors == ("serial overrun error", "script program counter error")
    assert rig.driver.read().errors == ()
    assert error_names(0) == ()


def test_a_channel_that_the_controller_lacks_is_a_driver_error(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.controller.channel = 4
    with pytest.raises(DriverError, match="the controller reports serial protocol error"):
        rig.driver.set_pulse(1500.0)


@pytest.mark.parametrize(
    "noise", [b"\x70", b"\x17\x70", b"\x00", b"\x00\x00", b"\xff\xff\xff", b"\x70\x17\x70\x17", bytes(200)]
)
def test_garbage_before_an_answer_is_detected_and_the_request_repeated(
    make_rig: MakeRig, noise: bytes
) -> None:
    rig = make_rig()
    rig.driver.set_pulse(1500.0)
    rig.controller.add_noise(noise)
    assert rig.driver.read().pulse_us == 1500.0


def test_garbage_already_on_the_line_is_ignored(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.driver.set_pulse(1500.0)
    rig.controller.say(b"\x00\x10" * 40)
    time.sleep(0.01)
    assert rig.driver.read().pulse_us == 1500.0


def test_persistent_garbage_is_a_fault_that_the_next_command_clears(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.session.start()
    rig.run(0.4)
    rig.session.permit(True)
    rig.controller.add_noise(*(bytes((17 + i, 3 * i)) for i in range(8)))
    rig.session.command(Mode.RIGID)
    assert rig.session.state.phase is LockPhase.FAULT
    assert "no valid answer" in (rig.session.state.reason or "")
    rig.run(0.4)
    rig.session.command(Mode.RIGID)
    assert rig.run(0.4).phase is LockPhase.SETTLED


def test_a_silent_controller_raises_a_driver_error_within_1_5_s(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.driver.open()
    rig.controller.mute()
    started_s = time.monotonic()
    with pytest.raises(DriverError, match="no valid answer"):
        rig.driver.read()
    assert time.monotonic() - started_s < 1.5
    rig.controller.mute(False)
    assert rig.driver.read().pulse_us is None


@pytest.mark.parametrize("power_too", [False, True])
def test_an_unplugged_controller_is_a_fault_and_works_when_replugged(
    make_rig: MakeRig, power_too: bool
) -> None:
    rig = make_rig(startup=LockStartup.ADOPT)
    rig.session.start()
    rig.session.permit(True)
    rig.session.command(Mode.RIGID)
    rig.run(0.1)
    rig.controller.unplug(power_too=power_too)
    state = rig.run(0.1)
    assert state.phase is LockPhase.FAULT
    assert str(rig.config.maestro.port) in (state.reason or "")
    assert rig.session.command(Mode.FLEXIBLE) is None  # still unplugged
    assert rig.session.state.phase is LockPhase.FAULT
    assert "does not exist" in (rig.session.state.reason or "")
    rig.controller.plug()
    assert rig.driver.read().pulse_us == (None if power_too else 1980.0)
    rig.session.command(Mode.FLEXIBLE)
    assert rig.run(0.4).phase is LockPhase.SETTLED
    assert rig.horn() is Mode.FLEXIBLE


def test_a_brown_out_is_detected_as_a_lost_pulse(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.session.start()
    rig.session.permit(True)
    rig.run(0.4)
    rig.session.command(Mode.RIGID)
    rig.run(0.1)
    rig.controller.restart()
    state = rig.run(0.1)
    assert (state.phase, state.reason) == (LockPhase.FAULT, "the controller lost the pulse")


def test_a_stalled_servo_is_invisible_to_the_controller(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.session.start()
    rig.session.permit(True)
    rig.run(0.4)
    rig.controller.set_servo_faults(ServoFaults(stall_fraction=0.5))
    rig.session.command(Mode.RIGID)
    state = rig.run(0.5)
    assert (state.phase, state.mode, state.feedback) == (LockPhase.SETTLED, Mode.RIGID, False)
    assert rig.horn() is None


def test_a_clamped_channel_range_is_a_fault(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.controller.limits_us = (992.0, 1900.0)
    rig.session.start()
    rig.session.permit(True)
    rig.run(0.4)
    rig.session.command(Mode.RIGID)
    state = rig.run(1.6)
    assert (state.phase, state.reason) == (
        LockPhase.FAULT,
        "the controller outputs 1900 us instead of 1980 us",
    )


def test_a_restart_adopts_the_controllers_current_pulse(make_rig: MakeRig) -> None:
    rig = make_rig(startup=LockStartup.ADOPT)
    rig.session.start()
    assert rig.session.state.reason == "the servo's position is unknown: its pulses are off"
    rig.session.permit(True)
    rig.session.command(Mode.RIGID)
    rig.run(0.4)
    rig.driver.close()  # like the end of the process
    restarted = LockSession(rig.config, rig.driver, lambda: rig.t_us)
    restarted.start()
    assert (restarted.state.phase, restarted.state.mode) == (LockPhase.TRAVELLING, Mode.RIGID)


def test_an_unusable_port_is_a_driver_error(vary: Vary, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    for port, expected in (
        (tmp_path / "nothing", "does not exist"),
        (file, "cannot open"),
        (tmp_path, "cannot open"),
    ):
        driver = MaestroDriver(vary(maestro={"port": str(port)}))
        with pytest.raises(DriverError, match=expected) as caught:
            driver.open()
        assert caught.value.key == ("maestro", "port")
        assert "\n" not in str(caught.value)


def test_a_port_without_write_permission_is_a_driver_error(
    vary: Vary, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Tests may run as root, for whom every file is writable.
    monkeypatch.setattr("os.access", lambda path, mode: False)
    (tmp_path / "port").write_text("")
    with pytest.raises(DriverError, match="is not writable; add the user to the group") as caught:
        MaestroDriver(vary(maestro={"port": str(tmp_path / "port")})).open()
    assert caught.value.key == ("maestro", "port")


def test_a_port_in_use_is_a_driver_error(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.driver.open()
    second = MaestroDriver(rig.config)
    with pytest.raises(DriverError, match="cannot open") as caught:
        second.open()
    assert caught.value.key == ("maestro", "port")
