"""Words about the end of a flight and about PX4's checks before it."""

from __future__ import annotations

import pytest
from rich.console import Console

from dart_flight.base.records import HealthReport, Outcome, Phase, PhaseChange, World
from dart_flight.cli.flight_output import verdict_table
from dart_flight.recording.events import EventFormatter
from dart_flight.recording.verdict import Verdict


@pytest.mark.parametrize(("planned_m", "predicted"), [(0.2, ", predicted at 0.20 m"), (None, "")])
def test_a_flight_that_holds_the_goal_but_passed_it_far_away_says_both(
    planned_m: float | None, predicted: str
) -> None:
    verdict = Verdict(
        mission="m", world=World.FAST, seed=1, outcome=Outcome.COMPLETED, reason=None,
        collisions=[], guard=[],
        goal_miss_m=1.23, final_error_m=0.05, goal_miss_planned_m=planned_m, goal_reached=False,
    )  # fmt: skip
    console = Console(width=200)
    with console.capture() as capture:
        console.print(verdict_table(verdict))
    line = "held 0.05 m from the goal; goal not passed within the capture radius: passed at 1.23 m"
    assert line + predicted in capture.get().splitlines()


def test_failed_preflight_checks_are_explained_before_the_flight_only() -> None:
    events = EventFormatter()
    report = HealthReport(1, 1, False, ("preflight checks failed",), ())
    first = events.format_event(report)
    assert first is not None
    assert "PX4 would not arm now: preflight checks failed; this is usual" in first.head
    events.format_event(PhaseChange(2, Phase.CLIMB, Phase.TRANSIT, "ready"))
    later = events.format_event(HealthReport(3, 3, False, ("no position",), ()))
    assert later is not None
    assert later.head == "PX4 would not arm now: no position"
