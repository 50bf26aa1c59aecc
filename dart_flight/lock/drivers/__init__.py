"""Drivers of the lock's servo: one interface, one file per driver, and a table of the drivers.

Calls may block for some tens of milliseconds, so the caller makes them in a separate thread. A driver raises
only `DriverError`, for any failure of the hardware. The driver stays usable afterwards: the next call tries
to reach the hardware again, so a cable may be unplugged and reconnected. docs/extending.md describes how to
add a driver.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol, runtime_checkable

from dart_flight.config.document import Key
from dart_flight.config.vehicle import LockConfig, LockDriver
from dart_flight.lock.state_machine import DriverReading

if TYPE_CHECKING:
    from dart_flight.lock.drivers.mock import MockFaults

SetActuator = Callable[[int, float], None]


class DriverError(Exception):
    """The hardware cannot be reached or did not execute a command.

    Attributes:
        key: configuration key below `lock` that may be wrong, or empty.
    """

    def __init__(self, message: str, key: Key = ()) -> None:
        super().__init__(" ".join(message.split()))
        self.key = key


@runtime_checkable
class Driver(Protocol):
    """Interface of every driver. All methods raise `DriverError` and nothing else."""

    def open(self) -> None:
        """Connect to the hardware without moving anything; may be called again."""

    def set_pulse(self, pulse_us: float) -> None:
        """Output this pulse width in us; return after the hardware has received the pulse width."""

    def release(self) -> None:
        """Switch the pulses off."""

    def read(self) -> DriverReading:
        """Return the present output and the state of the limit switches."""

    def close(self) -> None:
        """Release the hardware; the pulses stay as they are."""


class DriverEntry(NamedTuple):
    """One kind of driver.

    Attributes:
        path: `module:class`, with the module in this package. The module is imported only when the driver is
            made, because a driver may need an optional package (pyserial).
        words: description of the driver for people.
        needs: names of the required arguments of `make_driver`, besides the configuration.
        takes: names of the optional arguments.
        simulated: whether the driver works in simulated time.
        moves: whether the driver moves real hardware.
        reads_switches: whether the driver's readings contain the limit switches. If not, the switches are
            read from GPIO lines.
    """

    path: str
    words: str
    needs: tuple[str, ...] = ()
    takes: tuple[str, ...] = ()
    simulated: bool = False
    moves: bool = True
    reads_switches: bool = False


DRIVERS: Final[Mapping[LockDriver, DriverEntry]] = {
    LockDriver.MAESTRO: DriverEntry("maestro:MaestroDriver", "a Pololu Maestro on a serial port"),
    LockDriver.PWM: DriverEntry("pwm:PwmDriver", "the Raspberry Pi's own PWM"),
    LockDriver.PX4: DriverEntry(
        "px4_output:Px4Driver", "an output of PX4", needs=("set_actuator",), simulated=True
    ),
    LockDriver.MOCK: DriverEntry(
        "mock:MockDriver",
        "a modelled servo",
        needs=("clock_us",),
        takes=("faults",),
        simulated=True,
        moves=False,
        reads_switches=True,
    ),
}
if set(DRIVERS) != set(LockDriver):
    raise TypeError(f"lock drivers without an entry in DRIVERS: {sorted(set(LockDriver) - set(DRIVERS))}")


def driver_names(chosen: Callable[[DriverEntry], bool]) -> str:
    """Return the names of the drivers for which `chosen` is True, as text: `maestro, pwm or px4`."""
    *first, last = [kind.value for kind, entry in DRIVERS.items() if chosen(entry)]
    return f"{', '.join(first)} or {last}" if first else last


def make_driver(
    config: LockConfig,
    kind: LockDriver | None = None,
    *,
    clock_us: Callable[[], int] | None = None,
    set_actuator: SetActuator | None = None,
    faults: MockFaults | None = None,
    gpio: bool = True,
) -> Driver:
    """Return a driver of the lock's servo. If a limit switch is configured, the driver also reads the switch.

    Args:
        config: the lock's configuration.
        kind: kind of driver; by default the configured kind.
        clock_us: time base of the mock, microseconds; required for the mock only.
        set_actuator: function `set_actuator(index, value)` with value from -1 to 1, for the px4 driver. The
            shell supplies this function, because the shell has the connection to PX4. The function blocks
            until the value is sent, and may raise any exception.
        faults: initial faults of the mock's servo.
        gpio: whether GPIO limit switches are read; False without hardware.

    Raises:
        ValueError: the argument that this kind needs is missing.
        DriverError: a limit switch is configured but not available.
    """
    kind = config.driver if kind is None else kind
    entry = DRIVERS[kind]
    offered = {"clock_us": clock_us, "set_actuator": set_actuator, "faults": faults}
    for name in entry.needs:
        if offered[name] is None:
            raise ValueError(f"the {kind.value} driver needs {name}")
    module, _, name = entry.path.partition(":")
    make = getattr(importlib.import_module(f"{__name__}.{module}"), name)
    driver: Driver = make(config, **{name: offered[name] for name in entry.needs + entry.takes})
    if config.limit_switch is None or entry.reads_switches or not gpio:
        return driver
    from dart_flight.lock.drivers.limit_switch import DriverWithLimitSwitch, GpioLimitSwitch  # noqa: PLC0415

    return DriverWithLimitSwitch(driver, GpioLimitSwitch(config.limit_switch))
