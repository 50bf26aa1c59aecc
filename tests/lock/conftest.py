"""Fixtures for the packaged lock configuration and its variations."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from dart_flight.config.vehicle import LimitSwitch, LockConfig, LockDriver, packaged
from dart_flight.config.vehicle.configuration import load_vehicle
from tests.lock.rigs import RIGS, Rig, Vary

RIGID_SWITCH = LimitSwitch(chip="/dev/gpiochip0", rigid_line=23)
BOTH_SWITCHES = LimitSwitch(chip="/dev/gpiochip0", rigid_line=23, flexible_line=24)


@pytest.fixture(scope="session")
def lock_config() -> LockConfig:
    lock = load_vehicle(packaged("configs", "dart.yaml")).lock
    assert lock is not None
    return lock


@pytest.fixture(scope="session")
def vary(lock_config: LockConfig) -> Vary:
    """The packaged lock configuration with some values changed: `vary(servo={...}, startup=...)`."""

    def varied(**changes: Any) -> LockConfig:
        for name, value in changes.items():
            if isinstance(value, dict):
                changes[name] = msgspec.structs.replace(getattr(lock_config, name), **value)
        return msgspec.structs.replace(lock_config, **changes)

    return varied


@pytest.fixture
def make_rig(vary: Vary, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Rig]]:
    """A rig of a kind of driver with a varied configuration: `make_rig(LockDriver.PWM, startup=...)`."""
    made: list[Rig] = []

    def make(kind: LockDriver, **changes: Any) -> Rig:
        made.append(RIGS[kind](vary(**changes), tmp_path, monkeypatch))
        return made[-1]

    yield make
    for rig in made:
        rig.free()
