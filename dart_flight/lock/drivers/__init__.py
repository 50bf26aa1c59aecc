"""What moves the servo: one interface, and one file per driver.

Calls may block for some tens of milliseconds: a shell makes them in a thread of its own. Every failure of
the hardware is a `DriverError`; nothing else comes out of a driver. After one the driver is still usable:
the next call tries to reach the hardware again, so a cable may be pulled and put back.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from dart_flight.config.document import Key
from dart_flight.config.vehicle import LockConfig, LockDriver
from dart_flight.lock.state_machine import DriverReading

if TYPE_CHECKING:
    from dart_flight.lock.drivers.mock import MockFaults

SetActuator = Callable[[int, float], None]


class DriverError(Exception):
    """The hardware cannot be reached or did not do what it was told.

    Attributes:
        key: the configuration key below `lock` it concerns, where the configuration may be at fault.
    """

    def __init__(self, message: str, key: Key = ()) -> None:
        super().__init__(" ".join(message.split()))
        self.key = key


@runtime_checkable
class Driver(Protocol):
    """What every driver offers. All methods raise `DriverError` and nothing else."""

    def open(self) -> None:
        """Reach the hardware; moves nothing. Calling it again is harmless."""

    def set_pulse(self, pulse_us: float) -> None:
        """Put out this pulse width in us; returns once the hardware has it."""

    def release(self) -> None:
        """Switch the pulses off."""

    def read(self) -> DriverReading:
        """What the hardware puts out and what the limit switches say."""

    def close(self) -> None:
        """Let go of the hardware; the pulses stay as they are."""


def make_driver(
    config: LockConfig,
    kind: LockDriver | None = None,
    *,
    clock_us: Callable[[], int] | None = None,
    set_actuator: SetActuator | None = None,
    mock_faults: MockFaults | None = None,
) -> Driver:
    """The driver of a kind (default: the configured one), with the limit switch where one is configured.

    Args:
        config: the lock's configuration.
        kind: which driver.
        clock_us: time base of the mock, microseconds; needed for it only.
        set_actuator: `set_actuator(index, value)` with value from -1 to 1, for the px4 driver: the shell's,
            which has the connection. It blocks until sent and may raise anything.
        mock_faults: what is wrong with the mock's servo from the start on.

    Raises:
        ValueError: the argument that this kind needs is missing.
        DriverError: a limit switch is configured and cannot be had.
    """
    kind = config.driver if kind is None else kind
    if kind is LockDriver.MOCK:
        from dart_flight.lock.drivers.mock import MockDriver  # noqa: PLC0415

        if clock_us is None:
            raise ValueError("the mock driver needs clock_us")
        return MockDriver(config, clock_us, faults=mock_faults)
    driver: Driver
    if kind is LockDriver.MAESTRO:
        # Imported here: pyserial is not needed by the other drivers.
        from dart_flight.lock.drivers.maestro import MaestroDriver  # noqa: PLC0415

        driver = MaestroDriver(config)
    elif kind is LockDriver.PWM:
        from dart_flight.lock.drivers.pwm import PwmDriver  # noqa: PLC0415

        driver = PwmDriver(config)
    else:
        from dart_flight.lock.drivers.px4 import Px4Driver  # noqa: PLC0415

        if set_actuator is None:
            raise ValueError("the px4 driver needs set_actuator")
        driver = Px4Driver(config, set_actuator)
    if config.limit_switch is None:
        return driver
    from dart_flight.lock.drivers.limit_switch import GpioLimitSwitch, WithLimitSwitch  # noqa: PLC0415

    return WithLimitSwitch(driver, GpioLimitSwitch(config.limit_switch))
