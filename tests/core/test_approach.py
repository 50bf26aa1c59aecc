"""Obstacles on a straight path, and references that are consistent with their derivatives."""

from __future__ import annotations

import itertools
import math
import re

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.geometry import Vec2, distance2
from dart_flight.base.walls import Post, Wall
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import Flying, packaged
from dart_flight.core.mission.approach import (
    CLEARANCE_M,
    NoApproachError,
    check_segments_clear,
    impact_time_s,
    is_blocked,
    plan_approach,
    run_up,
    standoff_point,
    transit_segments,
)
from dart_flight.core.mission.trajectories import AfterEnd, Trajectory
from tests.core.conftest import known

beside = st.floats(-2.0, 2.0)
away = st.floats(CLEARANCE_M + 0.01, 2.0)


@given(
    angle=st.floats(-math.pi, math.pi),
    place=st.tuples(beside, beside),
    ends=st.tuples(away, beside, away, beside),
    half_m=st.sampled_from((0.0, 0.3)),
)
def test_a_path_is_blocked_if_it_crosses_the_wall_within_its_length(
    angle: float, place: tuple[float, float], ends: tuple[float, float, float, float], half_m: float
) -> None:
    """The ends are distances from and along the plane; similar triangles give the crossing point."""
    wall = Wall("wall", place, (math.cos(angle), math.sin(angle)), 1.0, "wood", half_vehicle_m=half_m)
    before, start_along, behind, end_along = ends

    def at(distance: float, along: float) -> tuple[float, float]:
        (x, y), (nx, ny), (tx, ty) = wall.point, wall.normal, wall.tangent
        return x + distance * nx + along * tx, y + distance * ny + along * ty

    share = (before - CLEARANCE_M) / (before + behind)
    crossed = start_along + share * (end_along - start_along)
    a, b = at(before, start_along), at(-behind, end_along)
    beyond = abs(crossed) - 0.5 - half_m  # distance past the wall's end, for half a vehicle
    if abs(beyond) > 1e-6:
        assert is_blocked(wall, a, b) == (beyond < 0.0)
    assert not is_blocked(wall, a, at(behind, end_along))  # stays on one side
    for depth_m in (-0.9 * CLEARANCE_M, 0.9 * CLEARANCE_M):
        assert is_blocked(wall, at(depth_m, 0.0), at(-behind, 0.0))  # starts too close, on either side
    assert not is_blocked(wall, at(-1.1 * CLEARANCE_M, 0.0), at(-behind, 0.0))


# --- references ------------------------------------------------------------------------------------------

MISSION = load_mission(packaged("missions", "paper_single_wall.yaml"))
FLYING = MISSION.vehicle.flying


def flying_at(acceleration_m_s2: float) -> Flying:
    return msgspec.structs.replace(FLYING, acceleration_m_s2=acceleration_m_s2)


place = st.tuples(beside, beside)
coefficients = st.tuples(*[st.floats(-2.0, 2.0)] * 6)
PARTS = ("position", "velocity", "acceleration", "jerk")


def assert_consistent(trajectory: Trajectory, t: float, h: float = 1e-5) -> None:
    """Compare velocity, acceleration and jerk with the difference quotients over a step of `2 h`."""
    at, before, after = trajectory.at(t), trajectory.at(t - h), trajectory.at(t + h)
    for part, derivative in itertools.pairwise(PARTS):
        ends = zip(getattr(before, part), getattr(after, part), strict=True)
        slopes = [(b - a) / (2.0 * h) for a, b in ends]
        assert slopes == pytest.approx(getattr(at, derivative), rel=1e-3, abs=1e-3)


