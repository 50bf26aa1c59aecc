"""`plan` flies what it planned before it calls it a saving, and says why a plan is not offered."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

import dart_flight
from dart_flight.base.records import Outcome, World
from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import LockDriver
from dart_flight.lab.report.figures.mission_figure import prediction_lines
from dart_flight.lab.search import flown_plan
from dart_flight.lab.search.flown_plan import DRAWN, FIRST_SEED, OfferedPlan, choose_flown
from dart_flight.lab.search.mission_writer import write_mission
from dart_flight.lab.search.quickest import QuickestResult, plan_quickest
from dart_flight.planning.predicted_flight import predict_mission
from dart_flight.recording.verdict import Verdict
from dart_flight.run.prepare import with_driver
from tests.lab.search.test_quickest import between
from tests.mission_findings import check_mission

WRITTEN = """\
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

# How a flight of a mission ends, by seed: time in seconds, whether it completes, whether it is controlled.
Ends = Callable[[Mission, int], tuple[float, bool, bool]]


class FakeFlights:
    """Flights whose ends are given; counts the missions that were flown."""

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


def by_kind(**times_s: float) -> Ends:
    return lambda mission, seed: (times_s[kind_of(mission)], True, True)


@pytest.fixture(scope="module")
def planned() -> QuickestResult:
    return plan_quickest(between())


def chosen(result: QuickestResult, ends: Ends, free_only: bool = False) -> tuple[OfferedPlan, FakeFlights]:
    flights = FakeFlights(ends)
    return choose_flown(result, free_only, fly=flights), flights


def test_a_plan_that_flies_and_is_quicker_is_offered_with_what_was_flown(planned: QuickestResult) -> None:
    offered, flights = chosen(planned, by_kind(free=20.0, colliding=18.5))
    assert offered.plan is planned.colliding
    assert offered.record is not None
    assert offered.record.saving_s == pytest.approx(1.5)
    assert offered.record.free_time_s == 20.0
    assert "20 of 20 drawn flights complete" in offered.says[-1]
    assert "saves 1.50 s" in offered.says[-1]
    seeds = [(kind, FIRST_SEED + k, drawn) for kind in ("free", "colliding") for drawn, k in _once()]
    assert flights.flown == seeds


def _once() -> list[tuple[bool, int]]:
    return [(False, 0), *((True, k) for k in range(DRAWN))]


def test_the_saving_is_that_of_the_same_worlds(planned: QuickestResult) -> None:
    """Worlds that one of the two did not complete in do not count; a slow world slows both."""

    def ends(mission: Mission, seed: int) -> tuple[float, bool, bool]:
        k = seed - FIRST_SEED
        slow_s = 0.5 * k if seed else 0.0
        gains_s = 1.0 if kind_of(mission) == "colliding" else 0.0
        return 20.0 + slow_s - gains_s, k != (3 if gains_s else 5), True

    offered, _ = chosen(planned, ends)
    assert offered.record is not None
    assert offered.record.saving_s == pytest.approx(1.0)
    assert offered.record.drawn is not None
    assert offered.record.drawn.completed == DRAWN - 1
    assert offered.record.drawn.ended_by == {"tilt": 1}


@pytest.mark.parametrize("fails", ["nominal", "three", "uncontrolled", "nominal uncontrolled"])
def test_a_plan_that_does_not_fly_is_offered_with_touches_only(planned: QuickestResult, fails: str) -> None:
    def ends(mission: Mission, seed: int) -> tuple[float, bool, bool]:
        k = seed - FIRST_SEED if seed else None
        if kind_of(mission) != "colliding":
            return {"free": 30.0, "touched": 28.0}[kind_of(mission)], True, True
        bad = {"nominal": k is None, "three": k in (1, 2, 3), "uncontrolled": k == 7,
               "nominal uncontrolled": k is None}[fails]  # fmt: skip
        return 20.0, not bad or "uncontrolled" in fails, not bad or "uncontrolled" not in fails

    offered, flights = chosen(planned, ends)
    assert "the plan with collisions is not offered" in offered.says[0]
    assert "with a touch of each wall at 0.6 m/s succeeds" in offered.says[1]
    assert offered.plan is planned.colliding
    assert offered.scenario.spec.touch_m_s == 0.6
    assert offered.record is not None
    assert offered.record.saving_s == pytest.approx(2.0)
    alone = [one for one in flights.flown if one[0] == "colliding"]
    assert len(alone) == (1 if "nominal" in fails else 1 + DRAWN), "nothing is drawn after a nominal failure"


def test_two_drawn_flights_of_twenty_may_break_off(planned: QuickestResult) -> None:
    def ends(mission: Mission, seed: int) -> tuple[float, bool, bool]:
        hits = kind_of(mission) == "colliding"
        return (18.0 if hits else 20.0), not hits or seed - FIRST_SEED not in (4, 9), True

    offered, _ = chosen(planned, ends)
    assert offered.plan is planned.colliding


def test_touches_that_cost_more_than_the_hits_save_leave_the_free_flight(planned: QuickestResult) -> None:
    def ends(mission: Mission, seed: int) -> tuple[float, bool, bool]:
        return (
            {"free": 20.0, "colliding": 18.0, "touched": 33.0}[kind_of(mission)],
            True,
            (kind_of(mission) != "colliding"),
        )

    offered, _ = chosen(planned, ends)
    assert offered.plan is planned.free
    assert "loses 13.00 s" in offered.says[1]
    assert "the flight without a collision is offered" in offered.says[2]


