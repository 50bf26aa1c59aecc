"""Drivers of the lock's servo: one interface, one file per driver, and a table of the drivers.

Calls may block for some tens of milliseconds, so the caller makes them in a separate thread. A driver raises
only `DriverError`, for any failure of the hardware. The driver stays usable after an error: the next call
tries to reach the hardware again, so a cable may be unplugged and reconnected. docs/extending.md explains how
to add a driver.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol, cast, runtime_checkable

from dart_flight.base.text import alternatives
from dart_flight.config.document import Key
from dart_flight.config.vehicle import LockConfig, LockDriver
from dart_flight.lock.persistence import ServoDevice, ServoOwnership
from dart_flight.lock.state_machine import DriverReading

if TYPE_CHECKING:
    from dart_flight.lock.drivers.mock import MockFaults

SetActuator = Callable[[int, float], None]


class ActuatorLink(NamedTuple):
    """The connection to PX4, for the `px4` driver.

    Attributes:
        set_actuator: function `set_actuator(index, value)` with value from -1 to 1. It blocks until the value
            is sent, and may raise any exception.
        url: URL of the connection, or None for an autopilot that this process simulates.
    """

    set_actuator: SetActuator
    url: str | None


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
    """Interface of every driver. The methods raise only `DriverError`."""

    def open(self) -> None:
        """Connect to the hardware without moving anything; may be called again."""

    def set_pulse(self, pulse_us: float) -> None:
        """Output this pulse width in us; return after the hardware has received it."""

    def release(self) -> None:
        """Switch the pulses off."""

    def read(self) -> DriverReading:
        """Return the current output and the state of the limit switches."""

    def close(self) -> None:
        """Release the hardware; the pulses stay as they are."""


class HardwareDriver(Driver, Protocol):
    """A driver that moves real hardware."""

    def device(self) -> ServoDevice | None:
        """Return the hardware that only one process at a time may use; None if this process simulates it.

        Nothing is opened or moved.
        """


class DriverEntry(NamedTuple):
    """One kind of driver.

    Attributes:
        path: `module:class`, with the module in this package. The module is imported only when the driver is
            made, because a driver may need an optional package (pyserial).
        words: description of the driver in messages.
        needs: required arguments of `make_driver`, besides the configuration.
        takes: optional arguments of `make_driver`.
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
    LockDriver.PX4: DriverEntry("px4_output:Px4Driver", "an output of PX4", needs=("link",), simulated=True),
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
    """Return the names of the chosen drivers as text: `maestro, pwm or px4`."""
    return alternatives(kind.value for kind, entry in DRIVERS.items() if chosen(entry))


def make_driver(
    config: LockConfig,
    kind: LockDriver | None = None,
    *,
    clock_us: Callable[[], int] | None = None,
    link: ActuatorLink | None = None,
    faults: MockFaults | None = None,
    gpio: bool = True,
) -> Driver:
    """Return a driver of the lock's servo in simulated time; for real hardware, use `owned_driver`.

    Args:
        kind: kind of driver; by default the configured kind.
        clock_us: time base of the mock, microseconds; only the mock needs it.
        link: connection to PX4; only the `px4` driver needs it.
        faults: initial faults of the mock's servo.
        gpio: whether configured limit switches are read from GPIO lines; False without hardware.

    Raises:
        ValueError: an argument that this kind needs is missing.
    """
    kind = config.driver if kind is None else kind
    entry = DRIVERS[kind]
    offered = {"clock_us": clock_us, "link": link, "faults": faults}
    for name in entry.needs:
        if offered[name] is None:
            raise ValueError(f"the {kind.value} driver needs {name}")
    module, _, name = entry.path.partition(":")
    make = getattr(importlib.import_module(f"{__name__}.{module}"), name)
    driver: Driver = make(config, **{name: offered[name] for name in entry.needs + entry.takes})
    return _with_switches(driver, config, entry) if gpio else driver


@contextlib.contextmanager
def owned_driver(
    config: LockConfig,
    *,
    clock_us: Callable[[], int],
    link: ActuatorLink | None = None,
    faults: MockFaults | None = None,
    lasting: bool = False,
) -> Iterator[Driver]:
    """Within the context, own the servo and return its driver; at the end close the driver.

    A modelled servo has no owner. The arguments are those of `make_driver` and `ServoOwnership`.

    Raises:
        ServoInUseError: another process owns the servo.
        InputError: the owner's file cannot be written.
    """
    driver = make_driver(config, clock_us=clock_us, link=link, faults=faults, gpio=False)
    entry = DRIVERS[config.driver]
    with contextlib.ExitStack() as held:
        device = cast(HardwareDriver, driver).device() if entry.moves else None
        if device is not None:
            held.enter_context(ServoOwnership(device, lasting=lasting))
        driver = _with_switches(driver, config, entry)
        try:
            yield driver
        finally:
            with contextlib.suppress(DriverError):
                driver.close()


def _with_switches(driver: Driver, config: LockConfig, entry: DriverEntry) -> Driver:
    if config.limit_switch is None or entry.reads_switches:
        return driver
    from dart_flight.lock.drivers.limit_switch import DriverWithLimitSwitch, GpioLimitSwitch  # noqa: PLC0415

    return DriverWithLimitSwitch(driver, GpioLimitSwitch(config.limit_switch))
