"""Impacts at 3 m/s, planned, drawn and flown as in the campaign of faster hits."""

from pathlib import Path

import msgspec
import pytest

from dart_flight.base.records import PlanRequest, Record
from dart_flight.config.mission import load_mission
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.planning.replanner import Replanner
from dart_flight.run.fast import FastFlight
from dart_flight.sim.draws import DrawnWorld
from tests.shared_campaigns import campaign_rows

MISSION = Path(__file__).parents[2] / "data" / "faster_hit.yaml"  # 3 m/s with flexible arms


@pytest.mark.rest
def test_a_vehicle_recovers_from_an_impact_at_3_m_s_after_a_touch(tmp_path: Path) -> None:
    options = ["--only", "mode=flexible", "--only", "normal_m_s=3.0", "--only", "touch_m_s=0.6"]
    options += ["--only", "incidence_deg=drawn", "--seed", "13001", "--runs", "1"]
    rows = campaign_rows(tmp_path / "out", "faster_hits", *options)
    (row,) = rows
    assert row["recovered"]
    assert row["problems"] == []
    assert row["closing_m_s"] == pytest.approx(3.0, abs=0.2)
    assert row["exit_m_s"] > 1.0
    assert row["tilt_deg"] < 60.0


@pytest.mark.parametrize("height_m", [-0.03, pytest.param(0.03, marks=pytest.mark.rest)])
def test_a_touch_gives_the_height_of_the_guards(height_m: float) -> None:
    """If the height is unknown, guards 3 cm off the centre of mass cause a rollover at 3 m/s."""
    requests: list[PlanRequest] = []

    def observe(record: Record, number: int) -> None:
        if isinstance(record, PlanRequest):
            requests.append(record)

    mission = load_mission(MISSION)
    simulation = mission.vehicle.simulation
    contact = msgspec.structs.replace(simulation.contact, guard_height_m=height_m)
    simulation = msgspec.structs.replace(simulation, contact=contact)
    vehicle = msgspec.structs.replace(mission.vehicle, simulation=simulation)
    world = DrawnWorld(msgspec.structs.replace(mission, vehicle=vehicle), None, {})
    FastFlight(mission, 1, observe=observe, world=world).run()
    to_wall = requests[0]
    assert to_wall.collision == 2
    to_goal = requests[-1]
    assert to_goal.collision is None
    assert to_wall.contact_height_m is not None
    assert to_wall.contact_height_m == pytest.approx(height_m, abs=0.008)
    assert to_goal.contact_height_m is None
    replanner, wall = Replanner(mission), mission.walls[0]
    pushes = []
    for known_m in (None, to_wall.contact_height_m):
        request = msgspec.structs.replace(to_wall, contact_height_m=known_m)
        answer = replanner.answer(request)
        assert answer.problem == ""
        trajectory = Trajectory.from_plan(answer, mission.altitude_m)
        end = trajectory.at(trajectory.duration_s - 1e-6)
        assert wall.to_collision(end.velocity)[0] == pytest.approx(-3.0, abs=1e-3)
        pushes.append(wall.to_collision(end.acceleration)[0])
    # With guards above the centre of mass, the vehicle leans into the wall by 0.9 g h / d.
    assert pushes[1] - pushes[0] == pytest.approx(-44.1 * to_wall.contact_height_m, abs=0.02)
