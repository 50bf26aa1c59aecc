"""Limits of guard height and incidence from docs/results/body.md in `check`, the planner and warnings."""

import math

import msgspec
import pytest

from dart_flight.base.records import Mode
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.lab.search.scenario import load_scenario
from dart_flight.lab.search.search import search
from dart_flight.planning.constraints import Refusal
from dart_flight.planning.envelope import heights_flown_m, impact_warnings, incidence_deg
from tests.mission_findings import check_mission

DUAL = load_mission(packaged("missions", "paper_dual_collision.yaml"))


def with_second_wall_turned(angle_deg: float, mode: Mode) -> Mission:
    first, second = DUAL.collisions
    wall = second.wall.rotated(math.radians(angle_deg))
    collision = msgspec.structs.replace(second, wall=wall, mode=mode)
    return msgspec.structs.replace(DUAL, walls=(first.wall, wall), collisions=(first, collision))


@pytest.mark.parametrize(
    ("angle_deg", "planned_deg"), [(0.0, 0.0), (20.0, 20.0), (-20.0, 20.0), (60.0, 30.0)]
)
def test_incidence_after_a_recovery_uses_the_heading_of_the_previous_approach(
    angle_deg: float, planned_deg: float
) -> None:
    mission = with_second_wall_turned(angle_deg, Mode.RIGID)
    assert [incidence_deg(mission, c) for c in mission.collisions] == pytest.approx([0.0, planned_deg])


@pytest.mark.parametrize(
    ("angle_deg", "mode", "warns"),
    [
        (10.0, Mode.FLEXIBLE, False),
        (20.0, Mode.FLEXIBLE, True),
        (20.0, Mode.RIGID, False),
        (40.0, Mode.RIGID, True),
    ],
)
def test_check_rejects_an_incidence_beyond_the_limit_of_the_mode(
    angle_deg: float, mode: Mode, warns: bool
) -> None:
    mission = with_second_wall_turned(angle_deg, mode)
    found = [f for f in check_mission(mission) if f.item == "incidence_2"]
    assert [f.go for f in found] == ([False] if warns else [])
    assert any("incidence" in line for line in impact_warnings(mission)) is warns


@pytest.mark.parametrize(("height_m", "warns"), [(0.0, False), (-0.03, False), (-0.04, True), (0.06, True)])
def test_guards_above_or_below_the_centre_of_mass_are_warned_of_at_the_impact_speed(
    height_m: float, warns: bool
) -> None:
    settings = [f"simulation.contact.guard_height_m={height_m}"]
    mission = load_mission(
        packaged("missions", "paper_single_wall.yaml"), settings=settings
    )  # impact at 1 m/s
    assert any("turn the vehicle over" in line for line in impact_warnings(mission)) is warns
    point = load_mission(
        packaged("missions", "paper_single_wall.yaml"), settings=[*settings, "simulation.contact.body=point"]
    )
    assert not any("turn the vehicle over" in line for line in impact_warnings(point))


def test_the_permitted_guard_height_below_the_centre_shrinks_with_speed() -> None:
    heights = [heights_flown_m(speed) for speed in (0.3, 0.8, 1.5, 2.5, 9.0)]
    assert [below for below, _ in heights] == sorted((below for below, _ in heights), reverse=True)
    assert all(math.isfinite(above) and above > 0.0 for _, above in heights)


def test_the_planner_refuses_a_recovery_into_a_wall_at_excessive_incidence() -> None:
    scenario = load_scenario(packaged("missions", "scenarios", "dual_collision.yaml"))
    walls = scenario.walls | {"acrylic": scenario.walls["acrylic"].rotated(math.radians(25.0))}
    found = search(msgspec.structs.replace(scenario, walls=walls))
    assert found.refused[Refusal.INCIDENCE] > 0
    assert all(plan.collisions[1].mode is Mode.RIGID for plan in found.plans)