@given(coefficients, coefficients, st.floats(0.2, 3.0), st.floats(0.01, 0.99), st.floats(0.01, 2.0))
def test_a_level_trajectory_is_consistent_with_its_derivatives_and_continues_straight(
    x: tuple[float, ...], y: tuple[float, ...], duration_s: float, share: float, more_s: float
) -> None:
    plan = Trajectory.level(x, y, 1.0, (duration_s,))
    assert_consistent(plan, share * duration_s, 1e-3 * min(share, 1.0 - share) * duration_s)
    end, beyond = plan.at(duration_s), plan.at(duration_s + more_s)
    assert beyond.velocity == end.velocity
    assert beyond.position == pytest.approx(
        [p + more_s * v for p, v in zip(end.position, end.velocity, strict=True)]
    )
    assert beyond.acceleration == beyond.jerk == (0.0, 0.0, 0.0)


@given(place, st.floats(-math.pi, math.pi), st.floats(0.2, 3.0), st.floats(0.3, 2.0), st.floats(0.02, 0.98))
def test_an_approach_is_consistent_with_its_derivatives(
    begin: tuple[float, float], angle: float, speed_m_s: float, ramp_s: float, share: float
) -> None:
    """After the ramp the speed is constant, and the wall is reached at the end of the duration."""
    direction = (math.cos(angle), math.sin(angle))
    impact = (begin[0] + 4.0 * direction[0], begin[1] + 4.0 * direction[1])
    velocity = (speed_m_s * direction[0], speed_m_s * direction[1])
    steady_s = max(0.0, 4.0 / speed_m_s - 0.5 * ramp_s)
    approach = Trajectory.run_up(begin, velocity, ramp_s, steady_s, 1.5)
    assert_consistent(approach, share * ramp_s, 1e-5 * ramp_s)
    assert approach.at(0.0).position == pytest.approx((*begin, 1.5))
    at_impact = approach.at(approach.duration_s)
    if steady_s > 0.0:
        assert at_impact.position == pytest.approx((*impact, 1.5))
        assert at_impact.velocity == pytest.approx((speed_m_s * direction[0], speed_m_s * direction[1], 0.0))
        assert at_impact.acceleration == at_impact.jerk == (0.0, 0.0, 0.0)
    assert approach.at(-1.0).position == approach.at(0.0).position
    beyond = approach.at(approach.duration_s + 0.1)
    assert beyond.velocity == pytest.approx(at_impact.velocity)
    moved = [b - a for a, b in zip(at_impact.position, beyond.position, strict=True)]
    assert moved == pytest.approx([0.1 * v for v in at_impact.velocity])


@given(st.tuples(beside, beside, away), st.tuples(beside, beside, away), st.floats(0.0, 1.0))
def test_a_transit_goes_from_rest_to_rest_within_its_limits(
    begin: tuple[float, float, float], end: tuple[float, float, float], share: float
) -> None:
    transit = Trajectory.rest_to_rest(begin, end, 0.8, flying_at(0.6), 0.4)
    t = share * transit.duration_s
    at = transit.at(t)
    if 1e-5 < t < transit.duration_s - 1e-5:
        assert_consistent(transit, t)
    assert math.hypot(*at.velocity) <= 0.8 * 1.001
    assert math.hypot(*at.acceleration) <= 0.6 * 1.001
    assert abs(at.velocity[2]) <= 0.4 * 1.001
    assert transit.after is AfterEnd.HOLD
    for moment, where in ((-1.0, begin), (0.0, begin), (transit.duration_s, end), (99.0, end)):
        there = transit.at(moment)
        assert there.position == pytest.approx(where)
        assert there.velocity == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_a_transit_reaches_one_of_its_limits() -> None:
    """Speed limits a long transit, acceleration a short one, and climb speed a steep one."""
    for end, speed_m_s, acceleration_m_s2, climb_m_s in (
        ((5.0, 0.0, 0.0), 0.8, 100.0, 9.0),
        ((0.3, 0.0, 0.0), 80.0, 0.6, 9.0),
        ((0.1, 0.0, 5.0), 0.8, 100.0, 0.4),
    ):
        transit = Trajectory.rest_to_rest(
            (0.0, 0.0, 0.0), end, speed_m_s, flying_at(acceleration_m_s2), climb_m_s
        )
        points = [transit.at(transit.duration_s * i / 1000) for i in range(1001)]
        used = (
            max(math.hypot(*p.velocity) for p in points) / speed_m_s,
            max(math.hypot(*p.acceleration) for p in points) / acceleration_m_s2,
            max(abs(p.velocity[2]) for p in points) / climb_m_s,
        )
        assert max(used) == pytest.approx(1.0, abs=0.01)


