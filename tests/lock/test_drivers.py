"""The table of lock drivers: every kind has an entry that creates its driver."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from dart_flight.config.vehicle import LockConfig, LockDriver
from dart_flight.lock import drivers
from dart_flight.lock.drivers import DRIVERS, ActuatorLink, Driver, DriverError, driver_names, make_driver
from dart_flight.lock.drivers.mock import MockDriver, MockFaults

Vary = Callable[..., LockConfig]


@pytest.mark.parametrize("kind", list(LockDriver))
def test_every_kind_creates_its_own_driver(kind: LockDriver, lock_config: LockConfig) -> None:
    module, _, name = DRIVERS[kind].path.partition(":")
    driver = make_driver(
        lock_config, kind, clock_us=lambda: 0, link=ActuatorLink(lambda index, value: None, None)
    )
    assert isinstance(driver, Driver)
    assert (type(driver).__module__, type(driver).__name__) == (f"{drivers.__name__}.{module}", name)


@pytest.mark.parametrize("kind", [kind for kind, entry in DRIVERS.items() if entry.needs])
def test_a_missing_argument_of_a_driver_is_reported(kind: LockDriver, lock_config: LockConfig) -> None:
    with pytest.raises(ValueError, match=f"the {kind.value} driver needs {DRIVERS[kind].needs[0]}"):
        make_driver(lock_config, kind)


def test_driver_names_are_joined_into_a_phrase() -> None:
    assert driver_names(lambda entry: not entry.moves) == "mock"
    reads = driver_names(lambda entry: entry.reads_switches)
    assert "mock" in reads
    assert not {"maestro", "pwm", "px4"} & set(reads.replace(",", "").split())
    simulated = driver_names(lambda entry: entry.simulated)
    assert {"px4", "mock"} <= set(simulated.replace(",", "").split())
    *first, last = [kind.value for kind in DRIVERS]
    assert driver_names(lambda entry: True) == f"{', '.join(first)} or {last}"


def test_opening_an_unplugged_mock_raises_a_driver_error(lock_config: LockConfig) -> None:
    with pytest.raises(DriverError, match="unplugged"):
        MockDriver(lock_config, lambda: 0, faults=MockFaults(unplugged=True)).open()
