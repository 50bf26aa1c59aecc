"""Recorded flights for all tests of this folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import packaged
from dart_flight.report.flight import Flight
from dart_flight.sim.faults.kinds import parse_fault
from dart_flight.worlds.fast import fly_fast
from dart_flight.worlds.prepare import load_flyable


@pytest.fixture(scope="session")
def dual() -> Mission:
    return load_flyable(packaged("missions", "dual_collision.yaml"), packaged("configs", "dart.yaml"))


@pytest.fixture(scope="session")
def trials(dual: Mission, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three flights of the dual collision."""
    folder = tmp_path_factory.mktemp("trials")
    return [Path(fly_fast(dual, seed, folder).log or "").resolve() for seed in (1, 2, 3)]


@pytest.fixture(scope="session")
def flight(trials: list[Path]) -> Flight:
    return Flight.read(trials[0])


@pytest.fixture(scope="session")
def aborted(dual: Mission, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight into a wall that is not there."""
    fault = parse_fault("wall-missing@approach")
    verdict = fly_fast(dual, 1, tmp_path_factory.mktemp("aborted"), fault=fault)
    assert verdict.outcome == "aborted"
    return Path(verdict.log or "").resolve()
