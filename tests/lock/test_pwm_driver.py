"""The sysfs driver on a directory tree that imitates the kernel's, byte for byte."""

from __future__ import annotations

import shutil
import threading
import time
from pathlib import Path

import pytest

from dart_flight.config.vehicle import LockConfig, LockDriver
from dart_flight.lock.drivers import DriverError, pwm
from dart_flight.lock.drivers.pwm import PwmDriver
from tests.lock.rigs import Sysfs, Vary

DATA = Path(__file__).parents[1] / "data"


@pytest.fixture(autouse=True)
def _short_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait only briefly for a channel that does not appear."""
    monkeypatch.setattr(pwm, "_APPEAR_S", 0.2)


@pytest.fixture
def sysfs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sysfs:
    return Sysfs(tmp_path, monkeypatch)


@pytest.fixture
def config(vary: Vary, tmp_path: Path) -> LockConfig:
    return vary(driver=LockDriver.PWM, pwm={"sysfs_dir": str(tmp_path), "chip": 0, "channel": 1})


def test_the_driver_writes_the_expected_bytes(config: LockConfig, sysfs: Sysfs) -> None:
    driver = PwmDriver(config)
    driver.open()
    driver.open()
    assert driver.read().pulse_us is None
    driver.set_pulse(1980.0)
    assert driver.read().pulse_us == 1980.0
    driver.set_pulse(1020.25)
    assert driver.read().pulse_us == 1020.25
    driver.release()
    driver.release()
    assert driver.read().pulse_us is None
    driver.close()
    assert sysfs.writes == [
        ("pwm1/period", b"20000000"),
        ("pwm1/duty_cycle", b"1980000"),
        ("pwm1/enable", b"1"),
        ("pwm1/duty_cycle", b"1020250"),
        ("pwm1/enable", b"0"),
    ]
    assert (sysfs.chip / "unexport").read_bytes() == b""


def test_the_driver_waits_for_the_exported_channel(
    config: LockConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sysfs = Sysfs(tmp_path, monkeypatch, exported=False)

    def export_after_first_write() -> None:
        while not sysfs.writes:
            time.sleep(0.001)
        sysfs.export_channel()

    thread = threading.Thread(target=export_after_first_write, daemon=True)
    thread.start()
    PwmDriver(config).set_pulse(1500.0)
    thread.join()
    assert sysfs.writes == [
        ("export", b"1"),
        ("pwm1/period", b"20000000"),
        ("pwm1/duty_cycle", b"1500000"),
        ("pwm1/enable", b"1"),
    ]


STARTED = {"period": "20000000", "duty_cycle": "1980000", "polarity": "normal", "enable": "1"}


@pytest.mark.parametrize(
    ("found", "written"),
    [
        (STARTED, []),  # adopted without a glitch
        (  # the kernel refuses the polarity of a running channel
            STARTED | {"polarity": "inversed"},
            [("pwm1/enable", b"0"), ("pwm1/polarity", b"normal")],
        ),
        (
            {"period": "50000000", "duty_cycle": "30000000", "polarity": "inversed", "enable": "1"},
            [
                ("pwm1/enable", b"0"),
                ("pwm1/duty_cycle", b"0"),
                ("pwm1/period", b"20000000"),
                ("pwm1/polarity", b"normal"),
            ],
        ),
    ],
)
def test_opening_corrects_a_running_channel_only_as_far_as_needed(
    config: LockConfig, sysfs: Sysfs, found: dict[str, str], written: list[tuple[str, bytes]]
) -> None:
    sysfs.set(**found)
    driver = PwmDriver(config)
    driver.open()
    assert driver.read().pulse_us == (None if written else 1980.0)
    assert sysfs.writes == written


def test_damaged_sysfs_entries_are_reported(
    vary: Vary, config: LockConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sysfs = Sysfs(tmp_path, monkeypatch, exported=False)
    with pytest.raises(DriverError, match="pwmchip0 has 2 channels, numbered from 0") as caught:
        PwmDriver(vary(pwm={"sysfs_dir": str(tmp_path), "chip": 0, "channel": 2})).open()
    assert caught.value.key == ("pwm", "channel")
    with pytest.raises(DriverError, match="pwm1 did not appear"):
        PwmDriver(config).open()
    sysfs.export_channel()
    sysfs.set(period="garbage")
    with pytest.raises(DriverError, match="period contains 'garbage', not a number"):
        PwmDriver(config).open()
    (sysfs.channel / "period").unlink()
    with pytest.raises(DriverError, match="cannot read"):
        PwmDriver(config).open()


@pytest.mark.usefixtures("sysfs")
def test_a_channel_without_write_permission_is_a_driver_error(
    config: LockConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.access", lambda path, mode: False)  # as for any user but root
    with pytest.raises(DriverError, match="pwm1 is not writable; add the user to the gpio group"):
        PwmDriver(config).open()


@pytest.mark.usefixtures("sysfs")
def test_a_write_refused_by_the_kernel_is_a_driver_error(config: LockConfig) -> None:
    driver = PwmDriver(config)
    driver.open()
    with pytest.raises(DriverError, match=r"cannot write 30000000 to .*duty_cycle: Invalid argument"):
        driver.set_pulse(30_000.0)


# --- choice of chip and channel ------------------------------------------------------------------------


@pytest.fixture
def pi5(tmp_path: Path) -> Path:
    """The sysfs tree of a Raspberry Pi 5 with kernel 6.12, where GPIO 18 is the third of four channels."""
    return shutil.copytree(DATA / "pi5_pwm", tmp_path / "sysfs", symlinks=True)


def start_pulses(sysfs: Path, vary: Vary, **keys: int | None) -> PwmDriver:
    driver = PwmDriver(vary(driver=LockDriver.PWM, pwm={"sysfs_dir": str(sysfs), **keys}))
    driver.set_pulse(1500.0)
    return driver


def convert_to_board(sysfs: Path, device: str, number: int, channels: int) -> None:
    """Turn the tree into that of another board or kernel."""
    chip = (sysfs / "pwmchip0").rename(sysfs / f"pwmchip{number}")
    (chip / "device").unlink()
    (chip / "device").symlink_to(f"../../platform/{device}")
    (chip / "npwm").write_text(f"{channels}\n")


@pytest.mark.parametrize("keys", [{}, {"channel": 2}, {"chip": 0}, {"chip": 0, "channel": 2}])
def test_gpio_18_is_the_third_channel_of_a_pi_5(pi5: Path, vary: Vary, keys: dict[str, int]) -> None:
    start_pulses(pi5, vary, **keys)
    assert (pi5 / "pwmchip0" / "pwm2" / "duty_cycle").read_text() == "1500000"
    assert (pi5 / "pwmchip0" / "pwm0" / "duty_cycle").read_text() == "0\n"


@pytest.mark.parametrize("channel", [0, 1])
def test_the_channels_of_other_pins_are_refused_on_a_pi_5(pi5: Path, vary: Vary, channel: int) -> None:
    with pytest.raises(DriverError, match="GPIO 18 is channel 2 on a Raspberry Pi 5, not") as caught:
        start_pulses(pi5, vary, chip=0, channel=channel)
    assert caught.value.key == ("pwm", "channel")
    assert (pi5 / "pwmchip0" / "pwm0" / "enable").read_text() == "0\n"


def test_the_chip_is_found_under_any_number(pi5: Path, vary: Vary) -> None:
    """Kernel 6.6 numbers the chip 2, and the fan has a chip as well."""
    convert_to_board(pi5, "1f00098000.pwm", 2, 4)
    fan = pi5 / "pwmchip0"
    fan.mkdir()
    (fan / "device").symlink_to("../../platform/1f0009c000.pwm")
    (fan / "npwm").write_text("4\n")
    start_pulses(pi5, vary)
    assert (pi5 / "pwmchip2" / "pwm2" / "duty_cycle").read_text() == "1500000"


@pytest.mark.parametrize("device", ["fe20c000.pwm", "3f20c000.pwm"])
def test_gpio_18_is_the_first_channel_of_an_older_pi(pi5: Path, vary: Vary, device: str) -> None:
    convert_to_board(pi5, device, 0, 2)
    start_pulses(pi5, vary)
    assert (pi5 / "pwmchip0" / "pwm0" / "duty_cycle").read_text() == "1500000"


def test_the_chip_and_channel_of_another_board_must_be_configured(pi5: Path, vary: Vary) -> None:
    convert_to_board(pi5, "2000000.pwm", 0, 2)
    with pytest.raises(DriverError, match=r"no PWM chip of a Raspberry Pi in .* \(found pwmchip0"):
        start_pulses(pi5, vary)
    with pytest.raises(DriverError, match="set the servo's channel"):
        start_pulses(pi5, vary, chip=0)
    start_pulses(pi5, vary, chip=0, channel=0)
    assert (pi5 / "pwmchip0" / "pwm0" / "enable").read_text() == "1"
