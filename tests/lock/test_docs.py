"""The lock's manual page names existing keys, parameters and drivers."""

from __future__ import annotations

import re
from pathlib import Path

from dart_flight.config.vehicle import LockConfig, LockDriver, packaged
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.lock.drivers.px4_output import required_parameters

PAGE = Path(__file__).parents[2] / "docs" / "lock.md"


def test_the_keys_on_the_page_exist() -> None:
    lock = load_vehicle(packaged("configs", "dart.yaml")).lock
    keys = re.findall(r"`lock\.([a-z0-9_.]+)`", PAGE.read_text())
    assert len(keys) >= 8
    for key in keys:
        value: object = lock
        for part in key.split("."):
            if value is not None:
                assert hasattr(value, part), key
                value = getattr(value, part)


def test_the_page_names_every_required_parameter(lock_config: LockConfig) -> None:
    page = PAGE.read_text()
    for required in required_parameters(lock_config):
        assert f"`{required.name}`" in page


def test_every_driver_is_on_the_page() -> None:
    page = PAGE.read_text()
    for kind in LockDriver:
        assert f"**{kind.value}**" in page
