"""One recorded flight for all tests of this folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import packaged
from dart_flight.recording import Log, read_log
from dart_flight.worlds.fast import fly_fast
from dart_flight.worlds.prepare import load_flyable


@pytest.fixture(scope="session")
def single_wall() -> Mission:
    return load_flyable(packaged("missions", "single_wall.yaml"), packaged("configs", "dart.yaml"))


@pytest.fixture(scope="session")
def flight_path(single_wall: Mission, tmp_path_factory: pytest.TempPathFactory) -> Path:
    verdict = fly_fast(single_wall, 1, tmp_path_factory.mktemp("flights"))
    assert verdict.log is not None
    return Path(verdict.log).resolve()


@pytest.fixture(scope="session")
def flight(flight_path: Path) -> Log:
    return read_log(flight_path)
