"""The introductory missions reach their goals; the paper's missions follow their plans and miss the goal.

These tests fly one seed of each; docs/results/campaigns.md has twenty.
"""

from pathlib import Path

import pytest

from dart_flight.check.findings import CheckFinding
from dart_flight.run.prepare import load_flyable
from tests.mission_findings import check_mission
from tests.shared_flights import SharedFlights

ROOT = Path(__file__).parents[2]


def test_a_first_flight_reaches_its_goal_and_follows_its_plan(flown: SharedFlights) -> None:
    verdict = flown("dual_collision", 2, vary=("contact=0.2",)).verdict
    assert (verdict.outcome, verdict.goal_reached, verdict.plan_followed) == ("completed", True, True)
    assert verdict.goal_miss_planned_m == 0.0


@pytest.mark.parametrize(("name", "miss_m"), [("paper_dual_collision", 0.28), ("paper_single_wall", 0.55)])
def test_the_papers_missions_follow_their_plan_and_miss_the_goal(
    name: str, miss_m: float, flown: SharedFlights
) -> None:
    verdict = flown(name, 1).verdict
    assert (verdict.goal_reached, verdict.plan_followed) == (False, True)
    assert verdict.goal_miss_planned_m == pytest.approx(miss_m, abs=0.01)
    assert verdict.goal_miss_m == pytest.approx(miss_m, abs=0.05)


def goal_finding(name: str) -> CheckFinding:
    return next(f for f in check_mission(load_flyable(ROOT / "missions" / name)) if f.item == "goal")


def test_check_reports_the_planned_goal_miss_before_the_flight() -> None:
    paper = goal_finding("paper_dual_collision.yaml")
    assert (paper.go, paper.remark) == (True, True)
    assert paper.message == "passes the goal at a distance of 0.28 m (capture radius 0.15 m)"
    assert paper.figures == pytest.approx({"goal_miss_m": 0.281, "capture_radius_m": 0.15}, abs=1e-3)
    replanned = goal_finding("single_wall.yaml")
    assert not replanned.remark
    assert replanned.message.startswith(
        "the vehicle replans after every collision to pass through the goal; without replanning"
    )
