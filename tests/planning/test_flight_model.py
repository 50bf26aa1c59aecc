"""The flight model against an ODE solver, and its vectorized parts against scalar implementations."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm as scipy_expm

from dart_flight.config.document import Document, InputError
from dart_flight.config.mission import Collision, Mission, parse_mission
from dart_flight.core.mission.approach import NoApproachError, plan_approach
from dart_flight.core.mission.position_loop import PositionLoop, least_distance_m
from dart_flight.core.mission.wall_uncertainty import end_margin_m
from dart_flight.lab.search.scenario import Scenario, load_scenario
from dart_flight.planning.constraints import REFUSALS, Constraints, Refusal
from dart_flight.planning.contact_stage import expm
from dart_flight.planning.flight_model import FreeFlight, SetpointResponse, loop_matrix
from dart_flight.planning.rollout import Rollout, new_flight, stages_for
from tests.oracles.plan_reference import solve_candidate

SCENARIOS = Path(__file__).parents[2] / "missions" / "scenarios"


@pytest.fixture(scope="module")
def dual() -> Scenario:
    return load_scenario(SCENARIOS / "dual_collision.yaml")


def test_matrix_exponential_matches_scipy() -> None:
    rng = np.random.default_rng(1)
    matrices = rng.normal(size=(5, 6, 6)) * np.array([0.0, 1e-3, 1.0, 5.0, 20.0])[:, None, None]
    for ours, matrix in zip(expm(matrices), matrices, strict=True):
        exact = scipy_expm(matrix)
        assert np.abs(ours - exact).max() <= 1e-11 * np.abs(exact).max()


def test_state_between_grid_points_is_the_exact_solution(dual: Scenario) -> None:
    flight = FreeFlight(dual.vehicle, 3.0)
    start = np.array([[-1.9, 0.5], [0.05, -1.0], [1.3, 2.0], [0.04, 0.0]])
    leg = SetpointResponse(start, -0.5 * start, np.array([2.7, 0.1]), np.array([-0.7, 0.3]))
    for index, d in ((0, 0.03), (17, -0.05), (40, 0.05)):
        after = flight.near(leg, np.full(2, index)).leg_at(np.full(2, d))
        t = flight.times[index] + d
        loop = PositionLoop.from_px4(dual.vehicle.px4)
        assert after.x == pytest.approx(scipy_expm(loop_matrix(loop, 0.2) * t) @ leg.x, abs=1e-11)
        assert after.y == pytest.approx(scipy_expm(loop_matrix(loop, 0.4) * t) @ leg.y, abs=1e-11)


@pytest.mark.parametrize("name", ["dual_collision", pytest.param("any_walls", marks=pytest.mark.rest)])
def test_terminal_states_match_an_ode_solver(name: str) -> None:
    scenario = load_scenario(SCENARIOS / f"{name}.yaml")
    stages = stages_for(scenario, [None])[0]
    flight = new_flight(scenario)
    normal = np.array(scenario.normal_m_s)[:, None]
    tangential = np.array(scenario.tangential_m_s)[None, :]
    rng = np.random.default_rng(3)
    compared = 0
    # A recovery into the board, at 45 degrees to the other walls, is refused.
    square = [s for s in scenario.sequences if "board" not in s]
    for sequence in square[-2:]:
        rollout = Rollout(scenario, sequence, flight, Constraints(scenario))
        grid = rollout.approach(normal, tangential)
        for a in rollout.fly(stages, normal, tangential, grid):
            i = int(rng.integers(a.rows.size))
            n, t = divmod(int(a.rows[i]), tangential.size)
            velocity = (float(normal[n, 0]), float(tangential[0, t]))
            one = rollout.approach(np.array(velocity[0]), np.array(velocity[1]))
            exact = solve_candidate(scenario, sequence, a.modes, stages, velocity, one)
            ours = (a.x[i], a.y[i], a.vx[i], a.vy[i], a.miss_m[i])
            assert ours == pytest.approx(exact[1:], abs=1e-6)
            compared += 1
    assert compared >= 4


def test_rollout_and_executive_refuse_the_same_approaches(dual: Scenario) -> None:
    rollout = Rollout(dual, ("wood", "acrylic"), new_flight(dual), Constraints(dual))
    text = (SCENARIOS.parent / "paper_dual_collision.yaml").read_text()
    rng = np.random.default_rng(5)
    refusals: set[Refusal | None] = set()
    for _ in range(150):
        n, t = -float(rng.uniform(0.05, 3.0)), float(rng.uniform(-2.0, 2.0))
        grid = rollout.approach(np.array(n), np.array(t))
        old = "normal_m_s: -0.6, tangential_m_s: 0.5"
        assert old in text
        document = Document(text.replace(old, f"normal_m_s: {n!r}, tangential_m_s: {t!r}"), "mission")
        try:
            mission, collision = load_first_collision(document, dual)
            approach, impact = plan_approach(mission, collision), collision.impact_point
        except (InputError, NoApproachError):
            assert grid.codes != 0
            refusals.add(REFUSALS[int(grid.codes) - 1])
            continue
        wall = dual.walls["wood"]
        assert impact is not None
        if wall.end_distance_m(impact) < end_margin_m(wall, impact):  # `check` refuses it
            assert REFUSALS[int(grid.codes) - 1] is Refusal.BEYOND_WALL
            continue
        assert grid.codes == 0
        assert (float(grid.begin_x), float(grid.begin_y)) == pytest.approx(approach.begin[:2])
        assert float(grid.impact_s) == pytest.approx(approach.duration_s)
        refusals.add(None)
    assert {None, Refusal.BEYOND_WALL, Refusal.RUN_UP_BLOCKED} <= refusals


def load_first_collision(document: Document, dual: Scenario) -> tuple[Mission, Collision]:
    mission = parse_mission(document, dual.vehicle)
    return mission, mission.collisions[0]


def test_the_braking_distance_matches_the_executives(dual: Scenario) -> None:
    constraints = Constraints(dual)
    wall = dual.walls["acrylic"]
    for distance in (0.1, 0.4, 0.9):
        for closing in (0.0, 0.3, 1.2):
            for pushing in (-2.0, 0.5, 3.0):
                zero = np.zeros(1)
                x = np.array([[0.0], [closing], [pushing], [0.0]])
                leg = SetpointResponse(x, np.zeros((4, 1)), zero + 1.65 - distance, zero)
                nearest = least_distance_m(distance, closing, pushing, distance, dual.vehicle.px4)
                if closing > 0.0 and abs(nearest - 0.02) > 0.01:
                    assert bool(constraints.lock_in_time(leg, wall)[0]) is (nearest >= 0.02)
    assert math.isfinite(constraints.lock_s)
