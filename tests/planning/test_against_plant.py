"""The flight model against the plant: fast flights of plans, predicted against flown.

The plant's body is a point here, as in the planner and the flight model. The tolerances are about twice the
differences in `docs/results/planning_agreement.md`.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from dart_flight.config.mission import load_mission
from dart_flight.lab.search.mission_writer import write_mission
from dart_flight.lab.search.scenario import load_scenario
from dart_flight.lab.search.search import search
from dart_flight.run.fast import fly_fast

POINT = ["simulation.contact.body=point"]
SCENARIOS = Path(__file__).parents[2] / "missions" / "scenarios"


@pytest.mark.parametrize(
    ("name", "seed"), [("dual_collision", 1), pytest.param("one_wall", 2, marks=pytest.mark.rest)]
)
def test_a_flown_plan_matches_its_prediction(name: str, seed: int, tmp_path: Path) -> None:
    scenario = load_scenario(SCENARIOS / f"{name}.yaml")
    # In two seconds between the walls a small error of the first impact grows to 0.13 m/s at the second.
    plans = search(scenario, top=10).plans
    plan = next(p for p in plans if p.collisions[-1].t_s - p.collisions[0].t_s < 1.5)
    write_mission(scenario, plan, tmp_path / "mission.yaml")
    verdict = fly_fast(load_mission(tmp_path / "mission.yaml", settings=POINT), seed, None)
    assert verdict.outcome == "completed"
    for flown, planned in zip(verdict.collisions, plan.collisions, strict=True):
        assert flown.truth is not None
        assert flown.truth.normal_m_s == pytest.approx(planned.normal_m_s, rel=0.06, abs=0.08)
        assert flown.truth.tangential_m_s == pytest.approx(planned.tangential_m_s, abs=0.08)
        assert flown.truth.peak_force_n == pytest.approx(planned.peak_force_n, rel=0.15)
    between = [b.t_us - a.t_us for a, b in zip(verdict.collisions, verdict.collisions[1:], strict=False)]
    expected = [b.t_s - a.t_s for a, b in zip(plan.collisions, plan.collisions[1:], strict=False)]
    assert [1e-6 * t for t in between] == pytest.approx(expected, abs=0.1)
    assert verdict.goal_miss_m == pytest.approx(plan.goal_miss_m, abs=0.1)


@pytest.mark.rest
def test_the_published_plan_matches_the_flight_of_the_shipped_mission(tmp_path: Path) -> None:
    """Compare the second impact and the goal miss."""
    mission = load_mission(SCENARIOS.parent / "paper_dual_collision.yaml", settings=POINT)
    result = search(load_scenario(SCENARIOS / "dual_collision.yaml"), top=2000)
    plan = next(
        p
        for p in result.plans
        if (p.collisions[0].normal_m_s, p.collisions[0].tangential_m_s) == (-0.6, 0.5)
        and [m.value for m in p.modes] == ["flexible", "rigid"]
    )
    verdict = fly_fast(mission, 4, None)
    truth = verdict.collisions[1].truth
    assert truth is not None
    assert truth.normal_m_s == pytest.approx(plan.collisions[1].normal_m_s, rel=0.06)
    assert truth.tangential_m_s == pytest.approx(plan.collisions[1].tangential_m_s, abs=0.03)
    assert verdict.goal_miss_m == pytest.approx(plan.goal_miss_m, abs=0.06)