@given(st.floats(-0.8, 0.8), st.floats(0.3, 2.0), st.floats(0.0, 0.05))
def test_a_run_up_has_the_shortest_length_that_its_limits_allow(
    slant: float, speed_m_s: float, sd: float
) -> None:
    """The vehicle accelerates at the limit, then is steady before the nearest possible wall."""
    wall, impact = Wall("wall", (3.0, 0.0), (-1.0, 0.0), 4.0, "wood", sd or None), (3.0, 0.5)
    velocity = (speed_m_s * math.cos(slant), speed_m_s * math.sin(slant))
    far = (-90.0, 40.0)  # not on the ray
    begin, direction, speed, ramp_s = run_up(far, impact, velocity, FLYING, wall)
    steady_s = impact_time_s(distance2(begin, impact), speed, ramp_s) - ramp_s
    along = (speed * direction[0], speed * direction[1])
    approach = Trajectory.run_up((float(begin[0]), float(begin[1])), along, ramp_s, steady_s, 1.0)
    top = max(math.hypot(*approach.at(ramp_s * i / 200).acceleration) for i in range(201))
    assert top == pytest.approx(FLYING.acceleration_m_s2, rel=1e-3)
    assert approach.at(approach.duration_s).position == pytest.approx((*impact, 1.0))
    assert steady_s - 3.0 * sd / velocity[0] == pytest.approx(FLYING.steady_run_s, abs=1e-9)
    on_ray = (impact[0] - 9.0 * math.cos(slant), impact[1] - 9.0 * math.sin(slant))
    start_along, *_ = run_up(on_ray, impact, velocity, FLYING, wall)
    assert start_along == pytest.approx(on_ray)  # far enough back: the run-up starts at the vehicle
    near = (impact[0] - 0.1 * math.cos(slant), impact[1] - 0.1 * math.sin(slant))
    assert run_up(near, impact, velocity, FLYING, wall).begin == pytest.approx(begin)


@pytest.mark.parametrize(("sd", "stops_at_m"), [(None, 0.4), (0.1, 0.7)])
def test_a_rehearsal_stops_at_the_standoff_from_the_nearest_possible_wall(
    sd: float | None, stops_at_m: float
) -> None:
    mission = msgspec.structs.replace(MISSION, standoff_m=0.4)
    wall = Wall("wall", (3.0, 0.0), (-1.0, 0.0), 4.0, "wood", sd)
    collision = msgspec.structs.replace(mission.collisions[0], wall=wall)
    stop = standoff_point(mission, collision, (0.0, -1.0), (3.0, 0.5))
    assert wall.signed_distance(stop) == pytest.approx(stops_at_m)
    assert stop[1] == pytest.approx(-1.0 + 0.5 * stop[0])  # on the line
    for near in ((2.9, 0.0), (3.0 - stops_at_m + 1e-9, 0.0)):
        assert standoff_point(mission, collision, near, (3.0, 0.5)) == near
    assert standoff_point(mission, collision, (1.0, 0.0), (1.0, 0.5)) == (1.0, 0.0)  # along the wall


def mission_with(waypoints: list[dict[str, object]], post: tuple[float, float]) -> Mission:
    """Return the single-wall mission with waypoints and a post."""
    one = load_mission(packaged("missions", "paper_single_wall.yaml")).replace({"waypoints": waypoints})
    return msgspec.structs.replace(one, posts=(Post("pole", post, 0.05, "acrylic"),))


