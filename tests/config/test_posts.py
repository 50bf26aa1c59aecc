"""Posts of a mission: read, written, refused, as obstacles, and hit in a simulated flight."""

from typing import Any

import pytest

import dart_flight
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.core.mission.approach import NoApproachError, plan_approach
from dart_flight.sim.plant import make_plant
from tests.mission_findings import check_mission

POLE = {"centre_m": [1.5, 0.0], "radius_m": 0.1, "material": "acrylic"}
HIT = {
    "wall": "pole",
    "mode": "rigid",
    "approach": {"normal_m_s": -1.0},
    "impact_point_m": [1.2, 0.0],
    "alpha_wall_m_per_n": [0.012, 0.012],
}


def mission(**changes: Any) -> Mission:
    tree = {
        "version": 1,
        "name": "pole",
        "start": {"position_m": [-1.0, 0.0], "altitude_m": 1.2},
        "goal": {"position_m": [0.0, 0.0], "capture_radius_m": 0.5},
        "bounds_m": {"x": [-2.0, 2.0], "y": [-2.0, 2.0], "z": [0.3, 2.5]},
        "posts": {"pole": POLE},
        "collisions": [HIT],
    }
    return load_mission(tree | changes)


def test_a_post_to_be_hit_is_represented_by_its_tangent_plane() -> None:
    loaded = mission()
    (wall,) = loaded.walls
    assert (wall.name, wall.point, wall.normal) == ("pole", (1.2, 0.0), (-1.0, 0.0))
    assert wall.length_m == pytest.approx(2.0 * (0.1 + 0.13))
    assert loaded.flat_walls == ()
    again = load_mission(loaded.to_dict())
    assert (again.walls, again.posts, again.collisions) == (loaded.walls, loaded.posts, loaded.collisions)
    assert make_plant(loaded).planes == []
    assert [post.name for post in make_plant(loaded).posts] == ["pole"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"collisions": [HIT | {"impact_point_m": None}]}, "needs impact_point_m"),
        (
            {"collisions": [HIT | {"impact_point_m": [1.1, 0.0]}]},
            r"minimum 0.300 m; the nearest possible point is \[1.200",
        ),
        ({"collisions": [HIT, HIT | {"impact_point_m": [1.5, 0.3]}]}, "hits post pole at a different point"),
        ({"posts": {"pole": POLE | {"material": "cheese"}}}, "cheese"),
        ({"posts": {"pole": POLE | {"radius_m": 0.0}}}, "radius_m"),
        ({"start": {"position_m": [1.3, 0.0], "altitude_m": 1.2}}, "is in or at post pole"),
        (
            {"walls": {"pole": {"point_m": [1, 1], "normal": [-1, 0], "length_m": 1, "material": "acrylic"}}},
            "a wall already has the name",
        ),
    ],
)
def test_contradictory_posts_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        mission(**changes)


def test_a_post_that_blocks_the_run_up_is_reported() -> None:
    posts = {"pole": POLE, "other": POLE | {"centre_m": [0.5, 0.2]}}
    loaded = mission(posts=posts)
    with pytest.raises(NoApproachError, match="post other blocks the run-up"):
        plan_approach(loaded, loaded.collisions[0])
    no_gos = [finding for finding in check_mission(loaded) if not finding.go]
    assert any("post other" in finding.message for finding in no_gos)
    free = mission(posts=posts | {"other": POLE | {"centre_m": [0.5, 1.5]}})
    assert all(finding.go for finding in check_mission(free)), check_mission(free)


def test_a_flight_hits_a_post_and_completes() -> None:
    verdict = dart_flight.simulate(mission(), seed=3).verdict
    assert verdict.outcome == "completed", verdict.reason
    assert [hit.wall for hit in verdict.collisions] == ["pole"]
