"""Fixtures of this folder: one recorded flight, shared by all tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import packaged
from dart_flight.recording.reader import Log, read_log
from dart_flight.run.prepare import load_flyable
from tests.shared_flights import SharedFlights


@pytest.fixture(scope="session")
def single_wall() -> Mission:
    return load_flyable(packaged("missions", "paper_single_wall.yaml"), packaged("configs", "dart.yaml"))


@pytest.fixture(scope="session")
def flight_path(flown: SharedFlights) -> Path:
    return flown("paper_single_wall", 1).log


@pytest.fixture(scope="session")
def flight(flight_path: Path) -> Log:
    return read_log(flight_path)
