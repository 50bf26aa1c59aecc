"""Property tests of frames, rotations and walls."""

import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from dart_flight.base.geometry import (
    MissionFrame,
    Quaternion,
    RoomFrame,
    Vec3,
    advance_attitude,
    norm,
    quaternion_conjugate,
    quaternion_from_euler,
    quaternion_multiply,
    quaternion_normalise,
    rotate,
    tilt_of,
    wrap_angle,
    yaw_ned_of,
)
from dart_flight.base.walls import Wall

metres = st.floats(-1e3, 1e3)
angles = st.floats(-10.0, 10.0)
vectors = st.tuples(metres, metres, metres)
frames = st.builds(MissionFrame, metres, metres, metres, angles)


@st.composite
def rotations(draw: st.DrawFn) -> Quaternion:
    parts = [draw(st.floats(-1.0, 1.0)) for _ in range(4)]
    assume(sum(p * p for p in parts) > 1e-3)
    return quaternion_normalise((parts[0], parts[1], parts[2], parts[3]))


@st.composite
def walls(draw: st.DrawFn) -> Wall:
    angle = draw(angles)
    point = (draw(metres), draw(metres))
    return Wall("wall", point, (math.cos(angle), math.sin(angle)), draw(st.floats(0.1, 50.0)), "wood")


def close(a: Vec3, b: Vec3, tolerance: float = 1e-9) -> bool:
    return math.dist(a, b) <= tolerance * (1.0 + norm(a))


@given(frames, vectors)
def test_mission_frame_and_ned_round_trip(frame: MissionFrame, v: Vec3) -> None:
    assert close(frame.vector_from_ned(frame.vector_to_ned(v)), v)
    assert close(frame.vector_to_ned(frame.vector_from_ned(v)), v)
    assert math.dist(frame.point_from_ned(frame.point_to_ned(v)), v) < 1e-9
    assert norm(frame.vector_to_ned(v)) == pytest.approx(norm(v), rel=1e-12)


@given(frames, angles)
def test_yaw_round_trips_and_agrees_with_vectors(frame: MissionFrame, yaw: float) -> None:
    assert abs(wrap_angle(frame.yaw_from_ned(frame.yaw_to_ned(yaw)) - yaw)) < 1e-9
    # A heading is the direction of a vector in either frame.
    ned = frame.vector_to_ned((math.cos(yaw), math.sin(yaw), 0.0))
    assert abs(wrap_angle(math.atan2(ned[1], ned[0]) - frame.yaw_to_ned(yaw))) < 1e-9


def test_mission_frame_is_x_forward_y_left_z_up() -> None:
    east = MissionFrame(heading_rad=math.pi / 2)
    assert close(east.vector_to_ned((1.0, 0.0, 0.0)), (0.0, 1.0, 0.0))  # x: east
    assert close(east.vector_to_ned((0.0, 1.0, 0.0)), (1.0, 0.0, 0.0))  # y: to the left of east is north
    assert close(east.vector_to_ned((0.0, 0.0, 1.0)), (0.0, 0.0, -1.0))


@given(walls(), vectors)
def test_collision_frame_round_trips(wall: Wall, v: Vec3) -> None:
    assert close(wall.from_collision(wall.to_collision(v)), v)
    assert close(wall.to_collision(wall.from_collision(v)), v)


def test_collision_frame_axes_are_those_of_the_paper() -> None:
    """Y is to the right when looking along X in a z-up frame; Z = X x Y points down."""
    north_wall = Wall("w", (0.0, 0.0), (0.0, 1.0), 1.0, "wood")
    assert close(north_wall.from_collision((0.0, 1.0, 0.0)), (1.0, 0.0, 0.0))
    east_wall = Wall("w", (0.0, 0.0), (-1.0, 0.0), 1.0, "wood")
    assert close(east_wall.from_collision((0.0, 1.0, 0.0)), (0.0, 1.0, 0.0))
    assert close(north_wall.from_collision((0.0, 0.0, 1.0)), (0.0, 0.0, -1.0))


@given(walls(), metres, metres)
def test_a_wall_returns_the_distance_and_the_position_along_it(wall: Wall, away: float, along: float) -> None:
    n, t = wall.normal, wall.tangent
    p = (wall.point[0] + away * n[0] + along * t[0], wall.point[1] + away * n[1] + along * t[1])
    assert wall.signed_distance(p) == pytest.approx(away, abs=1e-9)
    assert wall.along(p) == pytest.approx(along, abs=1e-9)
    assert abs(n[0] * t[0] + n[1] * t[1]) < 1e-12


