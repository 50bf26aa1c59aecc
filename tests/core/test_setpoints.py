"""Courses and setpoints, one sample at a time."""

from __future__ import annotations

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from dart_flight.base.geometry import MissionFrame, Vec3
from dart_flight.base.records import Mode, OdometrySample, Phase, Setpoint
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.mission_file import TrajectoryPieces
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission.course import Course
from dart_flight.core.mission.lock_commands import LockCommandState
from dart_flight.core.mission.mission_progress import MissionProgress
from dart_flight.core.mission.position_loop import ATTITUDE_LAG_S
from dart_flight.core.mission.replan import Replan
from dart_flight.core.mission.setpoint_selection import SetpointSelection
from dart_flight.core.mission.setpoints import BOTH, FreeAxes, Reference, SetpointTrigger, make_setpoint
from dart_flight.core.mission.trajectories import Trajectory, TrajectoryPoint
from dart_flight.core.sense.state import FlightState
from tests.core.conftest import known

MISSION = load_mission(packaged("missions", "paper_single_wall.yaml"))
FLYING, ALTITUDE_M = MISSION.vehicle.flying, MISSION.altitude_m
FRAME = MissionFrame(2.0, -1.0, 0.3, 0.6)
NO_PUSH: Vec3 = (0.0, 0.0, 0.0)
TRIGGER = SetpointTrigger(0, 0)
INTO_A_WALL = Trajectory.level(
    (0.0, 1.0, 0.5, 0.1, 0.0, 0.0), (0.0, -0.4, 0.25, -0.2, 0.0, 0.0), ALTITUDE_M, (2.0,)
)


def parts(setpoint: Setpoint) -> tuple[Vec3, Vec3 | None, Vec3 | None]:
    """Return position, velocity and acceleration in the mission frame."""
    v, a = setpoint.velocity_ned, setpoint.acceleration_ned
    return (
        FRAME.point_from_ned(setpoint.position_ned),
        None if v is None else FRAME.vector_from_ned(v),
        None if a is None else FRAME.vector_from_ned(a),
    )


