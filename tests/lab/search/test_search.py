"""The grid search: the paper's cases, counts of refused candidates, objectives and the written mission."""

from __future__ import annotations

import json
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest

from dart_flight.base.records import Mode
from dart_flight.cli import main
from dart_flight.config.mission import Mission, load_mission
from dart_flight.core.flight_core import FlightCore
from dart_flight.lab.search.mission_writer import write_mission
from dart_flight.lab.search.plan import SearchResult
from dart_flight.lab.search.plan_table import with_objective
from dart_flight.lab.search.scenario import Objective, Scenario, load_scenario
from dart_flight.lab.search.search import search
from dart_flight.planning.approach_grid import approach_grid
from dart_flight.planning.constraints import CODE, Constraints, Refusal
from tests.extras import needs_ruckig

SCENARIOS = Path(__file__).parents[3] / "missions" / "scenarios"


def load(name: str) -> Scenario:
    return load_scenario(SCENARIOS / f"{name}.yaml")


@pytest.fixture(scope="module")
def dual() -> SearchResult:
    return search(load("dual_collision"), top=400)


def test_every_candidate_is_counted_once(dual: SearchResult) -> None:
    assert dual.candidates == 14_884
    assert dual.feasible + sum(dual.refused.values()) == dual.candidates
    assert dual.feasible > 1000


def test_the_published_plan_is_feasible_and_misses_the_goal_as_published(dual: SearchResult) -> None:
    """The published optimum is flexible at (-0.6, 0.5) m/s, then rigid."""
    paper = next(m for m in dual.maps if m.modes == (Mode.FLEXIBLE, Mode.RIGID))
    row = np.flatnonzero((paper.normal_m_s == -0.6) & (paper.tangential_m_s == 0.5))
    assert row.size == 1
    # The paper's own point-mass model passes the goal at about 0.27 m.
    assert paper.miss_m[row[0]] == pytest.approx(0.3, abs=0.06)
    best_here = np.sort(paper.miss_m)
    assert np.searchsorted(best_here, paper.miss_m[row[0]]) < 0.9 * best_here.size


def test_plans_are_sorted_and_respect_the_limits(dual: SearchResult) -> None:
    scores = [plan.score for plan in dual.plans]
    assert scores == sorted(scores)
    limits = dual.scenario.limits
    for plan in dual.plans:
        assert plan.peak_force_n <= limits.peak_force_n
        for c in plan.collisions:
            wall = dual.scenario.walls[c.wall]
            assert abs(wall.signed_distance(c.position_m)) < 0.03
            assert wall.spans(c.position_m)
            assert c.peak_force_n >= dual.scenario.vehicle.detection.force_threshold_n


def test_each_objective_selects_its_own_optimum() -> None:
    scenario = load("dual_collision")
    best = {o: search(with_objective(scenario, o), top=1).plans[0] for o in Objective if o != "robust"}
    fastest, gentlest = best[Objective.FASTEST], best[Objective.GENTLEST]
    assert fastest.time_to_goal_s <= min(p.time_to_goal_s for p in best.values())
    assert gentlest.peak_force_n <= min(best[Objective.NEAREST].peak_force_n, 60.0)
    assert gentlest.goal_miss_m <= scenario.goal.capture_radius_m
    assert best[Objective.NEAREST].goal_miss_m <= 0.005


def coarse(name: str, objective: Objective) -> Scenario:
    scenario = with_objective(load(name), objective)
    return msgspec.structs.replace(
        scenario, normal_m_s=scenario.normal_m_s[::4], tangential_m_s=scenario.tangential_m_s[::3]
    )


def test_robust_minimises_expected_and_worst_miss_over_the_draws() -> None:
    scenario = coarse("dual_collision", Objective.ROBUST)
    result = search(scenario, top=200, seed=3)
    repeated = search(scenario, top=200, seed=3)
    assert [p.score for p in repeated.plans] == [p.score for p in result.plans]
    best = result.plans[0]
    nearest = min(result.plans, key=lambda p: p.goal_miss_m)
    assert best.expected_miss_m is not None
    assert nearest.expected_miss_m is not None
    assert best.worst_miss_m is not None
    assert nearest.worst_miss_m is not None
    assert best.expected_miss_m + best.worst_miss_m <= nearest.expected_miss_m + nearest.worst_miss_m
    assert best.worst_miss_m >= best.expected_miss_m
    assert result.trajectories > 64 * len(result.plans)


@needs_ruckig
def test_sequence_any_includes_several_sequences_and_the_free_flight() -> None:
    scenario = coarse("any_walls", Objective.NEAREST)
    result = search(scenario, top=5)
    assert {len(m.sequence) for m in result.maps} >= {1, 2}
    assert result.free_time is not None
    assert result.free_time.via == ()
    assert result.free_time.time_s is not None
    assert result.free_time.time_s > 1.0


