"""Walls displaced from the mission's survey, with and without standard deviations in the mission."""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest

from dart_flight.base.geometry import distance2
from dart_flight.base.records import WallEstimate, World
from dart_flight.check.findings import CheckFinding
from dart_flight.config.document import Document
from dart_flight.config.mission import Mission, load_mission, parse_mission
from dart_flight.core.mission.approach import plan_approach, standoff_point
from dart_flight.core.mission.wall_uncertainty import SURE_SD
from dart_flight.lab.search.mission_writer import write_mission
from dart_flight.lab.search.plan_table import with_objective
from dart_flight.lab.search.scenario import Objective, Scenario, load_scenario
from dart_flight.lab.search.search import draws_of, search
from dart_flight.planning.constraints import Constraints
from dart_flight.planning.rollout import Rollout, new_flight, stages_for
from dart_flight.recording.about import flown_mission
from dart_flight.recording.reader import read_log
from dart_flight.recording.verdict import Verdict
from dart_flight.run.fast import FastFlight
from dart_flight.run.flight_record import FlightRecord
from dart_flight.run.prepare import as_rehearsal
from dart_flight.sim.draws import DrawnWorld, draw_world
from tests.mission_findings import check_mission
from tests.watched_flight import place_walls

ROOT = Path(__file__).parents[2]
SINGLE = (ROOT / "missions/paper_single_wall.yaml").read_text()
POINT = "point_m: [1.65, 0.5]"
BESIDE = "point_m: [1.65, -0.5], normal: [-1.0, 0.0], length_m: 4.0"


def rest(*values: object) -> Any:
    """Return a row of parameters that only `make test-rest` runs."""
    return pytest.param(*values, marks=pytest.mark.rest)


def single(*changes: tuple[str, str]) -> Mission:
    text = SINGLE
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    return parse_mission(Document(text, str(ROOT / "missions/x.yaml")))


# --- run-ups ----------------------------------------------------------------------------------------------


def test_the_run_up_to_an_uncertain_wall_begins_earlier() -> None:
    # The start is too near the wall, so the run-up begins farther back.
    near = ("start: {position_m: [0.0, 0.0]", "start: {position_m: [0.8, 0.4]")
    room = ("bounds_m: {x: [-1.5", "bounds_m: {x: [-3.5")
    one = single(near, room)
    other = single(near, room, (POINT, f"{POINT}, position_sd_m: 0.06"))
    approaches = [plan_approach(m, m.collisions[0]) for m in (one, other)]
    impacts = [m.collisions[0].impact_point or (0.0, 0.0) for m in (one, other)]
    lengths = [distance2(a.begin[:2], impact) for a, impact in zip(approaches, impacts, strict=True)]
    assert lengths[1] - lengths[0] == pytest.approx(SURE_SD * 0.06 * math.hypot(1.0, 0.5))


# --- flights ----------------------------------------------------------------------------------------------


class Displaced(NamedTuple):
    """A flight to a displaced wall, and its estimates of walls."""

    verdict: Verdict
    estimates: list[WallEstimate]


@functools.cache
def fly(name: str, wall_figures: str, away_m: float = 0.0, rotated_deg: float = 0.0) -> Displaced:
    """Fly a mission whose acrylic wall is displaced or rotated from its place in the mission."""
    path = ROOT / f"missions/{name}.yaml"
    text = path.read_text()
    if rotated_deg:  # rotate about the wall's middle, 1.3 m beside the impact point
        text = text.replace("point_m: [1.65, 0.5], normal: [-1.0, 0.0], length_m: 3.0", BESIDE)
    end = text.index("}", text.index("  acrylic: {"))
    mission = parse_mission(
        Document(f"{text[:end]}, {wall_figures}{text[end:]}" if wall_figures else text, str(path))
    )
    world = place_walls(DrawnWorld(mission, None, {}), {"acrylic": away_m}, {"acrylic": rotated_deg})
    record, estimates = FlightRecord(mission, World.FAST, 5, None), list[WallEstimate]()
    record.onlookers.append(lambda r: estimates.append(r) if isinstance(r, WallEstimate) else None)
    FastFlight(mission, 5, observe=record, world=world).run()
    record.close()
    return Displaced(record.build(), estimates)


@pytest.mark.parametrize(("away_m", "sd_m"), [rest(0.12, 0.06), (-0.27, 0.1), (0.27, 0.1)])
def test_a_displaced_wall_with_a_standard_deviation_is_hit_as_planned_and_located(
    away_m: float, sd_m: float
) -> None:
    verdict, (estimate,) = fly("paper_single_wall", f"position_sd_m: {sd_m}", away_m)
    assert verdict.outcome == "completed", verdict.reason
    (hit,) = verdict.collisions
    assert hit.truth is not None
    assert hit.truth.normal_m_s == pytest.approx(-1.0, abs=0.05)
    assert estimate.plane_offset_m == pytest.approx(
        away_m, abs=max(0.03, 3.0 * estimate.plane_offset_sigma_m)
    )
    assert estimate.plane_offset_sigma_m < 0.05


