"""What moves the servo: one interface, one file per driver, one table of them (docs/extending.md).

Calls may block for some tens of milliseconds: a shell makes them in a thread of its own. Every failure of
the hardware is a `DriverError`; nothing else comes out of a driver. After one the driver is still usable:
the next call tries to reach the hardware again, so a cable may be pulled and put back.
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


class DriverEntry(NamedTuple):
    """One kind of driver.

    Attributes:
        path: `module:class` beside this file, imported when the driver is made: pyserial is for one of them.
        words: what moves the servo, for people.
        needs: what it is made with beside the configuration: arguments of `make_driver`, by name.
        takes: likewise, what it can be made without.
        simulated: whether it has a place in simulated time.
        moves: whether anything real moves.
        reads_switches: whether its readings have the limit switches; else GPIO lines are put around it.
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
    """The names of some drivers in words: `maestro, pwm or px4`."""
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
    """The driver of a kind (default: the configured one), with the limit switch where one is configured.

    Args:
        config: the lock's configuration.
        kind: which driver.
        clock_us: time base of the mock, microseconds; needed for it only.
        set_actuator: `set_actuator(index, value)` with value from -1 to 1, for the px4 driver: the shell's,
            which has the connection. It blocks until sent and may raise anything.
        faults: what is wrong with the mock's servo from the start on.
        gpio: False: without the limit switches, where there is no hardware.

    Raises:
        ValueError: the argument that this kind needs is missing.
        DriverError: a limit switch is configured and cannot be had.
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
