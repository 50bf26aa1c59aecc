"""The predicted path is judged before the flight: its speed, and walls on the way to the goal."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from dart_flight.check.mission_check import check_path
from dart_flight.check.wall_check import check_walls
from dart_flight.config.document import Document
from dart_flight.config.mission import load_mission, parse_mission
from dart_flight.config.vehicle import packaged
from dart_flight.planning.predicted_flight import predict_mission


@pytest.mark.parametrize("name", ["dual_collision", "dual_collision_stiff", "shuttle"])
def test_a_recovery_that_is_predicted_to_be_too_fast_is_a_no_go(name: str) -> None:
    mission = load_mission(packaged("missions", f"{name}.yaml"))
    planned = predict_mission(mission)
    assert planned is not None
    fastest_m_s = max(math.hypot(*state[2:]) for path in planned.legs.values() for state in path.tolist())
    for limit, go in ((0.99 * fastest_m_s, False), (1.01 * fastest_m_s, True)):
        limited = mission.replace({"limits.speed_m_s": limit})
        (found,) = check_path(limited, predict_mission(limited))
        assert found.go is go
        assert ("limits.speed_m_s" in found.message) is not go


@pytest.mark.parametrize(
    ("thickness_m", "goal", "blocking"),
    [
        (None, (2.6, 0.3), "board"),
        (0.012, (2.6, 0.3), "board.front"),
        (None, (0.3, 0.3), None),
        (0.012, (0.3, 0.3), None),
    ],
    ids=["behind a wall", "behind a partition", "before the wall", "before the partition"],
)
def test_a_goal_behind_the_wall_that_is_hit_last_is_a_no_go(
    thickness_m: float | None, goal: tuple[float, float], blocking: str | None
) -> None:
    mission = load_mission(packaged("missions", "rigid_cage", "single_wall.yaml"))
    wall = {"point_m": [1.6, 0.3], "normal": [-1.0, 0.0], "length_m": 2.0, "material": "wood"}
    if thickness_m is not None:
        wall |= {"thickness_m": thickness_m, "given_at": "surface"}
    tree = {
        "version": 1,
        "name": "board",
        "start": {"position_m": [0.0, 0.0], "altitude_m": 1.0},
        "goal": {"position_m": list(goal)},
        "bounds_m": {"x": [-1.5, 4.0], "y": [-1.8, 1.8], "z": [0.3, 2.0]},
        "walls": {"board": wall},
        "collisions": [
            {
                "wall": "board" if thickness_m is None else "board.front",
                "approach": {"normal_m_s": -0.8, "tangential_m_s": 0.3},
                "alpha_m_per_n": [0.02, 0.02],
            }
        ],
        "limits": {"peak_force_n": 100.0},
    }
    made = parse_mission(Document.from_tree(tree), mission.vehicle)
    found = [f for f in check_walls(made, predict_mission(made)) if f.item == "way_to_goal"]
    assert [f.go for f in found] == ([] if blocking is None else [False])
    assert all(f"wall {blocking} is between" in f.message for f in found)


MISSIONS = sorted(path for path in packaged("missions").rglob("*.yaml") if path.parent.name != "scenarios")


@pytest.mark.parametrize("path", MISSIONS, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_no_wall_is_on_the_way_to_the_goal_of_a_shipped_mission(path: Path) -> None:
    mission = load_mission(path)
    found = check_walls(mission, predict_mission(mission))
    assert "way_to_goal" not in {finding.item for finding in found}