@pytest.mark.parametrize(
    ("waypoint", "post", "blocked"),
    [
        ({"position_m": [-1.0, 1.0]}, (-0.5, 0.5), True),
        ({"position_m": [-1.0, 1.0]}, (-0.5, -0.8), False),
        ({"position_m": [-1.0, 1.0], "after": 1}, (-0.5, 0.5), False),  # its start is not known
    ],
)
def test_a_blocked_path_between_known_ends_is_refused(
    waypoint: dict[str, object], post: tuple[float, float], blocked: bool
) -> None:
    mission = mission_with([waypoint], post)
    if blocked:
        with pytest.raises(NoApproachError, match="blocks the path to"):
            check_segments_clear(mission)
    else:
        check_segments_clear(mission)


@pytest.mark.parametrize(
    ("post", "blocked_part"),
    [((0.8, 0.4), "the run-up"), ((-0.3, -0.9), "the path to the run-up"), ((0.8, -1.0), None)],
)
def test_a_post_blocks_an_approach_in_its_run_up_and_before_it(
    post: tuple[float, float], blocked_part: str | None
) -> None:
    mission = msgspec.structs.replace(mission_with([], post), start=(0.0, -1.4))
    if blocked_part is None:
        assert plan_approach(mission, mission.collisions[0]).after is AfterEnd.CONTINUE
    else:
        with pytest.raises(NoApproachError, match=f"post pole blocks {blocked_part}"):
            plan_approach(mission, mission.collisions[0])


@pytest.mark.parametrize(
    ("board", "blocked"),
    [
        ((0.9, 0.1), True),  # across the run-up
        ((0.9, 1.2), False),  # beside it
        ((1.8, 0.5), False),  # behind the wall to be hit
    ],
)
def test_a_wall_across_the_run_up_blocks_the_approach(board: tuple[float, float], blocked: bool) -> None:
    """The run-up leads from (0, 0) to the acrylic wall at (1.65, 0.825)."""
    across = Wall("board", board, (-1.0, 0.0), 0.8, "wood")
    mission = msgspec.structs.replace(MISSION, walls=(*MISSION.walls, across))
    if blocked:
        with pytest.raises(NoApproachError, match=r"^wall board blocks the run-up$"):
            plan_approach(mission, mission.collisions[0])
    else:
        assert plan_approach(mission, mission.collisions[0]).begin == pytest.approx((0.0, 0.0, 1.0))


@pytest.mark.parametrize(("inside_m", "refused"), [(0.01, False), (-0.2, True)])
def test_an_impact_outside_the_flight_space_is_refused(inside_m: float, refused: bool) -> None:
    impact = known(MISSION.collisions[0].impact_point)
    bounds = msgspec.structs.replace(MISSION.bounds, x=(-1.5, impact[0] + inside_m))
    mission = msgspec.structs.replace(MISSION, bounds=bounds)
    if refused:
        place = re.escape(f"({impact[0]:.2f}, {impact[1]:.2f})")
        with pytest.raises(NoApproachError, match=rf"^the impact at {place} is 0\.20 m outside bounds_m$"):
            plan_approach(mission, mission.collisions[0])
    else:
        assert plan_approach(mission, mission.collisions[0]).begin == pytest.approx((0.0, 0.0, 1.0))


BOARD = Wall("board", (0.0, 0.0), (-1.0, 0.0), 0.6, "wood")


def with_board(mission: Mission, place: Vec2, normal: Vec2) -> Mission:
    board = msgspec.structs.replace(BOARD, point=place, normal=normal)
    return msgspec.structs.replace(mission, walls=(*mission.walls, board))


