"""Plans to a wall that is detected late: the safe speed against Ruckig, and both plans against limits."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

import dart_flight
from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.lab.commands import plan_command
from dart_flight.lab.search.limited_sight import safe_speed_m_s
from dart_flight.lab.search.plan import MotionLimits, Plan, SearchResult
from dart_flight.lab.search.quickest import plan_quickest
from dart_flight.lab.search.scenario import load_scenario
from tests.arrival import arrival_of
from tests.extras import needs_ruckig, ruckig
from tests.shared_flights import SharedFlights
from tests.shared_plans import limited_sight_plan

pytestmark = needs_ruckig

SHIPPED = packaged("missions", "scenarios", "limited_sight.yaml")
WALL_M, SEEN_M, REACTION_S = 4.5, 1.0, 0.15


@given(st.floats(1.0, 8.0), st.floats(3.0, 30.0), st.floats(0.3, 3.0), st.floats(0.0, 0.4))
def test_stopping_from_the_safe_speed_uses_all_of_the_distance(
    acceleration: float, jerk: float, distance_m: float, reaction_s: float
) -> None:
    v = safe_speed_m_s(MotionLimits(10.0, acceleration, jerk, 45.0), distance_m, reaction_s)
    stop = ruckig.InputParameter(1)
    stop.control_interface = ruckig.ControlInterface.Velocity
    stop.current_velocity, stop.target_velocity = [v], [0.0]
    stop.max_acceleration, stop.max_jerk = [acceleration], [jerk]
    braking = ruckig.Trajectory(1)
    ruckig.Ruckig(1).calculate(stop, braking)
    place, _, _ = braking.at_time(braking.duration)
    assert v < 10.0
    assert reaction_s * v + place[0] == pytest.approx(distance_m, rel=1e-2)


def first_leg_states(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Return position and velocity towards the wall along the first leg."""
    trajectory = Trajectory.from_mission(plan.legs[0], 1.0)
    states = [trajectory.at(t) for t in np.linspace(0.0, trajectory.duration_s, 3000)]
    return np.array([s.position[0] for s in states]), np.array([s.velocity[0] for s in states])


@pytest.fixture(scope="module")
def planned(flown: SharedFlights) -> SearchResult:
    """Return the plan of the shipped scenario."""
    return limited_sight_plan(flown, load_scenario(SHIPPED))


@pytest.mark.rest
def test_both_plans_cruise_until_the_reaction_time_has_passed(planned: SearchResult) -> None:
    result = planned
    assert result.best is result.colliding
    for plan in (result.free, result.colliding):
        assert plan is not None
        assert plan.cruise_m_s is not None
        x, v = first_leg_states(plan)
        reacted_m = WALL_M - SEEN_M + REACTION_S * plan.cruise_m_s
        cruising = (x > WALL_M - SEEN_M - 0.1) & (x < reacted_m) & (v > 0.0)
        assert v[cruising] == pytest.approx(plan.cruise_m_s, rel=3e-3)
        assert v.max() <= plan.cruise_m_s * 1.005
        assert x.max() < WALL_M
    assert result.free is not None
    assert result.best.cruise_m_s is not None
    assert result.free.cruise_m_s is not None
    assert result.best.cruise_m_s > 1.6 * result.free.cruise_m_s
    (hit,) = result.best.collisions
    assert hit.normal_m_s >= -3.0 - 1e-6


@pytest.mark.rest
def test_the_free_plan_completes_without_a_collision(
    planned: SearchResult,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(plan_command, "plan_quickest", lambda *_: planned)
    target = tmp_path / "free.yaml"
    assert main(["plan", str(SHIPPED), "--free", "--json", "--no-verify", "-o", str(target)]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["free"]["cruise_m_s"] == pytest.approx(1.63, abs=0.01)
    mission = dart_flight.load_mission(target)
    flown = dart_flight.simulate(mission, seed=1)
    assert (flown.verdict.outcome, flown.verdict.collisions) == ("completed", [])
    assert max(p[0] for p in flown.log["/truth/state"]["position_mission"]) < WALL_M
    assert flown.log is not None
    arrival = arrival_of(flown.log, mission, [((WALL_M - SEEN_M, 0.0), 0.05), ((2.5, 0.0), 0.05)])
    assert arrival is not None
    arrived, back = arrival.visits_us
    assert arrival.begin_us < arrived < back
    assert arrival.there_s == pytest.approx(output["free"]["time_s"], rel=0.1)


def test_free_is_refused_for_other_objectives(capsys: pytest.CaptureFixture[str]) -> None:
    grid = packaged("missions", "scenarios", "one_wall.yaml")
    assert main(["plan", str(grid), "--free"]) == 2
    assert "objective quickest" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"visits": [{"position_m": [1.0, 0.0], "within_m": 0.1}]}, "needs exactly one wall and no visits"),
        ({"start": {"position_m": [3.6, 0.0], "altitude_m": 1.0}}, "must be out of sight at start"),
        ({"start": {"position_m": [0.0, 2.3], "altitude_m": 1.0}}, "move start in front of the wall"),
        (
            {"limits": {"speed_m_s": 3.7, "peak_force_n": 7.0}, "sequence": ["north"]},
            "no feasible trajectory hits north",
        ),
    ],
)
def test_an_infeasible_scenario_is_refused_with_the_reason(change: dict[str, Any], message: str) -> None:
    tree = yaml.safe_load(SHIPPED.read_text("utf-8")) | {"vehicle": str(packaged("configs", "dart.yaml"))}
    with pytest.raises(InputError, match=message):
        plan_quickest(load_scenario(tree | change))