@pytest.mark.parametrize(
    ("away_m", "yaw_deg", "rule"),
    [(-0.27, 0.0, "wall_not_met"), (0.27, 0.0, "wall_met_early"), rest(0.0, -8.0, "wall_not_met")],
)
def test_an_approach_to_a_displaced_wall_without_standard_deviations_is_aborted(
    away_m: float, yaw_deg: float, rule: str
) -> None:
    verdict, _ = fly("paper_single_wall", "", away_m, yaw_deg)
    assert verdict.outcome == "aborted"
    assert (verdict.reason or "").startswith(rule)


@pytest.mark.parametrize("yaw_deg", [-8.0, rest(12.0)])
def test_a_rotated_wall_is_hit_away_from_its_middle(yaw_deg: float) -> None:
    verdict, _ = fly("paper_single_wall", "yaw_sd_deg: 4.0", 0.0, yaw_deg)
    assert verdict.outcome == "completed", verdict.reason


@pytest.mark.parametrize("away_m", [-0.25, rest(0.27)])
def test_a_replanned_trajectory_reaches_a_displaced_wall(away_m: float) -> None:
    verdict, _ = fly("dual_collision_replan", "position_sd_m: 0.1", away_m)
    assert verdict.outcome == "completed", verdict.reason
    second = verdict.collisions[1]
    assert second.truth is not None
    assert second.truth.normal_m_s == pytest.approx(second.planned.normal_m_s, abs=0.1)


def test_a_rehearsal_keeps_its_standoff_from_the_nearest_possible_wall() -> None:
    for figures, wanted in (
        ("length_m: 3.0", 0.5),
        ("length_m: 3.0, position_sd_m: 0.06", 0.5 + SURE_SD * 0.06),
    ):
        mission = as_rehearsal(single(("length_m: 3.0", figures)), 0.5)
        (collision,) = mission.collisions
        approach = plan_approach(mission, collision)
        assert collision.impact_point is not None
        stop = standoff_point(mission, collision, approach.begin[:2], collision.impact_point)
        assert collision.wall.signed_distance(stop) == pytest.approx(wanted)


# --- draws ------------------------------------------------------------------------------------------------


def test_a_walls_own_standard_deviations_override_the_general_ones() -> None:
    own = single((POINT, f"{POINT}, position_sd_m: 0.2, yaw_sd_deg: 1.0"))
    spreads = {"wall_offset_m": 0.05, "wall_yaw_deg": 4.0}
    for seed in range(3):
        general, drawn = (draw_world(m, seed, spreads).drawn for m in (single(), own))
        for name, factor in (("wall_offset_m.acrylic", 4.0), ("wall_yaw_deg.acrylic", 0.25)):
            assert drawn[name] == pytest.approx(factor * float(general[name]))
    assert draw_world(own, 1, {"mass": 0.1}).mission.walls == own.walls  # walls are varied only on request


def uncertain_scenario(name: str, **figures: float) -> Scenario:
    scenario = with_objective(load_scenario(ROOT / f"missions/scenarios/{name}.yaml"), Objective.ROBUST)
    walls = {n: msgspec.structs.replace(w, **figures) for n, w in scenario.walls.items()}
    return msgspec.structs.replace(
        scenario,
        walls=walls,
        normal_m_s=scenario.normal_m_s[::4],
        tangential_m_s=scenario.tangential_m_s[::3],
    )


def test_the_robust_objective_includes_the_walls_uncertainty() -> None:
    without_sd, with_sd = (
        search(uncertain_scenario("one_wall", **f), top=1, seed=3).plans[0]
        for f in ({}, {"position_sd_m": 0.1})
    )
    assert without_sd.worst_miss_m is not None
    assert with_sd.worst_miss_m is not None
    assert with_sd.worst_miss_m > without_sd.worst_miss_m + 0.05
    assert all(draw.walls for draw in draws_of(uncertain_scenario("one_wall", yaw_sd_rad=0.05), 1))
    assert not any(draw.walls for draw in draws_of(uncertain_scenario("one_wall"), 1))


@pytest.mark.parametrize("away_m", [-0.1, 0.1])
def test_a_draws_displaced_wall_is_hit_like_a_wall_planned_there(away_m: float) -> None:
    scenario = uncertain_scenario("one_wall")
    (sequence, *_) = scenario.sequences
    name = sequence[0]
    displaced = msgspec.structs.replace(
        scenario, walls=scenario.walls | {name: scenario.walls[name].displaced(away_m)}
    )
    vn, vt = np.array([-0.8, -1.0]), np.array([0.2, 0.0])
    flight, stages = new_flight(scenario), stages_for(displaced, [None])[0]
    planned = Rollout(scenario, sequence, flight, Constraints(scenario)).approach(vn, vt)
    direct = Rollout(displaced, sequence, flight, Constraints(displaced), True)
    found = direct.fly(stages, vn, vt, planned)
    wanted = direct.fly(stages, vn, vt, direct.approach(vn, vt))
    assert found
    for a, b in zip(found, wanted, strict=True):
        assert a.modes == b.modes
        assert a.miss_m == pytest.approx(b.miss_m)
        assert a.hits[0].x == pytest.approx(b.hits[0].x)
        assert a.hits[0].normal_m_s == pytest.approx(b.hits[0].normal_m_s)


