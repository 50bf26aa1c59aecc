"""Recorded flights and their pages for the tests of this folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import packaged
from dart_flight.lab.report.page import comparison_page, flight_page
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.run.prepare import load_flyable
from tests.shared_flights import SharedFlights


@pytest.fixture(scope="session")
def dual() -> Mission:
    return load_flyable(packaged("missions", "paper_dual_collision.yaml"), packaged("configs", "dart.yaml"))


@pytest.fixture(scope="session")
def trials(flown: SharedFlights) -> list[Path]:
    """Return the logs of two flights of the dual collision."""
    return [flown("paper_dual_collision", seed).log for seed in (1, 2)]


@pytest.fixture(scope="session")
def flights(trials: list[Path]) -> list[RecordedFlight]:
    return [RecordedFlight.read(path) for path in trials]


@pytest.fixture(scope="session")
def flight(flown: SharedFlights) -> RecordedFlight:
    return RecordedFlight.read(flown("paper_dual_collision", 1).log)


def cached_page(flown: SharedFlights, name: str, make: Callable[[], str]) -> str:
    """Return a page that is rendered once for all test workers."""
    folder = flown.once(name, lambda cache: (cache / "page.html").write_text(make(), encoding="utf-8"))
    return (folder / "page.html").read_text(encoding="utf-8")


@pytest.fixture(scope="session")
def page(flown: SharedFlights, request: pytest.FixtureRequest) -> str:
    """Return the page of the first flight."""
    return cached_page(flown, "page", lambda: flight_page(request.getfixturevalue("flight")))


@pytest.fixture(scope="session")
def comparison(flown: SharedFlights, request: pytest.FixtureRequest) -> str:
    """Return the comparison page of the two flights, given in reverse order."""
    return cached_page(flown, "compared", lambda: comparison_page(request.getfixturevalue("flights")[::-1]))


@pytest.fixture(scope="session")
def aborted(flown: SharedFlights) -> Path:
    """Return the log of an aborted flight to a missing wall."""
    verdict, log = flown("paper_dual_collision", 1, "wall-missing@approach")
    assert verdict.outcome == "aborted"
    return log
