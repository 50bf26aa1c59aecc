"""`plan` verifies its plans in simulation before it offers them, and gives reasons if it does not."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

import dart_flight
from dart_flight.base.records import Outcome, World
from dart_flight.cli import EXIT_INTERRUPTED, main
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import LockDriver, packaged
from dart_flight.lab.report.figures.mission_figure import prediction_lines
from dart_flight.lab.search import flown_plan
from dart_flight.lab.search.flown_plan import DRAWN, FIRST_SEED, OfferedPlan, PlanChoice
from dart_flight.lab.search.mission_writer import write_mission
from dart_flight.lab.search.plan import SearchResult
from dart_flight.lab.search.quickest import plan_quickest
from dart_flight.planning.predicted_flight import predict_mission
from dart_flight.recording.verdict import Verdict
from dart_flight.run.many_flights import RunsInterruptedError
from dart_flight.run.prepare import with_driver
from tests.extras import needs_ruckig
from tests.lab.search.test_quickest import one_turn, scenario_between_walls
from tests.mission_findings import check_mission

pytestmark = needs_ruckig

SCENARIO = """\
version: 1
name: once-round
start: {position_m: [0.0, 0.0], altitude_m: 1.2}
goal: {position_m: [0.0, 0.0], capture_radius_m: 0.15}
bounds_m: {x: [-3.0, 3.0], y: [-2.0, 2.0], z: [0.3, 2.5]}
walls:
  east: {point_m: [1.5, 0.0], normal: [-1.0, 0.0], length_m: 3.0, material: acrylic}
