"""Hardware PWM of the Raspberry Pi through sysfs (kernel documentation, driver-api/pwm).

    pwmchipN/export              channel number: makes pwmchipN/pwmM appear
    pwmchipN/pwmM/period         ns, the whole frame
    pwmchipN/pwmM/duty_cycle     ns, the pulse; never longer than the period
    pwmchipN/pwmM/polarity       normal or inversed; can be written only while disabled
    pwmchipN/pwmM/enable         1 or 0

The PWM chip of a Raspberry Pi is identified by its device, because the chip's number depends on the kernel.
GPIO 18 has a different channel on a Raspberry Pi 5 (Pioreactor/rpi_hardware_pwm#10, raspberrypi/linux#6818).

The channel stays exported when the program ends, because unexporting it would stop the pulses.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

from dart_flight.config.link_url import device_key
from dart_flight.config.vehicle import LockConfig
from dart_flight.lock.drivers import DriverError
from dart_flight.lock.persistence import ServoDevice
from dart_flight.lock.state_machine import DriverReading


class _BoardPwm(NamedTuple):
    """A board, and the PWM channel that drives its GPIO 18."""

    board: str
    gpio18: int


_BOARDS: Final[Mapping[str, _BoardPwm]] = {  # keys: device names to which pwmchipN/device links
    "1f00098000.pwm": _BoardPwm("Raspberry Pi 5", 2),
    "fe20c000.pwm": _BoardPwm("Raspberry Pi 4", 0),
    "3f20c000.pwm": _BoardPwm("Raspberry Pi 3", 0),
}
_APPEAR_S = 1.0  # longest wait for udev to give the new files to their group


def write_attribute(path: Path, text: str) -> None:
    """Write a sysfs attribute in one system call. The file must exist already."""
    descriptor = os.open(path, os.O_WRONLY | os.O_TRUNC | os.O_CLOEXEC)
    try:
        os.write(descriptor, text.encode())
    finally:
        os.close(descriptor)


class PwmDriver:
    """One channel of a PWM chip."""

    def __init__(self, config: LockConfig) -> None:
        self._config = config.pwm
        self._sysfs = Path(config.pwm.sysfs_dir)
        self._chip = self._channel = self._sysfs  # replaced by `_find`
        self._period_ns = round(config.pwm.period_us * 1000.0)

    def device(self) -> ServoDevice:
        self._find()
        chip, channel = self._chip, self._channel.name.removeprefix("pwm")
        return ServoDevice(f"{device_key(chip)}-{channel}", f"{chip.name}, channel {channel}")

    def open(self) -> None:
        """Export the channel, and correct its period and polarity.

        Raises:
            DriverError: the chip or the channel does not exist, is not writable, or rejects a value. The
                error's `key` is the configuration key of the chip or of the channel.
        """
        if not (self._channel / "enable").exists():
            self._find()
            if not self._channel.is_dir():
                self._write(self._chip / "export", self._channel.name.removeprefix("pwm"))
        self._wait_until_writable()
        if self._number(self._channel / "period") != self._period_ns:
            # Older kernels reject every write while the period is 0 or shorter than the pulse.
            self._stop()
            if self._number(self._channel / "duty_cycle") > self._period_ns:
                self._write(self._channel / "duty_cycle", "0")
            self._write(self._channel / "period", str(self._period_ns))
        if self._text("polarity") != "normal":
            self._stop()
            self._write(self._channel / "polarity", "normal")

    def set_pulse(self, pulse_us: float) -> None:
        self.open()
        self._write(self._channel / "duty_cycle", str(round(pulse_us * 1000.0)))
        if self._text("enable") != "1":
            self._write(self._channel / "enable", "1")

    def release(self) -> None:
        self.open()
        self._stop()

    def read(self) -> DriverReading:
        self.open()
        if self._text("enable") != "1":
            return DriverReading(pulse_us=None)
        return DriverReading(pulse_us=self._number(self._channel / "duty_cycle") / 1000.0)

    def close(self) -> None:
        """Do nothing: the pulses continue, and no file is open."""

    def _find(self) -> None:
        """Find chip and channel; write nothing."""
        self._chip = self._find_chip()
        board = _BOARDS.get(_device(self._chip))
        channel = self._config.channel
        if channel is None:
            if board is None:
                message = f"{self._chip.name} is not a PWM chip of a Raspberry Pi: set the servo's channel"
                raise DriverError(message, ("pwm", "channel"))
            channel = board.gpio18
        if board is not None and channel < board.gpio18:
            right = board.gpio18
            message = (
                f"GPIO 18 is channel {right} on a {board.board}, not {channel}: set the channel to {right} "
                "or null"
            )
            raise DriverError(message, ("pwm", "channel"))
        has = self._number(self._chip / "npwm")
        if channel >= has:
            raise DriverError(f"{self._chip.name} has {has} channels, numbered from 0", ("pwm", "channel"))
        self._channel = self._chip / f"pwm{channel}"

    def _find_chip(self) -> Path:
        hint = "check dtoverlay=pwm-2chan in config.txt"
        if self._config.chip is None:
            chips = sorted(self._sysfs.glob("pwmchip*"))
            for chip in chips:
                if _device(chip) in _BOARDS:
                    return chip
            seen = ", ".join(chip.name for chip in chips) or "no chip"
            message = f"there is no PWM chip of a Raspberry Pi in {self._sysfs} (found {seen}); {hint}."
            raise DriverError(f"{message} On other computers, set chip and channel", ("pwm", "chip"))
        chip = self._sysfs / f"pwmchip{self._config.chip}"
        if not chip.is_dir():
            raise DriverError(f"{chip} does not exist; {hint}", ("pwm", "chip"))
        return chip

    # -- files --

    def _stop(self) -> None:
        if self._text("enable") != "0":
            self._write(self._channel / "enable", "0")

    def _wait_until_writable(self) -> None:
        give_up = time.monotonic() + _APPEAR_S
        while not os.access(self._channel / "enable", os.W_OK):
            if time.monotonic() > give_up:
                appeared = self._channel.is_dir()
                what = "is not writable; add the user to the gpio group" if appeared else "did not appear"
                raise DriverError(f"{self._channel} {what}", ("pwm", "channel"))
            time.sleep(0.005)

    def _write(self, path: Path, text: str) -> None:
        try:
            write_attribute(path, text)
        except OSError as error:
            reason = f"cannot write {text} to {path}: {error.strerror}"
            raise DriverError(reason, ("pwm", "chip")) from None

    def _text(self, name: str) -> str:
        return self._read(self._channel / name)

    def _number(self, path: Path) -> int:
        text = self._read(path)
        try:
            return int(text)
        except ValueError:
            raise DriverError(f"{path} contains {text!r}, not a number", ("pwm", "chip")) from None

    @staticmethod
    def _read(path: Path) -> str:
        try:
            return path.read_text().strip()
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise DriverError(f"cannot read {path}: {reason}", ("pwm", "chip")) from None


def _device(chip: Path) -> str:
    """Return the name of a chip's device, such as `1f00098000.pwm`; empty if unreadable."""
    link = chip / "device"
    try:
        return os.path.basename(os.readlink(link) if link.is_symlink() else link.read_text().strip())
    except (OSError, UnicodeDecodeError):
        return ""
