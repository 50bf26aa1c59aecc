"""Flights whose contact fits are missing, late, or fail from the second contact on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import msgspec
import pytest

from dart_flight.base.records import (
    ContactAnswer,
    FrameAnchor,
    ImpactBody,
    Outcome,
    PlanAnswer,
    ProbeEnd,
    Record,
    WallEstimate,
)
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.recording.reader import Log, read_log
from dart_flight.recording.verdict import Verdict
from dart_flight.run.fast import FastFlight, fly_fast
from dart_flight.run.replay import replay
from tests.shared_flights import SharedFlights

R = TypeVar("R", bound=Record)
Deliver = Callable[[FastFlight, int, PlanAnswer | ContactAnswer], None]
DELIVER: Deliver = FastFlight._answer
LATE_US = 450_000  # more than the timeout of an answer, 300 ms


def never(flight: FastFlight, due_us: int, answer: PlanAnswer | ContactAnswer) -> None:
    if isinstance(answer, PlanAnswer):
        DELIVER(flight, due_us, answer)


def late(flight: FastFlight, due_us: int, answer: PlanAnswer | ContactAnswer) -> None:
    DELIVER(flight, due_us if isinstance(answer, PlanAnswer) else due_us + LATE_US, answer)


def dead_after_the_first(flight: FastFlight, due_us: int, answer: PlanAnswer | ContactAnswer) -> None:
    if isinstance(answer, ContactAnswer) and answer.number > 1:
        answer = ContactAnswer(due_us, answer.number, problem="the planner process ended")
    DELIVER(flight, due_us, answer)


def fly_with(
    mission: Mission, deliver: Deliver, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[Verdict, Log]:
    """Fly with this delivery of answers and require an exact replay."""
    monkeypatch.setattr(FastFlight, "_answer", deliver)
    verdict = fly_fast(mission, 1, folder)
    log = read_log(str(verdict.log))
    assert replay(log).equal
    return verdict, log


def all_of(log: Log, kind: type[R]) -> list[R]:
    return [entry.record for entry in log.entries if isinstance(entry.record, kind)]


def shipped(name: str) -> Mission:
    return load_mission(packaged("missions", f"{name}.yaml"))


LATE = "no answer within 300 ms"


@pytest.mark.parametrize(
    ("mission", "deliver", "problems"),
    [
        ("paper_dual_collision", dead_after_the_first, ["", "the planner process ended"]),
        ("paper_dual_collision", never, [LATE, LATE]),
        ("dual_collision_replan", late, [LATE, LATE]),
    ],
)
def test_a_contact_without_a_fit_is_undecided_and_the_flight_continues(
    mission: str,
    deliver: Deliver,
    problems: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    verdict, log = fly_with(shipped(mission), deliver, tmp_path, monkeypatch)
    assert verdict.outcome is Outcome.COMPLETED, verdict.reason
    assert [estimate.problem for estimate in all_of(log, WallEstimate)] == problems
    assert [hit.mode_felt is None for hit in verdict.collisions] == [bool(problem) for problem in problems]
    assert len(all_of(log, ImpactBody)) == problems.count("")
    assert len(all_of(log, ContactAnswer)) == (0 if deliver is never else 2)
    for estimate in all_of(log, WallEstimate):
        assert (estimate.plane_point_mission is None) is bool(estimate.problem)


@pytest.mark.parametrize("deliver", [late, dead_after_the_first])
def test_a_wall_found_without_a_fit_is_placed_at_the_onset(
    deliver: Deliver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other probe is skipped, and the wall is hit again."""
    mission = shipped("find_a_wall")
    verdict, log = fly_with(mission, deliver, tmp_path, monkeypatch)
    assert verdict.outcome is Outcome.COMPLETED, verdict.reason
    assert [(hit.wall, hit.mode) for hit in verdict.collisions] == [("north", "rigid"), ("north", "flexible")]
    assert [e.what for e in all_of(log, ProbeEnd)] == ["collision 3 skipped: contact with wall north"]
    (board,) = mission.simulated_walls
    (north,) = verdict.walls
    assert abs(board.signed_distance(north.point_m)) < 0.05
    if deliver is dead_after_the_first:
        first, second = all_of(log, WallEstimate)
        assert (first.problem, second.problem) == ("", "the planner process ended")


def test_a_contact_without_a_fit_does_not_move_the_mission_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, log = fly_with(shipped("dual_collision_gps"), dead_after_the_first, tmp_path, monkeypatch)
    (anchor,) = all_of(log, FrameAnchor)
    estimates = all_of(log, WallEstimate)
    assert (anchor.wall, estimates[0].problem) == (estimates[0].wall, "")
    assert {estimate.problem for estimate in estimates[1:]} == {"the planner process ended"}


def test_a_missing_fit_does_not_delay_a_plan_that_does_not_need_it(
    flown: SharedFlights, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second collision is at another wall, so its plan starts at the end of the contact."""
    name, plans = "dual_collision_replan", []
    for log in (
        read_log(flown(name, 1).log),
        fly_with(shipped(name), never, tmp_path, monkeypatch)[1],
    ):
        plans.append([msgspec.structs.replace(a, received_us=0) for a in all_of(log, PlanAnswer)][:1])
    assert plans[0] == plans[1]