visits: [{position_m: [1.5, 0.0], within_m: 0.1}]
sequence: any
objective: quickest
limits: {motion: position, speed_m_s: 2.0}
"""

# The result of a flight by mission and seed: time in seconds, whether completed, whether controlled.
Ends = Callable[[Mission, int], tuple[float, bool, bool]]


class FakeFlights:
    """Flights with given results, and a record of the missions flown."""

    def __init__(self, ends: Ends) -> None:
        self.ends, self.flown = ends, list[tuple[str, int, bool]]()

    def __call__(self, mission: Mission, seeds: list[int], spreads: Any, done: Any) -> list[Verdict]:
        verdicts = []
        for seed in seeds:
            time_s, completes, controlled = self.ends(mission, seed if spreads else 0)
            self.flown.append((kind_of(mission), seed, bool(spreads)))
            verdicts.append(
                Verdict(
                    mission=mission.name, world=World.FAST, seed=seed,
                    outcome=Outcome.COMPLETED if completes else Outcome.ABORTED,
                    reason=None if completes else "tilt: too much", collisions=[], guard=[], goal_miss_m=0.0,
                    final_error_m=0.0, max_tilt_deg=30.0 if controlled else 95.0, flight_time_s=time_s,
                    uncontrolled=[] if controlled else ["tilted by 95 degrees"],
                )
            )  # fmt: skip
            done(verdicts[-1])
        return verdicts


def kind_of(mission: Mission) -> str:
    if not mission.collisions:
        return "free"
    return "colliding" if mission.collisions[0].trajectory is not None else "touched"


def times_by_kind(**times_s: float) -> Ends:
    return lambda mission, seed: (times_s[kind_of(mission)], True, True)


@pytest.fixture(scope="module")
def planned() -> SearchResult:
    return one_turn()


def choose(result: SearchResult, ends: Ends, free_only: bool = False) -> tuple[OfferedPlan, FakeFlights]:
    flights = FakeFlights(ends)
    return PlanChoice(result, free_only).run(flights), flights


def test_a_faster_plan_that_completes_is_offered_with_its_flight_record(planned: SearchResult) -> None:
    offered, flights = choose(planned, times_by_kind(free=20.0, colliding=18.5))
    assert offered.plan is planned.colliding
    assert offered.record is not None
    assert offered.record.saving_s == pytest.approx(1.5)
    assert offered.record.free_time_s == 20.0
    assert "20 of 20 flights in random worlds complete" in offered.messages[-1]
    assert "saves 1.50 s" in offered.messages[-1]
    seeds = [
        (kind, FIRST_SEED + k, drawn) for kind in ("free", "colliding") for drawn, k in _nominal_and_drawn()
    ]
    assert flights.flown == seeds


def _nominal_and_drawn() -> list[tuple[bool, int]]:
    return [(False, 0), *((True, k) for k in range(DRAWN))]


def test_the_saving_compares_flights_in_equal_worlds(planned: SearchResult) -> None:
    """Only worlds in which both flights complete count; a slow world slows both flights."""

    def ends(mission: Mission, seed: int) -> tuple[float, bool, bool]:
        k = seed - FIRST_SEED
        slow_s = 0.5 * k if seed else 0.0
        gains_s = 1.0 if kind_of(mission) == "colliding" else 0.0
        return 20.0 + slow_s - gains_s, k != (3 if gains_s else 5), True

    offered, _ = choose(planned, ends)
    assert offered.record is not None
    assert offered.record.saving_s == pytest.approx(1.0)
    assert offered.record.drawn is not None
    assert offered.record.drawn.completed == DRAWN - 1
    assert offered.record.drawn.ended_by == {"tilt": 1}


@pytest.mark.parametrize("fails", ["nominal", "three", "uncontrolled", "nominal uncontrolled"])
def test_a_plan_that_fails_in_simulation_is_offered_only_with_touches(
    planned: SearchResult, fails: str
) -> None:
    def ends(mission: Mission, seed: int) -> tuple[float, bool, bool]:
        k = seed - FIRST_SEED if seed else None
        if kind_of(mission) != "colliding":
            return {"free": 30.0, "touched": 28.0}[kind_of(mission)], True, True
        bad = {"nominal": k is None, "three": k in (1, 2, 3), "uncontrolled": k == 7,
               "nominal uncontrolled": k is None}[fails]  # fmt: skip
        return 20.0, not bad or "uncontrolled" in fails, not bad or "uncontrolled" not in fails

    offered, flights = choose(planned, ends)
    assert "the plan with collisions is not offered" in offered.messages[0]
    assert "with a touch of each wall at 0.6 m/s succeeds" in offered.messages[1]
    assert offered.plan is planned.colliding
    assert offered.scenario.spec.touch_m_s == 0.6
    assert offered.record is not None
    assert offered.record.saving_s == pytest.approx(2.0)
    alone = [one for one in flights.flown if one[0] == "colliding"]
    expected = {"nominal": 1, "nominal uncontrolled": 1, "three": 1 + 4, "uncontrolled": 1 + 8}
    assert len(alone) == expected[fails], "the flights end as soon as the plan has failed"


def test_two_of_twenty_drawn_flights_may_abort(planned: SearchResult) -> None:
    def ends(mission: Mission, seed: int) -> tuple[float, bool, bool]:
        hits = kind_of(mission) == "colliding"
        return (18.0 if hits else 20.0), not hits or seed - FIRST_SEED not in (4, 9), True

    offered, _ = choose(planned, ends)
    assert offered.plan is planned.colliding


def test_the_free_plan_is_offered_if_touches_cost_more_than_collisions_save(planned: SearchResult) -> None:
    def ends(mission: Mission, seed: int) -> tuple[float, bool, bool]:
        return (
            {"free": 20.0, "colliding": 18.0, "touched": 33.0}[kind_of(mission)],
            True,
            (kind_of(mission) != "colliding"),
        )

    offered, _ = choose(planned, ends)
    assert offered.plan is planned.free
    assert "loses 13.00 s" in offered.messages[1]
    assert "the flight without a collision is offered" in offered.messages[2]


def test_required_collisions_are_offered_only_if_they_complete() -> None:
    required = plan_quickest(scenario_between_walls(sequence=["east"]))
    offered, _ = choose(required, times_by_kind(free=20.0, colliding=21.0))
    assert offered.plan is required.colliding
    nothing, _ = choose(required, lambda mission, seed: (20.0, not mission.collisions, True))
    assert nothing.plan is None
    assert nothing.messages[-1] == "no plan is offered"


def test_touches_of_the_scenario_are_flown_and_counted_in_the_time() -> None:
    with_touches = plan_quickest(scenario_between_walls(touch_m_s=0.5))
    offered, flights = choose(with_touches, times_by_kind(free=20.0, touched=33.0))
    assert offered.plan is with_touches.colliding
    assert "loses 13.00 s" in offered.messages[-1]
    assert {kind for kind, _, _ in flights.flown} == {"free", "touched"}


def test_the_free_plan_is_flown_before_it_is_offered(planned: SearchResult) -> None:
    offered, flights = choose(planned, times_by_kind(free=20.0), free_only=True)
    assert offered.plan is planned.free
    assert len(flights.flown) == 1 + DRAWN


def test_optional_collisions_that_hardly_save_time_are_not_flown(planned: SearchResult) -> None:
    assert planned.colliding is not None
    assert planned.free is not None
    slow = msgspec.structs.replace(planned.colliding, saving_s=0.009 * planned.free.time_to_goal_s)
    result = msgspec.structs.replace(planned, plans=(slow, planned.free))
    offered, flights = choose(result, times_by_kind(free=20.0))
    assert offered.plan is planned.free
    assert "less than 1%" in offered.messages[-2]
    assert {kind for kind, _, _ in flights.flown} == {"free"}
    # Without a flight that succeeds, the collisions are not optional.
    offered, _ = choose(result, lambda mission, seed: (20.0, bool(mission.collisions), True))
    assert offered.plan is slow


# --- plans whose missions are refused ------------------------------------------------------------------

BESIDE = {"east": {"point_m": [1.5, 1.5], "normal": [-1.0, 0.0], "length_m": 2.0, "material": "acrylic"}}
POLE = {"pole": {"centre_m": [0.7, 0.0], "radius_m": 0.05, "material": "wood"}}


@pytest.mark.parametrize(
    ("keys", "reason", "touch_m_s"),
    [
        ({"walls": BESIDE, "visits": [{"position_m": [1.5, 1.5], "within_m": 0.1}]}, "beyond the end", None),
        ({"posts": POLE, "visits": [{"position_m": [2.0, 1.0], "within_m": 0.1}]}, "blocks the run-up", 0.6),
    ],
)
def test_a_plan_whose_mission_is_refused_is_not_flown(
    keys: dict[str, Any], reason: str, touch_m_s: float | None
) -> None:
    """A touch that misses its wall, or whose run-up is blocked, ends neither search nor choice."""
    result = plan_quickest(scenario_between_walls(**keys, touch_m_s=touch_m_s))
    assert result.colliding is not None
    fails = lambda mission, seed: (20.0, kind_of(mission) != "colliding", True)  # noqa: E731
    offered, flights = choose(result, fails)
    assert offered.plan is result.free
    assert "touched" not in {kind for kind, _, _ in flights.flown}
    ((key, why),) = offered.refused.items()
    assert key == ("touched" if touch_m_s is None else "colliding")
    assert reason in why
    assert any(line.endswith(f"is refused: {why}") for line in offered.messages)
    skipped = PlanChoice(result, False).skip("not flown")
    assert skipped.plan is (result.free if touch_m_s else result.colliding)


def test_errors_of_the_flights_are_not_refusals(planned: SearchResult) -> None:
    def ends(mission: Mission, seed: int) -> tuple[float, bool, bool]:
        raise InputError("cannot write: No space left on device", source="flights")

    with pytest.raises(InputError, match="No space left"):
        choose(planned, ends)


# --- the flight record in the mission file, and its check ----------------------------------------------


def write_chosen(result: SearchResult, ends: Ends, path: Path) -> Mission:
    offered, _ = choose(result, ends)
    assert offered.plan is not None
    write_mission(offered.scenario, offered.plan, path, offered.record)
    return dart_flight.load_mission(path)


def flown_finding(mission: Mission) -> Any:
    return next(finding for finding in check_mission(mission) if finding.item == "flown")


def test_check_shows_the_flight_record_and_detects_a_changed_mission(
    planned: SearchResult, tmp_path: Path
) -> None:
    path = tmp_path / "mission.yaml"
    mission = write_chosen(planned, times_by_kind(free=20.0, colliding=18.5), path)
    finding = flown_finding(mission)
    assert (finding.go, finding.remark) == (True, False)
    assert mission.flown is not None
    assert mission.flown.summary == (
        "20 of 20 flights in random worlds complete, 0 uncontrolled, 18.5 s from take-off to landing "
        "against 20.0 s without collisions: saves 1.50 s"
    )
    assert finding.message.endswith(f": {mission.flown.summary}")
    assert f"Flown in simulation: {mission.flown.summary}." in prediction_lines(
        mission, predict_mission(mission), []
    )
    assert finding.figures == {"flights": 20, "completed": 20, "saving_s": 1.5}
    assert dart_flight.load_mission(mission.to_dict()).flown == mission.flown
    assert not flown_finding(with_driver(mission, LockDriver.PX4)).remark, (
        "another driver does not change the flight"
    )
    for changed in (
        dart_flight.load_mission(path, settings=["airframe.mass_kg=1.5"]),
        mission.replace({"goal.hold_s": 3.0}),
    ):
        assert "has changed since" in flown_finding(changed).message
        assert flown_finding(changed).remark


def test_check_rejects_a_mission_that_lost_control_in_simulation(
    planned: SearchResult, tmp_path: Path
) -> None:
    mission = write_chosen(planned, times_by_kind(free=20.0, colliding=18.5), tmp_path / "mission.yaml")
    assert mission.flown is not None
    assert mission.flown.drawn is not None
    bad = msgspec.structs.replace(mission.flown.drawn, uncontrolled=1)
    record = msgspec.structs.replace(mission.flown, drawn=bad)
    finding = flown_finding(msgspec.structs.replace(mission, flown=record))
    assert not finding.go
    assert "1 of the 20 flights flown in random worlds is uncontrolled" in finding.message
    assert msgspec.structs.replace(mission, flown=record).digest == mission.digest


def test_check_remarks_on_a_mission_without_a_flight_record() -> None:
    finding = flown_finding(dart_flight.load_mission(dart_flight.packaged("missions", "single_wall.yaml")))
    assert finding.go
    assert finding.remark
    assert "contains no record of simulated flights" in finding.message


def test_an_invalid_flight_record_is_refused(planned: SearchResult, tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    write_chosen(planned, times_by_kind(free=20.0, colliding=18.5), path)
    path.write_text(path.read_text().replace("uncontrolled: 0", "uncontrolled: -1"))
    with pytest.raises(InputError, match="uncontrolled"):
        dart_flight.load_mission(path)


# --- the command ---------------------------------------------------------------------------------------


@pytest.mark.rest
def test_the_command_flies_its_plan_and_records_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flown_plan, "DRAWN", 1)
    monkeypatch.setattr(flown_plan, "fly_fast_many", fly_here)
    scenario, target = tmp_path / "scenario.yaml", tmp_path / "mission.yaml"
    scenario.write_text(SCENARIO)
    assert main(["plan", str(scenario), "--json", "-o", str(target)]) == 0
    output = json.loads(capsys.readouterr().out)
    mission = dart_flight.load_mission(target)
    assert mission.flown is not None
    assert mission.flown.drawn is not None
    assert mission.flown.drawn.flights == 1
    assert mission.flown.digest == mission.digest
    records = output["flown"]
    assert records["free"]["nominal"]["outcome"] == "completed"
    repeated = dart_flight.simulate(mission, seed=FIRST_SEED).verdict
    assert repeated.flight_time_s == pytest.approx(mission.flown.nominal.time_s, abs=1e-3)


def fly_here(mission: Mission, seeds: Any, log_dir: Any, done: Any, spreads: Any, _: Any) -> list[Verdict]:
    return flown_plan.fly_in_process(mission, list(seeds), spreads, done)


def test_the_command_reports_a_skipped_verification(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario, target = tmp_path / "scenario.yaml", tmp_path / "mission.yaml"
    scenario.write_text(SCENARIO)
    assert main(["plan", str(scenario), "-o", str(target), "--no-verify"]) == 0
    assert "not flown in simulation (--no-verify)" in capsys.readouterr().out
    assert dart_flight.load_mission(target).flown is None


def test_an_interrupted_command_prints_what_is_known_and_keeps_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fly = FakeFlights(times_by_kind(free=20.0, colliding=18.0))

    def interrupt(mission: Mission, seeds: Any, log_dir: Any, done: Any, spreads: Any, announce: Any) -> Any:
        if not (mission.collisions and spreads):
            return fly(mission, seeds, spreads, done)
        announce(2)
        raise RunsInterruptedError(fly(mission, seeds[:3], spreads, done))

    monkeypatch.setattr(flown_plan, "fly_fast_many", interrupt)
    scenario, target = tmp_path / "scenario.yaml", tmp_path / "mission.yaml"
    scenario.write_text(SCENARIO)
    target.write_text("mine")
    assert main(["plan", str(scenario), "-o", str(target)]) == EXIT_INTERRUPTED
    out, err = capsys.readouterr()
    assert "colliding would save" in out
    assert "the flight without a collision: the nominal flight completes, 20.0 s" in out
    assert "waiting for 2 flights in progress" in err
    assert "the plan with collisions: 3 of 3 flights in drawn worlds completed" in err
    assert f"{target} was not written" in err
    assert target.read_text() == "mine"
    assert main(["plan", str(scenario), "-o", str(target), "--json"]) == EXIT_INTERRUPTED
    known = json.loads(capsys.readouterr().out)
    assert known["flown"]["free"]["drawn"]["completed"] == DRAWN
    assert "colliding" not in known["flown"]


def test_a_plan_of_the_grid_that_tumbles_in_simulation_is_not_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fly = FakeFlights(lambda mission, seed: (9.0, True, seed != FIRST_SEED + 2))
    run: Callable[..., list[Verdict]] = lambda m, seeds, log, done, spreads, _: fly(m, seeds, spreads, done)  # noqa: E731
    monkeypatch.setattr(flown_plan, "fly_fast_many", run)
    scenario, target = str(packaged("missions", "scenarios", "one_wall.yaml")), tmp_path / "mission.yaml"
    assert main(["plan", scenario, "-o", str(target)]) == 1
    assert not target.exists()
    err = capsys.readouterr().err
    assert "1 of the 3 flights flown in random worlds is uncontrolled" in err
    assert "17 flights were not flown: they cannot change the result" in err
    assert "try --rank 2" in err