def test_no_run_up_is_blocked_by_its_own_wall() -> None:
    """The impact is on the plane up to rounding, for any velocity and wall direction."""
    for heading in np.linspace(0.0, 2.0 * math.pi, 40):
        normal = (-math.cos(heading), -math.sin(heading))
        scenario = load_scenario(SCENARIOS / "one_wall.yaml")
        old = scenario.walls["acrylic"]
        point = (-1.65 * normal[0], -1.65 * normal[1])
        wall = msgspec.structs.replace(old, point=point, normal=normal, length_m=100.0)
        scenario = msgspec.structs.replace(
            scenario,
            walls={"acrylic": wall},
            bounds=msgspec.structs.replace(scenario.bounds, x=(-50.0, 50.0), y=(-50.0, 50.0)),
        )
        grid = approach_grid(
            scenario,
            wall,
            np.array(scenario.normal_m_s)[:, None],
            np.array(scenario.tangential_m_s)[None, :],
            Constraints(scenario),
        )
        assert not (grid.codes == CODE[Refusal.RUN_UP_BLOCKED]).any(), heading


def test_a_wall_between_the_collisions_is_an_obstacle(tmp_path: Path) -> None:
    text = (SCENARIOS / "dual_collision.yaml").read_text()
    text = text.replace("../../configs", str(SCENARIOS.parents[1] / "configs"))
    text = text.replace(
        "walls:\n", "walls:\n  post: {point_m: [1.2, -0.8], normal: [-1, 0], length_m: 0.5, material: wood}\n"
    )
    path = tmp_path / "scenario.yaml"
    path.write_text(text)
    result = search(load_scenario(path), top=1)
    assert result.refused[Refusal.OBSTACLE] > 50
    assert result.feasible < 1554


def test_a_wall_on_the_final_leg_to_the_goal_is_an_obstacle() -> None:
    scenario = load_scenario(SCENARIOS / "one_wall.yaml")  # acrylic at x = 1.65 from y = -1 to 2
    constraints = Constraints(scenario)
    x, y = np.array([1.0, 1.66, 2.3, 2.3]), np.array([0.0, 1.0, 1.0, 40.0])
    obstacle = CODE[Refusal.OBSTACLE]
    # Begin in front, just behind the plane after a release, behind the wall, and behind but past its end.
    assert constraints.to_goal(x, y, (0.6, 1.0)).tolist() == [0, 0, obstacle, 0]
    assert constraints.to_goal(x, y, (3.0, 1.0)).tolist() == [obstacle, 0, 0, 0]


@pytest.mark.parametrize("name", ["dual_collision", "one_wall", "any_walls"])
def test_the_written_mission_predicts_the_planned_flight(name: str, tmp_path: Path) -> None:
    scenario = coarse(name, Objective.NEAREST) if name == "any_walls" else load(name)
    plan = search(scenario, top=1).plans[0]
    target = tmp_path / "sub" / "mission.yaml"
    target.parent.mkdir()
    write_mission(scenario, plan, target)
    mission: Mission = load_mission(target)
    FlightCore(mission)  # refuses an approach without room
    assert mission.predicted is not None
    assert mission.predicted.goal_miss_m == pytest.approx(plan.goal_miss_m, abs=1e-4)
    for flown, planned in zip(mission.collisions, plan.collisions, strict=True):
        assert flown.predicted is not None
        assert flown.predicted.normal_m_s == pytest.approx(planned.normal_m_s, abs=1e-4)
        assert flown.predicted.position_m == pytest.approx(planned.position_m, abs=1e-4)
        assert flown.mode is planned.mode


def test_the_command_writes_plans_mission_and_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target, picture = tmp_path / "mission.yaml", tmp_path / "mission.png"
    arguments = [
        "plan",
        str(SCENARIOS / "one_wall.yaml"),
        "-o",
        str(target),
        "--plot",
        str(picture),
        "--json",
        "--no-verify",
    ]
    assert main([*arguments, "--top", "3"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert len(result["plans"]) == 3
    assert result["feasible"] + sum(r["count"] for r in result["refused"].values()) == result["candidates"]
    assert result["elapsed_s"] > 0.0
    assert load_mission(target).collisions[0].wall.name == "acrylic"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_an_unknown_picture_format_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["plan", str(SCENARIOS / "one_wall.yaml"), "--plot", str(tmp_path / "map.abc")]
    assert main(arguments) == 2
    assert ".png, .svg or .pdf" in capsys.readouterr().err