def setpoint_parts(
    flown: Course, t_us: int, since_us: int | None = 0, mission: Mission = MISSION
) -> tuple[Vec3, Vec3 | None, Vec3 | None]:
    """Return the parts of the setpoint for a sample on a course that is flown since `since_us`."""
    progress, state = MissionProgress(mission, {}), FlightState()
    progress.course, progress.entered_us = flown, since_us
    # A waiting vehicle is commanded the target of its course.
    progress.phase = Phase.PREPARE if since_us is None else Phase.WAYPOINT
    sample = OdometrySample(t_us, t_us, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    setpoint, _ = SetpointSelection(mission).setpoint(sample, progress, state, FRAME, None)
    return parts(known(setpoint))


def has_parts(setpoint: Setpoint, *expected: Vec3 | None) -> bool:
    """Return whether the first parts of a setpoint are these."""
    pairs = zip(parts(setpoint), expected, strict=False)
    return all(found == (None if one is None else pytest.approx(one)) for found, one in pairs)


STANDING = Course((1.0, 2.0, 0.0), ALTITUDE_M)


def test_a_course_climbs_and_flies_from_rest_to_rest_at_its_altitude() -> None:
    assert (STANDING.on_transit, STANDING.duration_s) == (False, 0.0)
    climbing = STANDING.climb(FLYING)
    assert climbing.on_transit
    assert climbing.target == (1.0, 2.0, ALTITUDE_M)
    assert climbing.duration_s >= 1.8 * ALTITUDE_M / FLYING.climb_speed_m_s
    flown = climbing.fly_to((2.0, 2.0), FLYING)
    assert flown.target == (2.0, 2.0, ALTITUDE_M)
    slower = climbing.fly_to((2.0, 2.0), FLYING, 0.5 * FLYING.transit_speed_m_s)
    assert slower.duration_s > flown.duration_s
    higher = flown.fly_to_waypoint((0.0, 0.0, 2.5), FLYING, 1.0)
    assert (higher.target, higher.altitude_m) == ((0.0, 0.0, 2.5), 2.5)
    assert higher.hold((3.0, 3.0, 9.0)) == Course((3.0, 3.0, 2.5), 2.5)  # the altitude is kept
    moved = flown.move_frame((0.5, -0.25))
    assert (moved.target, moved.trajectory) == ((1.5, 2.25, ALTITUDE_M), flown.trajectory)


def test_a_step_has_only_a_position_and_a_trajectory_also_a_velocity() -> None:
    step = STANDING.hold((1.0, 2.0))
    place, *motion = setpoint_parts(step, 500, None)
    assert place == pytest.approx((1.0, 2.0, ALTITUDE_M))
    assert motion == [None, None]
    flown = step.fly_to((4.0, 2.0), FLYING)
    assert setpoint_parts(flown, 500, None)[1] is None  # not started
    half_us = round(0.5e6 * flown.duration_s)
    position, velocity, _ = setpoint_parts(flown, 500 + half_us, 500)
    assert position == pytest.approx((2.5, 2.0, ALTITUDE_M), abs=1e-5)
    assert velocity == pytest.approx((1.875 * 3.0 / flown.duration_s, 0.0, 0.0), abs=1e-5)


def test_drag_and_the_d_term_are_fed_forward_ahead_of_the_attitude_lag() -> None:
    """One lag ahead, the drag is b (v + lag a) and the reference needs a (1 + kd) + lag jerk."""
    x, y = (0.0, 1.0, 0.5, 0.1, 0.0, 0.0), (0.0, -0.4, 0.25, -0.2, 0.0, 0.0)
    trajectory = Trajectory.level(x, y, ALTITUDE_M, (5.0,))
    flown = STANDING.follow(trajectory)
    assert flown.target == trajectory.at(5.0).position
    at, (_, velocity, fed) = trajectory.at(1.0), setpoint_parts(flown, 1_000_000)
    assert velocity == pytest.approx(at.velocity)
    assert known(fed)[:2] == pytest.approx([needed_m_s2(at, at, axis) for axis in range(2)])


def mission_with_delays(delay_s: float, dead_s: float = 0.0) -> Mission:
    """Return the mission with these delays of the autopilot."""
    flying = structs.replace(FLYING, setpoint_delay_s=delay_s, attitude_delay_s=dead_s)
    return structs.replace(MISSION, vehicle=structs.replace(MISSION.vehicle, flying=flying))


def needed_m_s2(flown: TrajectoryPoint, tilted: TrajectoryPoint, axis: int, dead_s: float = 0.0) -> float:
    """Return the acceleration for drag, PX4's D term and the lag of the attitude less its dead time."""
    kd, drag = MISSION.vehicle.px4.mpc_xy_vel_d_acc, MISSION.vehicle.airframe.drag_per_s[axis]
    lead_s = ATTITUDE_LAG_S - dead_s
    push = (1.0 + kd + lead_s * drag) * tilted.acceleration[axis] + lead_s * tilted.jerk[axis]
    return push + drag * flown.velocity[axis]


@given(st.floats(0.0, 0.1), st.floats(0.0, 1.9))
def test_a_setpoint_is_computed_for_the_time_at_which_it_is_flown(delay_s: float, since_s: float) -> None:
    """On a trajectory, it equals the setpoint without a delay at the later time."""
    at_us, later_us = round(since_s * 1e6), round((since_s + delay_s) * 1e6)
    found = setpoint_parts(STANDING.follow(INTO_A_WALL), at_us, mission=mission_with_delays(delay_s))
    expected = setpoint_parts(STANDING.follow(INTO_A_WALL), later_us)
    for one, other in zip(found, expected, strict=True):
        assert one == pytest.approx(other, abs=1e-4)


@given(st.floats(0.0, 0.1), st.floats(0.0, 0.1), st.floats(0.0, 2.2))
def test_thrust_is_commanded_ahead_of_the_attitude_dead_time(
    delay_s: float, dead_s: float, since_s: float
) -> None:
    """Acceleration and jerk are taken later than position and velocity, but not beyond the wall."""
    at_us, end_s = round(since_s * 1e6), INTO_A_WALL.duration_s
    place, velocity, fed = setpoint_parts(
        STANDING.follow(INTO_A_WALL), at_us, mission=mission_with_delays(delay_s, dead_s)
    )
    flown_s = at_us * 1e-6 + delay_s
    flown = INTO_A_WALL.at(flown_s)
    tilted = INTO_A_WALL.at(min(flown_s + dead_s, max(at_us * 1e-6, end_s)))
    assert place == pytest.approx(flown.position, abs=1e-9)
    assert velocity == pytest.approx(flown.velocity, abs=1e-9)
    assert fed is not None
    expected = [needed_m_s2(flown, tilted, axis, dead_s) for axis in range(2)]
    assert fed[:2] == pytest.approx(expected, abs=1e-9)


def parts_before_wall(
    mission: Mission, sample: OdometrySample, mode: Mode | None = None
) -> tuple[Vec3, Vec3 | None, Vec3 | None]:
    """Return the parts of the setpoint shortly before a wall on the mission's own trajectory.

    With a mode of the arms, the trajectory is a replanned one that ends leaning.
    """
    pieces = TrajectoryPieces((0.0, 0.0), [(1.0, 0.0, 0.0)])
    (collision,) = (msgspec.structs.replace(one, trajectory=pieces) for one in mission.collisions)
    progress, state = MissionProgress(mission, {}), FlightState()
    progress.collisions, progress.course = [collision], STANDING.follow(INTO_A_WALL)
    progress.phase, progress.entered_us, state.now_us = Phase.APPROACH, 0, sample.t_us
    if mode is not None:
        progress.collisions = [msgspec.structs.replace(collision, mode=mode)]
        impact_us = round(1e6 * INTO_A_WALL.duration_s)
        progress.replan = Replan(trajectory=INTO_A_WALL, ends_leaning=True, impact_us=impact_us)
        progress.phase = Phase.RECOVERY
    setpoint, _ = SetpointSelection(mission).setpoint(sample, progress, state, FRAME, None)
    return parts(known(setpoint))


def test_a_delayed_setpoint_does_not_reach_beyond_the_wall() -> None:
    """Shortly before the wall, it has the thrust at the wall and the vehicle's own velocity."""
    mission, end_us = mission_with_delays(0.03, 0.05), round(1e6 * INTO_A_WALL.duration_s)
    wall, motion = MISSION.walls[0], (0.7, -0.1, 0.0)
    at_wall = INTO_A_WALL.at(INTO_A_WALL.duration_s)
    x, y, _ = at_wall.position
    sample = OdometrySample(
        end_us - 10_000, 0, FRAME.point_to_ned(at_wall.position), FRAME.vector_to_ned(motion)
    )
    place, velocity, fed = parts_before_wall(mission, sample)
    assert known(fed)[:2] == pytest.approx([needed_m_s2(at_wall, at_wall, axis, 0.05) for axis in range(2)])
    assert velocity is not None
    across = [wall.normal[axis] for axis in range(2)]
    assert sum(v * n for v, n in zip(velocity, across, strict=False)) == pytest.approx(
        sum(v * n for v, n in zip(motion, across, strict=False))
    )
    # Across the wall, the setpoint is at the vehicle's predicted position, so nothing brakes.
    there = (x + 0.03 * motion[0], y + 0.03 * motion[1])
    assert sum(p * n for p, n in zip(place, across, strict=False)) == pytest.approx(
        sum(p * n for p, n in zip(there, across, strict=False))
    )


@given(st.floats(0.01, 0.24), st.floats(0.01, 0.24), st.floats(0.5, 3.0))
def test_the_lean_before_a_wall_follows_the_vehicles_own_time_to_impact(
    planned_s: float, left_s: float, closing_m_s: float
) -> None:
    """A vehicle ahead of its trajectory leans up to 0.1 s sooner, across the wall only."""
    wall, end_s = MISSION.walls[0], INTO_A_WALL.duration_s
    (nx, ny), (tx, ty), (x, y, _) = wall.normal, wall.tangent, INTO_A_WALL.at(end_s).position
    at_us = round(1e6 * (end_s - planned_s))
    away_m = closing_m_s * left_s
    sample = OdometrySample(
        at_us,
        0,
        FRAME.point_to_ned((x + away_m * nx, y + away_m * ny, ALTITUDE_M)),
        FRAME.vector_to_ned((-closing_m_s * nx, -closing_m_s * ny, 0.0)),
    )
    _, _, fed = parts_before_wall(mission_with_delays(0.0), sample)
    early_s = max(-0.1, min(0.1, planned_s - left_s))
    _, _, planned = setpoint_parts(STANDING.follow(INTO_A_WALL), at_us)
    _, _, own = setpoint_parts(STANDING.follow(INTO_A_WALL), at_us + round(1e6 * early_s))
    assert fed is not None
    assert planned is not None
    assert own is not None
    assert fed[0] * tx + fed[1] * ty == pytest.approx(planned[0] * tx + planned[1] * ty, abs=1e-4)
    assert fed[0] * nx + fed[1] * ny == pytest.approx(own[0] * nx + own[1] * ny, abs=1e-4)


@pytest.mark.parametrize("mode", Mode)
def test_rigid_arms_keep_the_planned_time_of_a_replanned_lean(mode: Mode) -> None:
    """The planner reduces this lean for rigid arms; a vehicle that is early must not lean more again."""
    wall, end = MISSION.walls[0], INTO_A_WALL.at(INTO_A_WALL.duration_s)
    at_us, closing_m_s = round(1e6 * (INTO_A_WALL.duration_s - 0.1)), 1.0
    x, y, _ = end.position
    place = (x + 0.05 * closing_m_s * wall.normal[0], y + 0.05 * closing_m_s * wall.normal[1], ALTITUDE_M)
    motion = (-closing_m_s * wall.normal[0], -closing_m_s * wall.normal[1], 0.0)
    sample = OdometrySample(at_us, 0, FRAME.point_to_ned(place), FRAME.vector_to_ned(motion))
    _, _, fed = parts_before_wall(mission_with_delays(0.0), sample, mode)
    leans_us = at_us if mode is Mode.RIGID else at_us + 50_000
    _, _, planned = setpoint_parts(STANDING.follow(INTO_A_WALL), leans_us)
    across = [sum(a * n for a, n in zip(known(one)[:2], wall.normal, strict=True)) for one in (fed, planned)]
    assert across[0] == pytest.approx(across[1], abs=1e-4)


def test_only_drag_is_added_in_the_climb() -> None:
    references = STANDING.climb(FLYING)
    at_us = round(0.3e6 * references.duration_s)
    _, velocity, fed = setpoint_parts(references, at_us)
    _, before, _ = setpoint_parts(references, at_us - 100)
    _, after, _ = setpoint_parts(references, at_us + 100)
    assert velocity is not None
    assert before is not None
    assert after is not None
    assert fed is not None
    drag = MISSION.vehicle.airframe.drag_per_s[2]
    assert fed[2] == pytest.approx((after[2] - before[2]) / 200e-6 + drag * velocity[2], abs=1e-3)


def test_an_approach_does_not_change_the_target() -> None:
    approach = Trajectory.run_up((1.0, 2.0), (1.0, 0.0), 0.5, 1.75, ALTITUDE_M)
    flown = STANDING.hold((1.0, 2.0)).approach(approach)
    assert (flown.target, flown.on_transit) == ((1.0, 2.0, ALTITUDE_M), False)
    position, velocity, _ = setpoint_parts(flown, 1_000_000)
    assert position == pytest.approx((1.75, 2.0, ALTITUDE_M))
    assert velocity == pytest.approx((1.0, 0.0, 0.0))


coordinate = st.floats(-3.0, 3.0)
vector = st.tuples(coordinate, coordinate, coordinate)


@given(vector, vector, vector, vector, vector, vector, st.floats(-math.pi, math.pi))
def test_a_setpoint_uses_the_measured_motion_on_free_axes_only(
    position: Vec3, velocity: Vec3, push: Vec3, there: Vec3, motion: Vec3, added: Vec3, angle: float
) -> None:
    """A free axis has no error to correct; the other axes and the height use the reference."""
    reference, normal = Reference(position, velocity, push), (math.cos(angle), math.sin(angle))
    total = tuple(a + b for a, b in zip(push, added, strict=True))
    for along in ((), (normal,), BOTH):
        free = FreeAxes(along, there, motion)
        found = parts(make_setpoint(FRAME, TRIGGER, reference, 0.0, free if along else None, added))
        for part, expected, measured in ((found[0], position, there), (found[1], velocity, motion)):
            assert part is not None
            assert part[2] == pytest.approx(expected[2], abs=1e-9)
            for axis in ((1.0, 0.0), (0.0, 1.0)) if len(along) != 1 else (normal, (-normal[1], normal[0])):
                source = measured if axis in along else expected
                value = part[0] * axis[0] + part[1] * axis[1]
                assert value == pytest.approx(source[0] * axis[0] + source[1] * axis[1], abs=1e-9)
        assert found[2] == pytest.approx(total, abs=1e-9)


def test_a_step_carries_an_acceleration_only_if_one_is_added() -> None:
    """PX4 accepts an acceleration only with a velocity; a recovery setpoint is marked."""
    place = (1.0, 2.0, 1.5)
    recovery = make_setpoint(FRAME, SetpointTrigger(5, 6, recovery=True), Reference(place), 0.2)
    assert (recovery.t_us, recovery.trigger_received_us, recovery.recovery) == (5, 6, True)
    assert has_parts(recovery, place, None, None)
    pushed = make_setpoint(FRAME, TRIGGER, Reference(place), 0.2, added=(0.5, -0.2, 0.0))
    assert has_parts(pushed, place, NO_PUSH, (0.5, -0.2, 0.0))


def test_a_transit_to_the_current_position_takes_a_tenth_of_a_second() -> None:
    """A duration of zero would cause a division by zero."""
    here = (1.0, 2.0, ALTITUDE_M)
    assert Trajectory.rest_to_rest(here, here, 1.0, FLYING).duration_s == 0.1


@pytest.mark.parametrize("along", [(1.0, 0.0), (0.0, 1.0)])
def test_a_position_with_one_free_axis_commands_rest_along_the_other(along: tuple[float, float]) -> None:
    free = FreeAxes((along,), (0.5, 0.7, 1.2), (0.3, -0.4, 0.1))
    found = make_setpoint(FRAME, TRIGGER, Reference((1.0, 2.0, 1.0), None), 0.2, free)
    x, y = along
    assert has_parts(found, (0.5 if x else 1.0, 0.7 if y else 2.0, 1.0), (0.3 * x, -0.4 * y, 0.0))


@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, 1.0), (-0.6, 0.8)])
@pytest.mark.parametrize(("share", "pushed"), [(0.9, True), (1.1, False)])
def test_after_a_contact_a_vehicle_slower_than_its_trajectory_is_accelerated_along_it(
    direction: tuple[float, float], share: float, pushed: bool
) -> None:
    """A vehicle that already leans off the wall is as fast as the trajectory, in whichever direction."""
    mission = load_mission(packaged("missions", "shuttle.yaml"))
    following = next(c for c in mission.collisions if c.trajectory is not None and c.approach_m_s is None)
    trajectory = Trajectory.from_mission(known(following.trajectory), mission.altitude_m)
    progress, state, after_us = MissionProgress(mission, {}), FlightState(), 50_000
    progress.index = mission.collisions.index(following)
    progress.phase, progress.lock = Phase.RECOVERY, LockCommandState(contact_end_us=1_000_000)
    speed = share * math.hypot(*trajectory.at(1e-6 * after_us).velocity[:2])
    state.now_us, state.velocity = 1_000_000 + after_us, (speed * direction[0], speed * direction[1], 0.0)
    sample = OdometrySample(state.now_us, state.now_us, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    setpoint, _ = SetpointSelection(mission).setpoint(sample, progress, state, FRAME, None)
    _, _, acceleration = parts(known(setpoint))
    assert (acceleration is not None and math.hypot(*acceleration) > 0.1) is pushed
