"""One rig for each lock driver: the driver, its emulated hardware, and a session on a simulated clock."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from dart_flight.base.records import LockPhase, LockState, Mode
from dart_flight.config.vehicle import LockConfig, LockDriver
from dart_flight.lock.drivers import ActuatorLink, Driver, make_driver, pwm
from dart_flight.lock.drivers.mock import MockDriver, MockFaults
from dart_flight.lock.drivers.px4_output import actuator_pulse_us
from dart_flight.lock.lock_session import LockSession
from dart_flight.lock.servo import ServoModel, mode_of
from tests.doubles.emulated_maestro import EmulatedMaestro


class Rig:
    """A driver with its emulated hardware, and a session that is polled in simulated time.

    Attributes:
        KIND: kind of the driver.
        POLL_US: period of the polls.
        READS_BACK: whether the hardware reports its present output.
        MISSING: part of the message and configuration key if the hardware is missing.
        states: states of the session, in order.
    """

    KIND: LockDriver
    POLL_US = 20_000
    READS_BACK = True
    MISSING: tuple[str, tuple[str, ...]] | None = None

    t_us = 1_000_000

    def __init__(self, config: LockConfig) -> None:
        self.config = config
        self.states: list[LockState] = []
        self.driver = self.make_driver()
        self.session = LockSession(config, self.driver, self.clock_us, self.states.append)

    def clock_us(self) -> int:
        return self.t_us

    def make_driver(self) -> Driver:
        """Return a driver of this hardware, like that of another process."""
        return make_driver(self.config, self.KIND, clock_us=self.clock_us)

    def run(self, seconds: float) -> LockState:
        """Poll the session for some time."""
        for _ in range(round(seconds * 1e6 / self.POLL_US)):
            self.t_us += self.POLL_US
            self.session.poll()
        return self.session.state

    def begin(self, seconds: float = 0.4) -> LockState:
        """Start the session, permit locking and poll it for some time."""
        self.session.start()
        self.session.permit(True)
        return self.run(seconds)

    def travel(self, mode: Mode, seconds: float = 0.4) -> LockState:
        """Command a mode and poll the session for some time."""
        self.session.command(mode)
        return self.run(seconds)

    @property
    def state(self) -> LockState:
        """Present state of the session."""
        return self.session.state

    @property
    def fault(self) -> str | None:
        """The reason of the session's fault, or None without a fault."""
        return self.state.reason if self.state.phase is LockPhase.FAULT else None

    def horn(self) -> Mode | None:
        """Return the mode of the modelled horn."""
        return mode_of(self.config.servo, self.horn_us())

    def horn_us(self) -> float:
        """Return the position of the modelled horn."""
        raise NotImplementedError

    def output_us(self) -> float | None:
        """Return the pulse width that the hardware puts out, or None without pulses."""
        raise NotImplementedError

    def lose_pulse(self) -> None:
        """Make the hardware stop its pulses, as after a brown-out."""
        raise NotImplementedError

    def disconnect(self) -> None:
        """Take the hardware away."""
        raise NotImplementedError

    def reconnect(self) -> None:
        """Bring the hardware back."""
        raise NotImplementedError

    def free(self) -> None:
        """Free the emulated hardware."""


class MockRig(Rig):
    """The modelled servo."""

    KIND = LockDriver.MOCK

    def __init__(
        self, config: LockConfig, faults: MockFaults | None = None, pulse_us: float | None = None
    ) -> None:
        self.mock = MockDriver(config, self.clock_us, faults=faults, pulse_us=pulse_us)
        super().__init__(config)

    def make_driver(self) -> Driver:
        return self.mock

    def horn_us(self) -> float:
        return self.mock.horn_pulse_us(self.t_us)

    def output_us(self) -> float | None:
        plugged = not self.mock.faults.unplugged
        return self.mock.read().pulse_us if plugged else self.config.servo.flexible_pulse_us

    def lose_pulse(self) -> None:
        self.mock.release()

    def disconnect(self) -> None:
        self.mock.inject(MockFaults(unplugged=True))

    def reconnect(self) -> None:
        self.mock.inject(MockFaults())


class MaestroRig(Rig):
    """The serial driver and an emulated Maestro; bytes are exchanged in real time."""

    KIND = LockDriver.MAESTRO
    MISSING = ("does not exist", ("maestro", "port"))

    def __init__(self, config: LockConfig, folder: Path) -> None:
        # A real controller answers within 1 ms, but a test computer may be busy.
        maestro = msgspec.structs.replace(config.maestro, port=str(folder / "maestro"), reply_timeout_s=0.2)
        config = msgspec.structs.replace(config, driver=self.KIND, maestro=maestro)
        self.controller = EmulatedMaestro(
            config.servo, folder / "maestro", self.clock_us, channel=maestro.channel, horn_us=1300.0
        )
        self.controller.plug()
        super().__init__(config)

    def horn_us(self) -> float:
        return self.controller.horn_us()

    def output_us(self) -> float | None:
        return self.controller.output_us()

    def lose_pulse(self) -> None:
        self.controller.restart()

    def disconnect(self) -> None:
        self.controller.unplug()

    def reconnect(self) -> None:
        self.controller.plug()

    def free(self) -> None:
        self.driver.close()
        self.controller.__exit__(None, None, None)