def test_hits_that_the_scenario_demands_are_offered_if_they_fly_and_else_nothing() -> None:
    demanded = plan_quickest(between(sequence=["east"]))
    offered, _ = chosen(demanded, by_kind(free=20.0, colliding=21.0))
    assert offered.plan is demanded.colliding
    nothing, _ = chosen(demanded, lambda mission, seed: (20.0, not mission.collisions, True))
    assert nothing.plan is None
    assert nothing.says[-1] == "no plan is offered"


def test_touches_that_the_scenario_asks_for_are_flown_and_counted() -> None:
    asked = plan_quickest(between(touch_m_s=0.5))
    offered, flights = chosen(asked, by_kind(free=20.0, touched=33.0))
    assert offered.plan is asked.colliding
    assert "loses 13.00 s" in offered.says[-1]
    assert {kind for kind, _, _ in flights.flown} == {"free", "touched"}


def test_the_free_plan_is_flown_as_well(planned: QuickestResult) -> None:
    offered, flights = chosen(planned, by_kind(free=20.0), free_only=True)
    assert offered.plan is planned.free
    assert len(flights.flown) == 1 + DRAWN


# --- the record in the file, and what check makes of it ------------------------------------------------


def written(result: QuickestResult, ends: Ends, path: Path) -> Mission:
    offered, _ = chosen(result, ends)
    assert offered.plan is not None
    write_mission(offered.scenario, offered.plan, path, offered.record)
    return dart_flight.load_mission(path)


def flown_finding(mission: Mission) -> Any:
    return next(finding for finding in check_mission(mission) if finding.item == "flown")


def test_check_shows_the_record_and_notices_that_the_mission_changed(
    planned: QuickestResult, tmp_path: Path
) -> None:
    path = tmp_path / "mission.yaml"
    mission = written(planned, by_kind(free=20.0, colliding=18.5), path)
    finding = flown_finding(mission)
    assert (finding.go, finding.remark) == (True, False)
    assert mission.flown is not None
    assert mission.flown.summary == (
        "20 of 20 drawn flights complete, 0 uncontrolled, 18.5 s from take-off to landing "
        "against 20.0 s without collisions: saves 1.50 s"
    )
    assert finding.says.endswith(f": {mission.flown.summary}")
    assert f"Flown in simulation: {mission.flown.summary}." in prediction_lines(
        mission, predict_mission(mission), []
    )
    assert finding.figures == {"flights": 20, "completed": 20, "saving_s": 1.5}
    assert dart_flight.load_mission(mission.to_dict()).flown == mission.flown
    assert not flown_finding(with_driver(mission, LockDriver.PX4)).remark, "the driver flies nothing else"
    for changed in (
        dart_flight.load_mission(path, settings=["airframe.mass_kg=1.5"]),
        mission.replace({"goal.hold_s": 3.0}),
    ):
        assert "has changed since" in flown_finding(changed).says
        assert flown_finding(changed).remark


def test_check_refuses_a_mission_that_was_uncontrolled_in_simulation(
    planned: QuickestResult, tmp_path: Path
) -> None:
    mission = written(planned, by_kind(free=20.0, colliding=18.5), tmp_path / "mission.yaml")
    assert mission.flown is not None
    assert mission.flown.drawn is not None
    bad = msgspec.structs.replace(mission.flown.drawn, uncontrolled=1)
    record = msgspec.structs.replace(mission.flown, drawn=bad)
    finding = flown_finding(msgspec.structs.replace(mission, flown=record))
    assert not finding.go
    assert "1 of 20 drawn flights are uncontrolled" in finding.says
    assert msgspec.structs.replace(mission, flown=record).digest == mission.digest


def test_check_remarks_that_a_mission_was_never_flown() -> None:
    finding = flown_finding(dart_flight.load_mission(dart_flight.packaged("missions", "single_wall.yaml")))
    assert finding.go
    assert finding.remark
    assert "no simulated flight of this mission is on record" in finding.says


def test_a_record_that_cannot_be_is_refused(planned: QuickestResult, tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    written(planned, by_kind(free=20.0, colliding=18.5), path)
    path.write_text(path.read_text().replace("uncontrolled: 0", "uncontrolled: -1"))
    with pytest.raises(InputError, match="uncontrolled"):
        dart_flight.load_mission(path)


# --- flown indeed --------------------------------------------------------------------------------------


def test_the_command_flies_its_plan(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flown_plan, "DRAWN", 2)
    monkeypatch.setattr(flown_plan, "fly_fast_many", in_process)
    scenario, target = tmp_path / "scenario.yaml", tmp_path / "mission.yaml"
    scenario.write_text(WRITTEN)
    assert main(["plan", str(scenario), "--json", "-o", str(target)]) == 0
    said = json.loads(capsys.readouterr().out)
    mission = dart_flight.load_mission(target)
    assert mission.flown is not None
    assert mission.flown.drawn is not None
    assert mission.flown.drawn.flights == 2
    assert mission.flown.digest == mission.digest
    records = said["flown"]
    assert records["free"]["nominal"]["outcome"] == "completed"
    again = dart_flight.simulate(mission, seed=FIRST_SEED).verdict
    assert again.flight_time_s == pytest.approx(mission.flown.nominal.time_s, abs=1e-3)


def in_process(mission: Mission, seeds: Any, log_dir: Any, done: Any, spreads: Any) -> list[Verdict]:
    return flown_plan.fly_in_process(mission, list(seeds), spreads, done)


def test_without_verification_the_command_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenario, target = tmp_path / "scenario.yaml", tmp_path / "mission.yaml"
    scenario.write_text(WRITTEN)
    assert main(["plan", str(scenario), "-o", str(target), "--no-verify"]) == 0
    assert "not flown in simulation (--no-verify)" in capsys.readouterr().out
    assert dart_flight.load_mission(target).flown is None
