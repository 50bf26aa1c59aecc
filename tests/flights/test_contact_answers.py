"""Flights whose contact fits are missing, late, or fail from the second contact on."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import msgspec
import pytest

from dart_flight.base.records import (
    ContactAnswer,
    ContactRequest,
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
from dart_flight.core.sense.contact_recorder import ANSWER_WITHIN_US
from dart_flight.planning.contact_fit import ContactFitter
from dart_flight.recording.reader import Log, read_log
from dart_flight.recording.verdict import Verdict
from dart_flight.run import fast, timing
from dart_flight.run.flight_record import FlightRecord
from dart_flight.run.replay import replay
from tests.shared_flights import SharedFlights

R = TypeVar("R", bound=Record)
Fly = Callable[[Mission, str], tuple[Verdict, Log]]
LATE = f"no answer within {ANSWER_WITHIN_US // 1000} ms"
ENDED = "the planner process ended"
DURATIONS_US = {"late": 3 * ANSWER_WITHIN_US // 2, "never": 10**9}


def all_of(log: Log, kind: type[R]) -> list[R]:
    return [entry.record for entry in log.entries if isinstance(entry.record, kind)]


def shipped(name: str) -> Mission:
    return load_mission(packaged("missions", f"{name}.yaml"))


@pytest.fixture
def fly(monkeypatch: pytest.MonkeyPatch) -> Fly:
    """Fly with fits that come `late` or `never`, or are `dead` after the first."""

    def fly(mission: Mission, fits: str) -> tuple[Verdict, Log]:
        if fits == "dead":
            monkeypatch.setattr(ContactFitter, "answer", answer_once)
        else:
            monkeypatch.setattr(timing, "FIT_US", DURATIONS_US[fits])
        records: list[FlightRecord] = []
        verdict = fast.fly_fast(mission, 1, None, keep_record=records.append)
        return verdict, records[0].log

    answer = ContactFitter.answer

    def answer_once(fitter: ContactFitter, request: ContactRequest) -> ContactAnswer:
        if request.number > 1:
            return ContactAnswer(0, request.number, problem=ENDED)
        return answer(fitter, request)

    return fly


@pytest.mark.rest
@pytest.mark.parametrize(
    ("mission", "fits", "problems"),
    [
        ("paper_dual_collision", "dead", ["", ENDED]),
        ("dual_collision_replan", "late", [LATE, LATE]),
    ],
)
def test_a_contact_without_a_fit_is_undecided_and_the_flight_continues(
    mission: str, fits: str, problems: list[str], fly: Fly
) -> None:
    verdict, log = fly(shipped(mission), fits)
    assert replay(log).equal
    assert verdict.outcome is Outcome.COMPLETED, verdict.reason
    assert [estimate.problem for estimate in all_of(log, WallEstimate)] == problems
    assert [hit.mode_felt is None for hit in verdict.collisions] == [bool(problem) for problem in problems]
    assert len(all_of(log, ImpactBody)) == problems.count("")
    assert len(all_of(log, ContactAnswer)) == 2
    for estimate in all_of(log, WallEstimate):
        assert (estimate.plane_point_mission is None) is bool(estimate.problem)


def test_a_missing_fit_does_not_delay_a_plan_that_does_not_need_it(flown: SharedFlights, fly: Fly) -> None:
    """The second collision is at another wall, so its plan starts at the end of the contact."""
    name = "dual_collision_replan"
    verdict, log = fly(shipped(name), "never")
    assert verdict.outcome is Outcome.COMPLETED, verdict.reason
    assert [estimate.problem for estimate in all_of(log, WallEstimate)] == [LATE, LATE]
    assert [hit.mode_felt for hit in verdict.collisions] == [None, None]
    assert not all_of(log, ContactAnswer)
    assert not all_of(log, ImpactBody)
    plans = [
        msgspec.structs.replace(all_of(one, PlanAnswer)[0], received_us=0)
        for one in (log, read_log(flown(name, 1).log))
    ]
    assert plans[0] == plans[1]


@pytest.mark.rest
def test_a_wall_found_without_a_fit_is_placed_at_the_onset(fly: Fly) -> None:
    """The other probe is skipped, and the wall is hit again."""
    mission = shipped("find_a_wall")
    verdict, log = fly(mission, "dead")
    assert verdict.outcome is Outcome.COMPLETED, verdict.reason
    assert [(hit.wall, hit.mode) for hit in verdict.collisions] == [("north", "rigid"), ("north", "flexible")]
    assert [e.what for e in all_of(log, ProbeEnd)] == ["collision 3 skipped: contact with wall north"]
    (board,) = mission.simulated_walls
    (north,) = verdict.walls
    assert abs(board.signed_distance(north.point_m)) < 0.05
    assert [estimate.problem for estimate in all_of(log, WallEstimate)] == ["", ENDED]


@pytest.mark.rest
def test_a_contact_without_a_fit_does_not_move_the_mission_frame(fly: Fly) -> None:
    _, log = fly(shipped("dual_collision_gps"), "dead")
    (anchor,) = all_of(log, FrameAnchor)
    estimates = all_of(log, WallEstimate)
    assert (anchor.wall, estimates[0].problem) == (estimates[0].wall, "")
    assert {estimate.problem for estimate in estimates[1:]} == {ENDED}