class Sysfs:
    """An imitation of `/sys/class/pwm` that enforces the kernel's rules and records every write.

    The rules are those of older kernels, which validate the whole state at every write.
    """

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch, *, exported: bool = True) -> None:
        self.root, self.chip = root, root / "pwmchip0"
        self.channel = self.chip / "pwm1"
        self.writes: list[tuple[str, bytes]] = []
        self.chip.mkdir()
        for name, content in (("npwm", "2\n"), ("export", ""), ("unexport", "")):
            (self.chip / name).write_text(content)
        if exported:
            self.export_channel()
        self._real = pwm.write_attribute
        monkeypatch.setattr(pwm, "write_attribute", self._write)

    def export_channel(self) -> None:
        """Create the channel."""
        self.channel.mkdir()
        self.set(period="0", duty_cycle="0", polarity="normal", enable="0")

    def set(self, **values: str) -> None:
        """Set attributes of the channel, as another program does."""
        for name, value in values.items():
            (self.channel / name).write_text(f"{value}\n")

    def value(self, name: str) -> str:
        """Return an attribute of the channel."""
        return (self.channel / name).read_text().strip()

    def _write(self, path: Path, text: str) -> None:
        name = str(path.relative_to(self.chip))
        before = path.read_bytes()
        self._real(path, text)  # real system calls on the imitated file
        self.writes.append((name, path.read_bytes()))
        if path.parent == self.channel:
            path.write_text(text + "\n")  # sysfs appends a newline to every value
            problem = self._error_number(path.name)
            if problem:
                path.write_bytes(before)
                raise OSError(problem, os.strerror(problem))

    def _error_number(self, name: str) -> int:
        period, duty = int(self.value("period")), int(self.value("duty_cycle"))
        if name == "polarity" and self.value("enable") == "1":
            return errno.EBUSY
        return errno.EINVAL if period == 0 or duty > period else 0


class PwmRig(Rig):
    """The sysfs driver and an imitated chip."""

    KIND = LockDriver.PWM
    MISSING = ("pwmchip0 does not exist; check dtoverlay=pwm-2chan", ("pwm", "chip"))

    def __init__(self, config: LockConfig, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sysfs, self._aside = Sysfs(folder, monkeypatch), folder / "aside"
        keys = msgspec.structs.replace(config.pwm, sysfs_dir=str(folder), chip=0, channel=1)
        super().__init__(msgspec.structs.replace(config, driver=self.KIND, pwm=keys))
        self._servo = ServoModel(config.servo, config.servo.flexible_pulse_us)

    def run(self, seconds: float) -> LockState:
        self._servo.command(self.t_us, self.output_us())
        return super().run(seconds)

    def horn_us(self) -> float:
        return self._servo.pulse_at(self.t_us)

    def output_us(self) -> float | None:
        on = self.sysfs.channel.exists() and self.sysfs.value("enable") == "1"
        return int(self.sysfs.value("duty_cycle")) / 1e3 if on else None

    def lose_pulse(self) -> None:
        self.sysfs.set(enable="0")

    def disconnect(self) -> None:
        shutil.move(self.sysfs.chip, self._aside)

    def reconnect(self) -> None:
        shutil.move(self._aside, self.sysfs.chip)


class Px4Rig(Rig):
    """The driver for PX4's output, whose commands move a modelled servo; PX4 reports no output."""

    KIND = LockDriver.PX4
    READS_BACK = False

    def __init__(self, config: LockConfig) -> None:
        self.sent: list[tuple[int, float]] = []
        self._connected = True
        self._servo = ServoModel(config.servo, config.servo.flexible_pulse_us)
        super().__init__(msgspec.structs.replace(config, driver=self.KIND))

    def make_driver(self) -> Driver:
        return make_driver(self.config, self.KIND, link=ActuatorLink(self._set_actuator, None))

    def _set_actuator(self, index: int, value: float) -> None:
        if not self._connected:
            raise TimeoutError("no answer")
        self.sent.append((index, value))
        self._servo.command(self.t_us, self.output_us())

    def horn_us(self) -> float:
        return self._servo.pulse_at(self.t_us)

    def output_us(self) -> float | None:
        return actuator_pulse_us(self.config, self.sent[-1][1]) if self.sent else None

    def disconnect(self) -> None:
        self._connected = False

    def reconnect(self) -> None:
        self._connected = True


RIGS: dict[LockDriver, Callable[..., Rig]] = {
    LockDriver.MOCK: lambda config, folder, patch: MockRig(config),
    LockDriver.MAESTRO: lambda config, folder, patch: MaestroRig(config, folder),
    LockDriver.PWM: PwmRig,
    LockDriver.PX4: lambda config, folder, patch: Px4Rig(config),
}
MakeRig = Callable[..., Any]
Vary = Callable[..., LockConfig]
