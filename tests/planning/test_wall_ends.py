"""The margin of impacts and paths from a wall's ends: half a vehicle plus the wall's position uncertainty."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.walls import Wall
from dart_flight.check.findings import CheckFinding
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission.approach import is_blocked
from dart_flight.core.mission.wall_uncertainty import SURE_SD, end_margin_m
from dart_flight.lab.search.scenario import load_scenario
from dart_flight.lab.search.search import search
from tests.mission_findings import check_mission

HALF_M = 0.2  # contact distance of the packaged vehicle


def mission_with_impact(from_end_m: float, **wall: float) -> Mission:
    """Return the single-wall mission with a door of 1.6 m and an impact at a distance from its end."""
    mission = load_mission(packaged("missions", "paper_single_wall.yaml"))
    hit = mission.collisions[0].impact_point
    assert hit is not None
    door = msgspec.structs.replace(
        mission.walls[0], length_m=1.6, point=(hit[0], hit[1] + 0.8 - from_end_m), **wall
    )
    collision = msgspec.structs.replace(mission.collisions[0], wall=door)
    return msgspec.structs.replace(mission, walls=(door,), collisions=(collision,))


def wall_end_finding(mission: Mission) -> CheckFinding:
    return next(f for f in check_mission(mission) if f.item == "wall_end")


def test_an_impact_sixteen_millimetres_from_the_end_of_a_door_is_no_go() -> None:
    finding = wall_end_finding(mission_with_impact(0.016))
    assert not finding.go
    assert finding.figures == pytest.approx({"distance_m": 0.016, "margin_m": HALF_M})
    assert "0.02 m from the wall's end, minimum half a vehicle (0.20 m)" in finding.message
    assert wall_end_finding(mission_with_impact(HALF_M + 0.01)).go
    assert "at this place not all guards touch the wall" in finding.message
    assert "guards" not in wall_end_finding(mission_with_impact(HALF_M - 0.01)).message


def test_the_uncertainty_of_a_walls_position_widens_its_end_margin() -> None:
    assert wall_end_finding(mission_with_impact(0.45)).go
    finding = wall_end_finding(mission_with_impact(0.45, position_sd_m=0.1))
    assert not finding.go
    assert finding.figures["margin_m"] == pytest.approx(HALF_M + SURE_SD * 0.1)


@pytest.mark.parametrize("name", ["dual_collision", "any_walls"])
def test_plans_keep_the_margin_from_the_ends_of_walls(name: str) -> None:
    scenario = load_scenario(packaged("missions", "scenarios", f"{name}.yaml"))
    plans = search(scenario, top=300).plans
    assert len(plans) > 100
    for plan in plans:
        for c in plan.collisions:
            wall = scenario.walls[c.wall]
            assert wall.end_distance_m(c.position_m) >= end_margin_m(wall, c.position_m) - 1e-6


@given(st.floats(-1.5, 1.5), st.floats(0.0, 0.1))
def test_a_path_is_blocked_within_the_margin_of_a_walls_end(y: float, sd: float) -> None:
    wall = Wall("door", (1.0, 0.0), (-1.0, 0.0), 1.6, "wood", sd, None, HALF_M)
    beside = abs(y) - 0.8 - HALF_M - SURE_SD * sd
    if abs(beside) > 1e-9:
        assert is_blocked(wall, (0.0, y), (2.0, y)) == (beside < 0.0)
