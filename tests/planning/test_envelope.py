"""Limits of guard height and incidence from docs/results/tumbles.md in `check`, the planner and warnings."""

import math

import msgspec
import pytest

from dart_flight.base.records import Mode
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import load_vehicle, packaged
from dart_flight.lab.search.scenario import load_scenario
from dart_flight.lab.search.search import search
from dart_flight.planning.constraints import Refusal
from dart_flight.planning.envelope import (
    HEIGHT_SURE_SD,
    height_warning,
    heights_flown_m,
    impact_warnings,
    incidence_deg,
    speed_warning,
)
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


def with_guards(height_m: float, sd_m: float, *more: str) -> Mission:
    settings = [
        f"simulation.contact.guard_height_m={height_m}",
        f"simulation.contact.guard_height_sd_m={sd_m}",
    ]
    return load_mission(packaged("missions", "paper_single_wall.yaml"), settings=[*settings, *more])


@pytest.mark.parametrize("sd_m", [0.0, 0.01])
@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize(("beyond_m", "warns"), [(-0.002, False), (0.002, True)])
def test_the_height_of_the_guards_and_its_scatter_are_judged_at_the_impact_speed(
    sd_m: float, side: float, beyond_m: float, warns: bool
) -> None:
    below, above = heights_flown_m(DUAL.vehicle, 1.0, Mode.FLEXIBLE)  # the speed of the mission
    height_m = side * ((below if side < 0.0 else above) - HEIGHT_SURE_SD * sd_m + beyond_m)
    mission = with_guards(height_m, sd_m)
    assert any("turn the vehicle over" in line for line in impact_warnings(mission)) is warns
    assert any(not f.go for f in check_mission(mission) if f.item == "guard_height_1") is warns
    point = with_guards(height_m, sd_m, "simulation.contact.body=point")
    assert not any("turn the vehicle over" in line for line in impact_warnings(point))


@pytest.mark.parametrize("mode", list(Mode))
def test_the_permitted_guard_height_below_the_centre_shrinks_with_speed(mode: Mode) -> None:
    heights = [heights_flown_m(DUAL.vehicle, speed, mode) for speed in (0.3, 0.8, 1.7, 2.4, 9.0)]
    assert [below for below, _ in heights] == sorted((below for below, _ in heights), reverse=True)
    assert all(math.isfinite(above) and above > 0.0 for _, above in heights)


@pytest.mark.parametrize(
    ("name", "normal_m_s", "stayed_m", "turned_m"),
    [
        ("ring_guard_250g", 0.8, 0.03, 0.04),
        ("ring_guard_250g", 1.25, 0.01, 0.02),
        ("ring_guard_250g", 2.0, 0.0, 0.005),
        ("rigid_cage", 1.0, 0.05, 0.08),
        ("rigid_cage", 1.5, 0.03, 0.04),
        ("rigid_cage", 2.0, 0.01, 0.02),
        ("hexarotor", 1.5, 0.05, math.inf),
    ],
)
def test_a_vehicle_that_rotates_more_easily_has_lower_limits(
    name: str, normal_m_s: float, stayed_m: float, turned_m: float
) -> None:
    """The flights of docs/results/guard_height.md stayed below 60 degrees of tilt, or turned over."""
    below, _ = heights_flown_m(load_vehicle(packaged("configs", f"{name}.yaml")), normal_m_s, Mode.RIGID)
    assert stayed_m <= below < turned_m


@pytest.mark.parametrize("name", ["ring_guard_250g", "rigid_cage"])
@pytest.mark.parametrize(("normal_m_s", "go"), [(None, True), (2.0, False)])
def test_a_small_vehicle_may_hit_as_slowly_as_its_mission(
    name: str, normal_m_s: float | None, go: bool
) -> None:
    mission = load_mission(packaged("missions", name, "single_wall.yaml"))
    hit = mission.collisions[0]
    faster = hit if normal_m_s is None else msgspec.structs.replace(hit, approach_m_s=(-normal_m_s, 0.0))
    assert (height_warning(mission, faster) is None) is go


def test_a_fast_hit_is_refused_without_a_touch_and_let_go_after_one() -> None:
    """A touch measures the height, and on a trajectory the vehicle leans against it."""
    touched = load_mission(packaged("missions", "limited_sight.yaml"))
    assert touched.collisions[-1].trajectory is not None
    assert not [f for f in check_mission(touched) if f.item == "guard_height_2"]
    only_fast = msgspec.structs.replace(touched, collisions=touched.collisions[1:])
    assert height_warning(only_fast, only_fast.collisions[0]) is not None


@pytest.mark.parametrize(("normal_m_s", "go"), [(1.6, True), (1.9, False)])
def test_a_predicted_second_impact_is_judged_too(normal_m_s: float, go: bool) -> None:
    second = DUAL.collisions[1]
    assert second.approach_m_s is None
    warning = height_warning(DUAL, second, (-normal_m_s, 0.2))
    assert (warning is None) is go
    assert (speed_warning(second, (-3.2, 0.0)) is None) is False


def test_the_planner_refuses_a_recovery_into_a_wall_at_excessive_incidence() -> None:
    scenario = load_scenario(packaged("missions", "scenarios", "dual_collision.yaml"))
    walls = scenario.walls | {"acrylic": scenario.walls["acrylic"].rotated(math.radians(25.0))}
    found = search(msgspec.structs.replace(scenario, walls=walls))
    assert found.refused[Refusal.INCIDENCE] > 0
    assert all(plan.collisions[1].mode is Mode.RIGID for plan in found.plans)
