"""The time limit of a simulated flight."""

from __future__ import annotations

import pytest
from msgspec import structs

from dart_flight.base.records import Outcome
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.run import fast

HOVER = load_mission(packaged("missions", "hover.yaml"))


def test_an_endless_simulated_flight_is_aborted_with_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    # No setting shortens this time, and the test would wait for it.
    monkeypatch.setattr(fast, "_LONGEST_S", 1.0)
    short = structs.replace(HOVER, goal=structs.replace(HOVER.goal, hold_s=1.0), waypoints=())
    verdict, limit_s = fast.fly_fast(short, 1, None), fast.time_limit_s(short)
    assert verdict.outcome is Outcome.ABORTED
    assert verdict.reason == (
        f"world_died: the simulated flight did not end within {limit_s:.0f} s of simulated time"
    )


def test_the_time_limit_includes_the_hold_time_of_the_goal() -> None:
    goal = structs.replace(HOVER.goal, hold_s=HOVER.goal.hold_s + 400.0)
    assert fast.time_limit_s(structs.replace(HOVER, goal=goal)) == pytest.approx(
        fast.time_limit_s(HOVER) + 400.0
    )
