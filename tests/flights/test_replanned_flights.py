"""Flights that replan after every collision, with a planner in time and a late one."""

import math
from pathlib import Path

import msgspec
import pytest
import yaml

from dart_flight import simulate
from dart_flight.base.records import (
    AfterImpact,
    GoalPassed,
    Outcome,
    Phase,
    PhaseChange,
    PlanTaken,
    Record,
    Setpoint,
)
from dart_flight.config.document import Document
from dart_flight.config.mission import load_mission, parse_mission
from dart_flight.config.vehicle import packaged
from dart_flight.recording.reader import read_log
from dart_flight.recording.verdict import Verdict
from dart_flight.run.fast import FastFlight
from tests.shared_flights import SharedFlights

SOURCE = packaged("missions", "dual_collision_replan.yaml")


def fly(settings: list[str], after: AfterImpact = AfterImpact.REPLAN, source: Path = SOURCE) -> list[Record]:
    mission = msgspec.structs.replace(load_mission(source, settings=settings), after_impact=after)
    records: list[Record] = []
    flight = FastFlight(mission, 5, observe=lambda record, number: records.append(record))
    flight.run()
    assert flight.core.end is not None
    assert flight.core.end.outcome is Outcome.COMPLETED
    return records


def test_a_replanned_flight_follows_its_plan(flown: SharedFlights) -> None:
    flight = flown("dual_collision_replan", 1)
    verdict = flight.verdict
    assert verdict.outcome is Outcome.COMPLETED
    assert verdict.plan_followed
    assert verdict.goal_miss_m is not None
    assert verdict.goal_miss_m < 0.05
    second = verdict.collisions[1]
    assert second.truth is not None
    assert second.truth.normal_m_s == pytest.approx(second.planned.normal_m_s, abs=0.1)
    log = read_log(flight.log)
    plans = [entry.record for entry in log.entries if isinstance(entry.record, PlanTaken)]
    assert [plan.taken for plan in plans] == [True, True]


@pytest.mark.rest
def test_a_late_planner_leaves_the_papers_setpoints_in_force() -> None:
    paper = fly([], AfterImpact.SETPOINT)
    late = fly(["simulation.replan_latency_s=0.11"])
    assert not any(record.taken for record in late if isinstance(record, PlanTaken))

    def setpoints(records: list[Record]) -> list[Setpoint]:
        return [record for record in records if isinstance(record, Setpoint)]

    assert setpoints(late) == setpoints(paper)


@pytest.mark.rest
def test_a_vehicle_without_its_trajectory_to_the_goal_waits_before_it_holds_a_passed_goal() -> None:
    """The trajectory may still arrive: in a mission with one, the wait is 1.5 s from the peak, not 0.25 s."""
    source = packaged("missions", "limited_sight.yaml")
    records = fly(["simulation.replan_latency_s=3.0"], source=source)
    (passed,) = (record for record in records if isinstance(record, GoalPassed))
    changes = [record for record in records if isinstance(record, PhaseChange)]
    began = [change.t_us for change in changes if change.after is Phase.RECOVERY][-1]
    assert not passed.timed_out
    assert 1.5 <= (passed.t_us - began) * 1e-6 < 1.6


@pytest.mark.rest
def test_a_shuttle_meets_rotated_walls_obliquely_only_at_the_first_contacts() -> None:
    """The first contacts measure the rotated walls, so later contacts are nearly perpendicular."""
    mission = load_mission(packaged("missions", "shuttle.yaml"))
    flight = simulate(mission, seed=101, vary={"wall_yaw_deg": 4.0})
    drawn = [abs(float(value)) for value in flight.verdict.drawn.values()]
    assert max(drawn) > 2.0
    assert flight.verdict.outcome is Outcome.COMPLETED
    incidence = [math.degrees(abs(angle)) for angle in flight.log["/truth/contact"]["incidence_rad"]]
    assert len(incidence) == 6
    assert max(incidence[:2]) < 13.0
    assert max(incidence[2:]) < 4.0


@pytest.mark.rest
def test_a_first_touch_prevents_a_later_collision_from_turning_the_vehicle_over() -> None:
    """Guards off the centre of mass turn over a vehicle that has not measured their torque before."""
    path = packaged("missions", "touch_and_return.yaml")
    text, guards = path.read_text(encoding="utf-8"), "simulation.contact.guard_height_m=-0.03"

    def fly_text(mission: str) -> Verdict:
        return simulate(parse_mission(Document(mission, str(path)), settings=[guards]), seed=1).verdict

    touched = fly_text(text)
    assert touched.outcome is Outcome.COMPLETED
    assert touched.max_tilt_deg is not None
    assert touched.max_tilt_deg < 35.0
    tree = yaml.safe_load(text)
    tree["collisions"] = [hit for hit in tree["collisions"] if "trajectory" in hit]
    del tree["waypoints"]
    assert fly_text(yaml.safe_dump(tree)).outcome is Outcome.ABORTED
