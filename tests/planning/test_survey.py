"""Missions that survey the walls of another mission, and that mission written with the measured walls."""

from __future__ import annotations

from typing import Any

import pytest

from dart_flight.base.records import Mode
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission.approach import plan_approach
from dart_flight.planning.survey import plan_survey, surveyed_collisions, surveyed_walls
from dart_flight.recording.measured_walls import MeasuredWall

DUAL = load_mission(packaged("missions", "dual_collision.yaml"))
NEAR = {"point_m": [1.5, 0.0], "normal": [-1.0, 0.0], "length_m": 2.0, "material": "wood"}


def mission_in_room(**walls: dict[str, Any]) -> Mission:
    tree = {
        "version": 1,
        "name": "room",
        "start": {"position_m": [0.0, 0.0], "altitude_m": 1.0},
        "goal": {"position_m": [0.0, 0.5], "capture_radius_m": 0.3},
        "bounds_m": {"x": [-3.0, 3.0], "y": [-3.0, 3.0], "z": [0.3, 2.5]},
    }
    return load_mission(tree | {"walls": walls})


def test_each_wall_is_touched_in_rigid_mode_and_then_in_the_missions_mode() -> None:
    survey = plan_survey(DUAL.replace({"standoff_m": 0.5}), 0.6)
    assert survey.unreachable == {}
    assert survey.mission.standoff_m is None, "a survey ignores the standoff of a rehearsal"
    touched = [(c.wall.name, c.mode) for c in survey.mission.collisions]
    assert sorted(touched) == [
        ("acrylic", Mode.RIGID),
        ("acrylic", Mode.RIGID),
        ("wood", Mode.FLEXIBLE),
        ("wood", Mode.RIGID),
    ]
    assert [mode for name, mode in touched if name == "wood"] == [Mode.RIGID, Mode.FLEXIBLE]
    for collision in survey.mission.collisions:
        assert collision.probe is not None
        assert collision.probe.speed_m_s == 0.6
        assert collision.approach_m_s == pytest.approx((-0.6, 0.0)), "the approach is head-on"
        plan_approach(survey.mission, collision)
    mission = survey.mission
    assert (mission.start, mission.goal.position_m, mission.bounds) == (DUAL.start, DUAL.start, DUAL.bounds)
    assert (mission.waypoints, mission.goal_trajectory) == ((), None)


def test_a_survey_assumes_default_uncertainties_only_where_none_are_given() -> None:
    survey = plan_survey(
        mission_in_room(a=NEAR, b=NEAR | {"point_m": [0.0, 2.0], "normal": [0, -1], "position_sd_m": 0.2})
    )
    a, b = survey.mission.walls
    assert (a.position_sd_m, b.position_sd_m) == (0.1, 0.2)
    assert a.yaw_sd_rad is not None
    # The probe ends at the farthest place of the wall, three standard deviations away.
    for wall, collision in ((a, survey.mission.collisions[0]), (b, survey.mission.collisions[2])):
        assert collision.probe is not None
        assert wall.position_sd_m is not None
        assert -wall.signed_distance(collision.probe.end) == pytest.approx(3.0 * wall.position_sd_m, abs=1e-3)
        assert wall.signed_distance(collision.probe.begin) > 3.0 * wall.position_sd_m


def test_the_nearest_wall_is_touched_first() -> None:
    far = NEAR | {"point_m": [-2.5, 0.0], "normal": [1.0, 0.0]}
    names = [c.wall.name for c in plan_survey(mission_in_room(far=far, near=NEAR)).mission.collisions]
    assert names == ["near", "near", "far", "far"]


def test_an_unreachable_wall_is_reported_and_the_others_are_touched() -> None:
    behind = NEAR | {"point_m": [2.5, 0.0], "length_m": 1.0}
    survey = plan_survey(mission_in_room(front=NEAR | {"length_m": 6.0}, behind=behind))
    assert survey.unreachable == {"behind": "no clear path leads to the wall"}
    assert {c.wall.name for c in survey.mission.collisions} == {"front"}


def test_a_mission_without_a_reachable_wall_is_refused() -> None:
    outside = NEAR | {"point_m": [2.9, 0.0], "normal": [1.0, 0.0]}
    mission = mission_in_room(outside=outside)
    with pytest.raises(InputError, match="no wall can be touched"):
        plan_survey(mission.replace({"start.position_m": [2.95, 0.0], "goal.position_m": [2.95, 0.0]}))


# --- the surveyed mission ---------------------------------------------------------------------------------

TURNED = MeasuredWall("wood", (0.81, -1.15), (0.0523, 0.99863), 0.0123, 0.8, "wood")


def test_only_measured_walls_are_written_and_at_their_measured_places() -> None:
    (name, keys), *rest = surveyed_walls(DUAL, {"wood": TURNED}).items()
    assert (name, rest) == ("wood", [])
    assert keys == {
        "point_m": [0.81, -1.15],
        "normal": [0.0523, 0.99863],
        "length_m": 3.0,
        "material": "wood",
        "position_sd_m": 0.0123,
        "yaw_sd_deg": 0.8,
    }
    nameless = MeasuredWall("wood", (0.8, -1.1), (0.0, 1.0), None, None, None)
    keys = surveyed_walls(DUAL, {"wood": nameless})["wood"]
    assert keys["material"] == "wood", "an unknown material keeps the mission's entry"
    assert "yaw_sd_deg" not in keys
    assert keys["position_sd_m"] == 0.001


def test_gains_and_impact_points_follow_the_measured_wall() -> None:
    """Keys along the mission's axes are refused for a wall that is oblique to them."""
    collisions: list[dict[str, Any]] = [
        {
            "wall": "wood",
            "mode": "rigid",
            "approach": {"normal_m_s": -0.8},
            "impact_point_m": [0.5, -1.1],
            "alpha_m_per_n": [0.12, 0.025],
        },
        {"wall": "acrylic", "mode": "rigid", "alpha_m_per_n": [0.02, 0.02]},
    ]
    mission = DUAL.replace({"collisions": collisions, "goal_trajectory": None, "after_impact": "setpoint"})
    surveyed = surveyed_collisions(mission, collisions, {"wood": TURNED})
    assert surveyed[1] == collisions[1], "its wall was not measured"
    assert surveyed[0] == {
        "wall": "wood",
        "mode": "rigid",
        "approach": {"normal_m_s": -0.8},
        "alpha_wall_m_per_n": [0.025, 0.12],
        "impact_along_m": pytest.approx(mission.walls[0].along((0.5, -1.1))),
    }
    walls = {w.name: w for w in mission.walls}
    assert walls["wood"].normal == (0.0, 1.0)
    tree = mission.to_dict() | {"collisions": surveyed}
    tree["walls"] |= surveyed_walls(mission, {"wood": TURNED})
    written = load_mission(tree)
    hit = written.collisions[0]
    assert hit.impact_point is not None
    assert hit.wall.along(hit.impact_point) == pytest.approx(walls["wood"].along((0.5, -1.1)))