@given(walls(), angles)
def test_parallel_yaw_is_the_nearest_of_four(wall: Wall, yaw: float) -> None:
    parallel = wall.parallel_yaw(yaw)
    assert abs(wrap_angle(parallel - yaw)) <= math.pi / 4 + 1e-9
    # The leading edge is parallel: body x is along the normal or the tangent.
    along = parallel - math.atan2(wall.normal[1], wall.normal[0])
    assert abs(math.sin(2.0 * along)) < 1e-9
    assert wall.incidence(parallel) < 1e-9
    assert 0.0 <= wall.incidence(yaw) <= math.pi / 4 + 1e-9


def test_perpendicular_walls_need_no_turn() -> None:
    wood = Wall("w", (0.0, 0.0), (0.0, 1.0), 1.0, "wood")
    acrylic = Wall("a", (0.0, 0.0), (-1.0, 0.0), 1.0, "acrylic")
    yaw = wood.parallel_yaw(0.3)
    assert abs(wrap_angle(acrylic.parallel_yaw(yaw) - yaw)) < 1e-9


@given(rotations(), vectors)
def test_rotation_keeps_length_and_has_an_inverse(q: Quaternion, v: Vec3) -> None:
    assert norm(rotate(q, v)) == pytest.approx(norm(v), rel=1e-9, abs=1e-9)
    assert close(rotate(quaternion_conjugate(q), rotate(q, v)), v)


@given(rotations(), rotations(), vectors)
def test_product_rotates_by_the_right_factor_first(a: Quaternion, b: Quaternion, v: Vec3) -> None:
    assert close(rotate(quaternion_multiply(a, b), v), rotate(a, rotate(b, v)))


@given(st.floats(-3.1, 3.1), st.floats(-0.7, 0.7), st.floats(-0.7, 0.7))
def test_euler_angles_round_trip_through_a_quaternion(yaw: float, pitch: float, roll: float) -> None:
    q = quaternion_from_euler(roll, pitch, yaw)
    assert yaw_ned_of(q) == pytest.approx(yaw, abs=1e-9)
    assert math.cos(tilt_of(q)) == pytest.approx(math.cos(roll) * math.cos(pitch), abs=1e-9)


@given(rotations(), vectors, st.floats(-0.05, 0.05))
def test_an_attitude_advanced_and_reversed_is_unchanged(q: Quaternion, rate: Vec3, dt: float) -> None:
    back = advance_attitude(advance_attitude(q, rate, dt), rate, -dt)
    assert abs(abs(sum(x * y for x, y in zip(back, q, strict=True))) - 1.0) < 1e-9


@given(st.floats(-1e4, 1e4))
def test_wrapped_angles_lie_within_half_a_turn(angle: float) -> None:
    wrapped = wrap_angle(angle)
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0, abs=1e-9)


def test_a_zero_quaternion_is_rejected() -> None:
    with pytest.raises(ValueError, match="not a rotation"):
        quaternion_normalise((0.0, 0.0, 0.0, 0.0))


@given(vectors, rotations(), st.booleans(), angles, vectors, angles)
def test_a_pose_in_the_room_converts_to_ned_and_back(
    position: Vec3, q: Quaternion, y_up: bool, heading: float, offset: Vec3, nose: float
) -> None:
    room = RoomFrame(y_up, heading, offset, nose)
    back, q_back = room.pose_to_ned(*room.pose_from_ned(position, q))
    assert close(back, position)
    assert abs(sum(a * b for a, b in zip(q, q_back, strict=True))) == pytest.approx(1.0, abs=1e-9)


def test_room_axes_map_to_ned_with_z_up_and_with_y_up() -> None:
    east = RoomFrame(False, math.radians(90.0))  # x points east, so y points north
    position, q = east.pose_to_ned((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    assert close(position, (2.0, 1.0, -3.0))
    assert yaw_ned_of(q) == pytest.approx(math.radians(90.0))
    north = RoomFrame(True, 0.0)  # z points north, so x points west
    position, q = north.pose_to_ned((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    assert close(position, (3.0, -1.0, -2.0))
    assert yaw_ned_of(q) == pytest.approx(0.0)
    assert tilt_of(q) == pytest.approx(0.0, abs=1e-9)


def test_marker_body_offset_and_nose_direction_are_applied() -> None:
    room = RoomFrame(False, 0.0, (0.1, 0.0, -0.05), math.radians(90.0))
    position, q = room.pose_to_ned((1.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
    assert close(position, (1.1, 0.0, -0.95))
    assert yaw_ned_of(q) == pytest.approx(math.radians(-90.0))