@pytest.mark.parametrize("facing", [1.0, -1.0])
@pytest.mark.parametrize(
    ("place", "normal", "blocked"),
    [((0.8, 0.4), (1.0, 0.0), True), ((0.2, -0.6), (0.0, 1.0), True), ((0.8, -1.0), (0.0, 1.0), False)],
)
def test_a_wall_blocks_an_approach_in_its_run_up_and_before_it(
    place: Vec2, normal: Vec2, facing: float, blocked: bool
) -> None:
    mission = msgspec.structs.replace(MISSION, start=(0.0, -1.4))
    mission = with_board(mission, place, (facing * normal[0], facing * normal[1]))
    if not blocked:
        assert plan_approach(mission, mission.collisions[0]).after is AfterEnd.CONTINUE
        return
    with pytest.raises(NoApproachError, match="wall board blocks the run-up"):
        plan_approach(mission, mission.collisions[0])


@pytest.mark.parametrize(("place", "blocked"), [((-0.5, 0.5), True), ((-0.5, -0.8), False)])
def test_a_wall_blocks_the_path_to_a_waypoint(place: Vec2, blocked: bool) -> None:
    mission = with_board(mission_with([{"position_m": [-1.0, 1.0]}], (9.0, 9.0)), place, (1.0, 0.0))
    if not blocked:
        check_segments_clear(mission)
        return
    with pytest.raises(NoApproachError, match="wall board blocks the path to waypoint 1"):
        check_segments_clear(mission)


@pytest.mark.parametrize(("place", "blocked"), [((-0.3, 0.6), True), ((0.2, -0.6), False)])
def test_the_path_to_a_run_up_begins_at_the_last_waypoint(place: Vec2, blocked: bool) -> None:
    one = msgspec.structs.replace(mission_with([{"position_m": [-1.0, 1.0]}], (9.0, 9.0)), start=(0.0, -1.4))
    mission = with_board(one, place, (1.0, 0.0))
    if not blocked:  # the board stands between the start and the run-up
        assert plan_approach(mission, mission.collisions[0]).after is AfterEnd.CONTINUE
        return
    with pytest.raises(NoApproachError, match="wall board blocks the run-up"):
        plan_approach(mission, mission.collisions[0])


def test_a_wall_blocks_the_trajectory_to_another_wall() -> None:
    mission = load_mission(packaged("missions", "touch_and_return.yaml"))
    check_segments_clear(mission)
    written = next(c for c in mission.collisions if c.trajectory is not None)
    trajectory = Trajectory.from_mission(known(written.trajectory), mission.altitude_m)
    there = trajectory.at(0.7 * trajectory.duration_s)
    (x, y, _), (vx, vy, _), speed_m_s = there.position, there.velocity, math.hypot(*there.velocity)
    blocked = with_board(mission, (x, y), (-vx / speed_m_s, -vy / speed_m_s))
    with pytest.raises(NoApproachError, match=f"board blocks the trajectory to wall {written.wall.name}"):
        check_segments_clear(blocked)


@pytest.mark.parametrize(
    ("name", "waypoints", "segments"),
    [
        ("hover", [], [("the goal", (0.0, 0.0))]),
        ("hover", [{"position_m": [-1.0, 1.0]}], [("waypoint 1", (0.0, 0.0)), ("the goal", (-1.0, 1.0))]),
        ("paper_single_wall", [], []),  # the recovery leads to the goal
        (
            "paper_single_wall",
            [{"position_m": [-1.0, 1.0], "after": 1}],
            [("waypoint 1", None), ("the goal", (-1.0, 1.0))],
        ),
        # a trajectory leads to the goal
        ("touch_and_return", [], [("waypoint 1", None), ("waypoint 2", None)]),
    ],
)
def test_only_flights_from_rest_are_segments(
    name: str, waypoints: list[dict[str, object]], segments: list[tuple[str, Vec2 | None]]
) -> None:
    mission = load_mission(packaged("missions", f"{name}.yaml"))
    found = transit_segments(mission.replace({"waypoints": waypoints}) if waypoints else mission)
    assert [(one.name, one.begin and one.begin[:2]) for one in found] == segments