def test_a_written_plan_keeps_the_walls_standard_deviations(tmp_path: Path) -> None:
    path = ROOT / "missions/scenarios/one_wall.yaml"
    scenario = load_scenario(path)
    name = scenario.sequences[0][0]
    spec = msgspec.structs.replace(
        scenario.spec,
        walls=scenario.spec.walls
        | {name: msgspec.structs.replace(scenario.spec.walls[name], position_sd_m=0.04)},
    )
    found = search(msgspec.structs.replace(scenario, spec=spec), top=1)
    write_mission(found.scenario, found.plans[0], tmp_path / "planned.yaml")
    planned = load_mission(tmp_path / "planned.yaml")
    assert [(w.name, w.position_sd_m, w.yaw_sd_rad) for w in planned.walls if w.name == name] == [
        (name, 0.04, None)
    ]


# --- check ------------------------------------------------------------------------------------------------


def no_goes(findings: list[CheckFinding]) -> dict[str, str]:
    return {f.item: f.message for f in findings if not f.go}


@pytest.mark.parametrize(
    ("figures", "item", "says"),
    [
        ("position_sd_m: 0.2", "survey_1", "outside bounds_m"),
        ("position_sd_m: 0.5", "goal_clearance", "nearer"),
        ("yaw_sd_deg: 8.0", "incidence_1", "leading edge may be 16 degrees (2 sd)"),
    ],
)
def test_check_reports_standard_deviations_that_are_too_large(figures: str, item: str, says: str) -> None:
    findings = no_goes(check_mission(single((POINT, f"{POINT}, {figures}"))))
    assert says in findings[item]


def test_check_reports_another_wall_that_may_block_the_approach() -> None:
    wide = ("bounds_m: {x: [-1.5, 2.2], y: [-1.5, 2.5]", "bounds_m: {x: [-3.5, 4.2], y: [-3.5, 3.5]")
    behind = (
        "  screen: {point_m: [1.9, 0.5], normal: [-1.0, 0.0], length_m: 3.0, material: wood}\ncollisions:"
    )
    near = single(wide, (POINT, f"{POINT}, position_sd_m: 0.1"), ("collisions:", behind))
    assert "behind wall screen" in no_goes(check_mission(near))["survey_1"]
    side = "  side: {point_m: [1.2, 0.05], normal: [0.0, 1.0], length_m: 0.4, material: wood"
    side += ", position_sd_m: 0.12}\ncollisions:"
    beside = no_goes(check_mission(single(wide, ("collisions:", side))))
    assert "wall side may block the run-up to wall acrylic" in beside["survey_1"]


@pytest.mark.parametrize(("sd_m", "go"), [(0.01, True), (0.1, False)])
def test_check_reports_a_wall_that_may_block_a_planned_trajectory(sd_m: float, go: bool) -> None:
    """The trajectory bends round a partition's end, so a straight run-up would not describe it."""
    tree = load_mission(ROOT / "missions/hairpin.yaml").to_dict()
    tree["collisions"] = [hit for hit in tree["collisions"] if hit.get("trajectory")]
    tree["waypoints"] = []
    tree["walls"]["partition"]["position_sd_m"] = sd_m
    found = no_goes(check_mission(load_mission(tree)))
    assert ("survey_1" not in found) == go
    assert go or "wall partition.front may block the trajectory to wall end" in found["survey_1"]


def test_small_standard_deviations_are_a_go() -> None:
    findings = check_mission(single((POINT, f"{POINT}, position_sd_m: 0.05, yaw_sd_deg: 2.0")))
    assert not no_goes(findings)
    assert any("error of 0.15 m (3 sd)" in f.message for f in findings)


# --- missions without figures -----------------------------------------------------------------------------


WITHOUT_FIGURES = [
    path for path in sorted((ROOT / "missions").glob("*.yaml")) if "_sd_" not in path.read_text("utf-8")
]


@pytest.mark.parametrize("path", WITHOUT_FIGURES, ids=lambda p: p.stem)
def test_a_mission_without_standard_deviations_has_no_survey_findings(path: Path) -> None:
    mission = load_mission(path)
    assert all(not w.is_uncertain and w.position_sd_m is None for w in mission.walls)
    assert len(mission.vehicle.airframe.motors) == 4
    assert not [f for f in check_mission(mission) if f.item.startswith(("survey", "incidence"))]


@pytest.mark.parametrize("path", sorted((ROOT / "tests/data/flights").glob("*.mcap")), ids=lambda p: p.stem)
def test_a_recorded_flight_is_read_with_its_configuration(path: Path) -> None:
    log = read_log(path)
    vehicle = (mission := flown_mission(log.about, log.source)).vehicle
    assert (vehicle.airframe.listed, vehicle.thrust.table, len(vehicle.airframe.motors)) == (None, None, 4)
    assert all(not wall.is_uncertain for wall in mission.walls)
