"""Flights that plan again after every hit, and what becomes of them where the planner fails."""

import math
from pathlib import Path

import msgspec
import pytest
import yaml

from dart_flight import simulate
from dart_flight.base.records import AfterImpact, Outcome, PlanTaken, Record, Setpoint
from dart_flight.config.document import Document
from dart_flight.config.mission import load_mission, parse_mission
from dart_flight.config.vehicle import LockDriver, packaged
from dart_flight.recording.reader import read_log
from dart_flight.recording.verdict import Verdict
from dart_flight.run.fast import FastFlight, fly_fast
from dart_flight.run.replay import replay

SOURCE = packaged("missions", "dual_collision_replan.yaml")


def flown(settings: list[str], after: AfterImpact = AfterImpact.REPLAN) -> list[Record]:
    mission = msgspec.structs.replace(load_mission(SOURCE, settings=settings), after_impact=after)
    records: list[Record] = []
    flight = FastFlight(mission, 5, LockDriver.MOCK, observe=lambda record, number: records.append(record))
    flight.run()
    assert flight.core.end is not None
    assert flight.core.end.outcome is Outcome.COMPLETED
    return records


def test_a_replanned_flight_follows_the_plan_and_replays_bit_for_bit(tmp_path: Path) -> None:
    verdict = fly_fast(load_mission(SOURCE), 5, tmp_path)
    assert verdict.outcome is Outcome.COMPLETED
    assert verdict.plan_followed
    assert verdict.goal_miss_m is not None
    assert verdict.goal_miss_m < 0.05
    second = verdict.collisions[1]
    assert second.truth is not None
    assert second.truth.normal_m_s == pytest.approx(second.planned.normal_m_s, abs=0.1)
    log = read_log(next(tmp_path.glob("*/flight.mcap")))
    taken = [entry.record for entry in log.entries if isinstance(entry.record, PlanTaken)]
    assert [one.taken for one in taken] == [True, True]
    assert replay(log).equal


@pytest.fixture(scope="module")
def paper() -> list[Record]:
    """The flight on the paper's setpoints."""
    return flown([], AfterImpact.SETPOINT)


@pytest.mark.parametrize("latency_s", [0.11, 3.0])
def test_a_late_planner_leaves_the_paper_s_set_points_in_force(latency_s: float, paper: list[Record]) -> None:
    late = flown([f"simulation.replan_latency_s={latency_s}"])
    assert not any(one.taken for one in late if isinstance(one, PlanTaken))

    def setpoints(records: list[Record]) -> list[Setpoint]:
        return [record for record in records if isinstance(record, Setpoint)]

    assert setpoints(late) == setpoints(paper)


@pytest.mark.parametrize("seed", [101])  # more of them: docs/results
def test_walls_askew_turn_a_shuttle_only_when_touched(seed: int) -> None:
    """What the touches have told of the walls is made use of: no hit is askew."""
    mission = load_mission(packaged("missions", "shuttle.yaml"))
    flight = simulate(mission, seed=seed, vary={"wall_yaw_deg": 4.0})
    drawn = [abs(float(value)) for value in flight.verdict.drawn.values()]
    assert max(drawn) > 2.0
    assert flight.verdict.outcome is Outcome.COMPLETED
    incidence = [math.degrees(abs(one)) for one in flight.log["/truth/contact"]["incidence_rad"]]
    assert len(incidence) == 6
    assert max(incidence[:2]) < 13.0
    assert max(incidence[2:]) < 4.0


@pytest.mark.parametrize("height_m", [-0.03, 0.03])
def test_a_touch_lets_the_next_hit_from_rest_be_leaned_into(height_m: float) -> None:
    """Guards off the centre of mass turn a vehicle over that has not felt them before."""
    path = packaged("missions", "touch_and_return.yaml")
    text, guards = path.read_text(encoding="utf-8"), f"simulation.contact.guard_height_m={height_m}"

    def flown_as(written: str) -> Verdict:
        return simulate(parse_mission(Document(written, str(path)), settings=[guards]), seed=1).verdict

    touched = flown_as(text)
    assert touched.outcome is Outcome.COMPLETED
    assert touched.max_tilt_deg is not None
    assert touched.max_tilt_deg < 35.0
    tree = yaml.safe_load(text)
    tree["collisions"] = [hit for hit in tree["collisions"] if "trajectory" in hit]
    del tree["waypoints"]
    assert flown_as(yaml.safe_dump(tree)).outcome is Outcome.ABORTED
