"""The map of a mission shows every leg and every wall, each with its own label."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import dart_flight
from dart_flight.config.mission import Mission
from dart_flight.lab.figure_style import as_svg
from dart_flight.lab.map_model import room_map
from dart_flight.lab.report.figures.map_drawing import view_of
from dart_flight.lab.report.figures.mission_figure import mission_figure, prediction_lines
from dart_flight.planning.predicted_flight import predict_mission, predicted_segments
from tests.lab.report.svg import texts_of
from tests.mission_findings import check_mission

TOUCH = {"approach": {"normal_m_s": -0.6}, "alpha_wall_m_per_n": [0.025, 0.025], "mode": "flexible"}


def wall(x: float, y: float, normal: list[float], length_m: float = 3.0) -> dict[str, Any]:
    return {"point_m": [x, y], "normal": normal, "length_m": length_m, "material": "acrylic"}


def mission_in_room(**other: Any) -> Mission:
    """Return a mission that hits the east wall and returns to the start; no leg leads to the north wall."""
    tree = {
        "version": 1, "name": "room", "start": {"position_m": [0.0, 0.0], "altitude_m": 1.2},
        "goal": {"position_m": [0.0, 0.0]}, "bounds_m": {"x": [-3.0, 3.0], "y": [-3.0, 3.0], "z": [0.3, 2.5]},
        "walls": {"east": wall(1.5, 0.0, [-1.0, 0.0]), "north": wall(0.0, 2.4, [0.0, -1.0])},
        "collisions": [{"wall": "east", **TOUCH}],
        "waypoints": [{"after": 1, "position_m": [0.0, 0.0], "hold_s": 1.0}],
    }  # fmt: skip
    return dart_flight.load_mission(tree | other)


def drawn_map(mission: Mission) -> Any:
    return mission_figure(mission, predict_mission(mission)).axes[0]


def test_the_leg_after_a_contact_is_counted_and_drawn() -> None:
    mission = mission_in_room()
    planned = predict_mission(mission)
    (after_contact, to_goal) = predicted_segments(mission, planned.hits)
    assert after_contact.begin is not None
    assert after_contact.begin[:2] == planned.hits[1].setpoint
    leg_m = math.dist(after_contact.begin[:2], (0.0, 0.0))
    assert leg_m > 0.3
    finding = next(f for f in check_mission(mission) if f.item == "waypoints")
    assert f"the legs between stops are {leg_m:.1f} m long" in finding.message
    assert to_goal.begin == (0.0, 0.0, 1.2)
    lines = [line.get_xydata() for line in drawn_map(mission).lines]
    assert any(len(xy) == 2 and np.allclose(xy, [after_contact.begin[:2], (0.0, 0.0)]) for xy in lines)


def test_legs_after_an_unpredicted_contact_are_reported_as_such() -> None:
    rehearsal = mission_in_room(standoff_m=0.5)
    finding = next(f for f in check_mission(rehearsal) if f.item == "waypoints")
    assert "1 legs of unknown length after a contact" in finding.message


@pytest.mark.parametrize("place", [(0.0, 2.4, [0.0, -1.0]), (0.0, -2.4, [0.0, 1.0]), (-2.4, 0.5, [1.0, 0.0])])
def test_a_wall_without_a_collision_is_drawn(place: tuple[float, float, list[float]]) -> None:
    mission = mission_in_room(walls={"east": wall(1.5, 0.0, [-1.0, 0.0]), "third": wall(*place)})
    plan = drawn_map(mission)
    x, y = mission.vehicle.airframe.wall_surface(mission.walls[1]).point
    assert plan.get_xlim()[0] < x < plan.get_xlim()[1]
    assert plan.get_ylim()[0] < y < plan.get_ylim()[1]
    assert "third (acrylic)" in {text.get_text() for text in plan.texts}


def test_a_wall_far_outside_of_the_bounds_does_not_shrink_the_map() -> None:
    near, far = (
        mission_in_room(),
        mission_in_room(walls={"east": wall(1.5, 0.0, [-1.0, 0.0]), "far": wall(0.0, 90.0, [0.0, -1.0])}),
    )
    points = np.array([[0.0, 0.0], [1.5, 0.0]])
    assert view_of(room_map(far), points)[1, 1] <= view_of(room_map(near), points)[1, 1]


@pytest.mark.rest
@pytest.mark.parametrize("gap_m", [0.0, 0.3])
@pytest.mark.parametrize("turned", [False, True])
def test_each_face_of_a_partition_is_labelled_on_its_own_side(gap_m: float, turned: bool) -> None:
    """The label of a face is in front of it, also if two faces are back to back."""
    off_m = 0.2 + 0.5 * gap_m  # the vehicle's centre is 0.2 m from a surface in contact
    faces = {"one": ([0.0, 1.0], off_m), "other": ([0.0, -1.0], -off_m)}
    if turned:
        faces = {name: ([-n[1], n[0]], at) for name, (n, at) in faces.items()}
    walls = {
        name: wall(-abs(n[0]) * at - 1.5 * abs(n[1]), at * abs(n[1]) - 1.5 * abs(n[0]), n, 1.0)
        for name, (n, at) in faces.items()
    }
    mission = mission_in_room(walls={"east": wall(1.5, 0.0, [-1.0, 0.0])} | walls)
    written = {text.get_text(): text for text in drawn_map(mission).texts}
    for one in mission.walls[1:]:
        assert one.signed_distance(written[f"{one.name} (acrylic)"].xy) > 0.0


@pytest.mark.parametrize("heading_deg", [0.0, 200.0])
def test_an_arrow_points_north(heading_deg: float) -> None:
    from matplotlib.offsetbox import AnchoredOffsetbox
    from matplotlib.patches import FancyArrow

    mission = mission_in_room(frame={"heading_deg": heading_deg})
    (box,) = (one for one in drawn_map(mission).artists if isinstance(one, AnchoredOffsetbox))
    arrow: Any
    (arrow,) = box.findobj(FancyArrow)
    north = mission.frame_at((0.0, 0.0, 0.0)).vector_from_ned((1.0, 0.0, 0.0))
    length = math.hypot(arrow._dx, arrow._dy)
    assert (arrow._dx / length, arrow._dy / length) == pytest.approx(north[:2], abs=1e-9)


def test_start_and_goal_at_one_place_share_a_label() -> None:
    words = texts_of(as_svg(mission_figure(mission_in_room(), predict_mission(mission_in_room()))))
    assert "start, goal, 1" in words


def test_missions_with_trajectories_claim_no_success_rate_over_draws() -> None:
    shuttle = dart_flight.load_mission(dart_flight.packaged("missions", "shuttle.yaml"))
    words = " ".join(prediction_lines(shuttle, predict_mission(shuttle), []))
    assert "in nine of ten draws" not in words
    assert "This mission has not been flown in simulation" in words


@pytest.mark.parametrize("name", ["dual_collision", "ring_guard_250g/single_wall", "find_a_wall"])
def test_the_legend_names_every_dashed_line(name: str) -> None:
    mission = dart_flight.load_mission(dart_flight.packaged("missions", f"{name}.yaml"))
    figure = mission_figure(mission, None if mission.collisions[0].probe else predict_mission(mission))
    named = {text.get_text() for text in figure.legends[0].get_texts()}
    for line in [line for axis in figure.axes for line in axis.lines]:
        assert line.get_linestyle() in ("-", "None") or line.get_label() in named


def test_rings_of_a_ring_guard_end_where_the_vehicle_touches_a_wall() -> None:
    path = dart_flight.packaged("missions", "ring_guard_250g/single_wall.yaml")
    airframe = dart_flight.load_mission(path).vehicle.airframe
    assert len(airframe.guards_m) == 4
    reach = max(x for ring in airframe.guards_m for x, _ in ring)
    assert reach == pytest.approx(airframe.contact_distance_m)


def test_faces_back_to_back_are_drawn_up_to_the_middle_between_them() -> None:
    reach = mission_in_room().vehicle.airframe.contact_distance_m
    behind = wall(1.6 + 2.0 * reach, 0.0, [1.0, 0.0])
    shown = room_map(mission_in_room(walls={"east": wall(1.5, 0.0, [-1.0, 0.0]), "behind": behind}))
    middle = 1.55 + reach
    for one, face in zip(shown.walls, (middle - 0.05, middle + 0.05), strict=True):
        assert one.outline[:2, 0] == pytest.approx(face)
        assert one.outline[2:, 0] == pytest.approx(middle)
        assert one.name_in_front
