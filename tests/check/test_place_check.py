"""The place of a connected vehicle: signs of a wrong origin, heading or normal on the ground."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.geometry import quaternion_from_euler
from dart_flight.check.findings import CheckFinding
from dart_flight.check.place_check import evaluate_place
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import packaged
from tests.mission_findings import check_mission

DUAL = load_mission(packaged("missions", "dual_collision.yaml"))


def place_findings(
    mission: Mission, x: float = 0.0, y: float = 0.0, heading_deg: float = 0.0
) -> dict[str, CheckFinding]:
    """Return the findings for a vehicle at a position in the mission's frame."""
    frame = mission.frame_at((0.0, 0.0, 0.0))
    q = quaternion_from_euler(0.0, 0.0, math.radians(heading_deg))
    return {f.item: f for f in evaluate_place(mission, frame.point_to_ned((x, y, 0.0)), q)}


def test_the_heading_and_the_walls_are_reported_at_the_start() -> None:
    found = place_findings(DUAL, *DUAL.start)["place"]
    assert found.go
    assert not found.remark
    wall = next(w for w in DUAL.walls if w.name == "acrylic")
    contact_m = DUAL.vehicle.airframe.contact_distance_m
    to_surface = wall.signed_distance(DUAL.start) + contact_m
    assert found.figures["wall acrylic_distance_m"] == pytest.approx(to_surface)
    assert f"wall acrylic {to_surface:.2f} m at 0 deg (ahead)" in found.message
    assert "wall wood" in found.message
    assert "heading 0 deg" in found.message


@given(
    st.floats(-180.0, 180.0), st.floats(-5.0, 5.0), st.floats(-5.0, 5.0),
    st.floats(0.0, 6.3), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3),
)  # fmt: skip
def test_distances_do_not_depend_on_the_frame(
    heading: float, north: float, east: float, yaw: float, x: float, y: float
) -> None:
    moved = DUAL.replace({"frame": {"heading_deg": heading, "north_m": north, "east_m": east}})
    a = place_findings(DUAL, x, y, math.degrees(yaw))["place"].figures
    b = place_findings(moved, x, y, math.degrees(yaw) + heading)["place"].figures
    for key, value in a.items():
        if "heading" in key or "bearing" in key:
            difference = (b[key] - value - heading + 180.0) % 360.0 - 180.0
            assert difference == pytest.approx(0.0, abs=1e-6)
        else:
            assert b[key] == pytest.approx(value, abs=1e-9)


@pytest.mark.parametrize(
    ("x", "y", "says"),
    [
        (20.0, 0.0, "17.80 m outside bounds_m"),
        (0.0, 1.4, "1.40 m from start, limit 1 m"),
        (1.9, 0.0, "behind wall acrylic"),
        (0.3, -1.05, "wall wood is too near the vehicle or between the vehicle and start"),
    ],
)
def test_a_place_that_the_mission_does_not_tolerate_is_a_no_go(x: float, y: float, says: str) -> None:
    found = place_findings(DUAL, x, y)["place"]
    assert not found.go
    assert says in found.message


@pytest.mark.parametrize(("off_m", "remark"), [(0.2, False), (0.5, True)])
def test_a_place_half_a_metre_from_the_start_is_a_remark(off_m: float, remark: bool) -> None:
    found = place_findings(DUAL, DUAL.start[0], DUAL.start[1] + off_m)["place"]
    assert (found.go, found.remark) == (True, remark)


def with_frame(heading_deg: float) -> Mission:
    return DUAL.replace({"frame.heading_deg": heading_deg})


@pytest.mark.parametrize(
    ("given_deg", "vehicle_deg", "go"),
    [
        (1.57, 92.0, False),
        (-0.785, 315.0, False),
        (2.1, 118.0, False),  # 120 degrees, not one of the usual angles
        (1.57, 2.0, True),  # may really mean 1.57 degrees
        (90.0, 92.0, True),
        (90.0, 0.0, True),  # the vehicle may start with another heading and turn in the air
        (0.0, 90.0, True),
    ],
)
def test_a_heading_in_radians_is_detected_from_the_vehicles_heading(
    given_deg: float, vehicle_deg: float, go: bool
) -> None:
    found = place_findings(with_frame(given_deg), heading_deg=vehicle_deg)
    assert ("heading" not in found) == go
    assert go or "looks like radians" in found["heading"].message


@pytest.mark.parametrize(
    ("given_deg", "remark"), [(1.5708, True), (3.14, True), (-0.785, True), (1.5, False)]
)
def test_a_usual_angle_in_radians_is_a_remark_without_a_vehicle(given_deg: float, remark: bool) -> None:
    assert any(f.item == "heading" and f.remark for f in check_mission(with_frame(given_deg))) == remark


def with_door(**changes: Any) -> Mission:
    """Return the mission with an additional wall that is not hit."""
    tree = DUAL.to_dict()
    tree["walls"]["door"] = {
        "point_m": [-1.5, 0.0], "normal": [1.0, 0.0], "length_m": 2.0, "material": "wood", **changes,
    }  # fmt: skip
    return load_mission(tree)


def test_a_reversed_normal_is_reported_as_a_vehicle_behind_the_wall() -> None:
    assert not place_findings(with_door())["place"].remark
    found = place_findings(with_door(normal=[-1.0, 0.0]))["place"]
    assert found.remark
    assert "behind the face of wall door: check the sign of its normal" in found.message


def test_given_at_changes_the_reported_distance_to_the_surface() -> None:
    contact_m = DUAL.vehicle.airframe.contact_distance_m
    centre = place_findings(with_door())["place"].figures["wall door_distance_m"]
    surface = place_findings(with_door(given_at="surface"))["place"].figures["wall door_distance_m"]
    assert centre == pytest.approx(1.5 + contact_m)
    assert surface == pytest.approx(1.5)


@pytest.mark.parametrize(
    "name", ["find_a_wall", "unknown_room", "hairpin", "shuttle", "dual_collision_gps", "transit"]
)
def test_shipped_missions_are_go_at_their_start(name: str) -> None:
    mission = load_mission(packaged("missions", f"{name}.yaml"))
    assert place_findings(mission, *mission.start)["place"].go


def test_the_hidden_face_of_a_partition_is_not_listed() -> None:
    changes = {"walls.wood.thickness_m": 0.02, "walls.wood.given_at": "centre"}
    hits = [f"collisions[{i}].wall" for i, c in enumerate(DUAL.collisions) if c.wall.name == "wood"]
    mission = DUAL.replace(changes | dict.fromkeys(hits, "wood.front"))
    says = place_findings(mission, *mission.start, heading_deg=359.8)["place"].message
    assert "wood.front" in says
    assert "wood.back" not in says
    assert "heading 0 deg" in says


def test_a_vehicle_without_a_position_has_no_findings() -> None:
    assert evaluate_place(DUAL, None, None) == []
