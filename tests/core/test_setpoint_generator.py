"""Targets, arrival and setpoints, one sample at a time; in flight: test_arrival, test_limits."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from dart_flight.base.geometry import MissionFrame, Vec3
from dart_flight.base.records import AttitudeSample, OdometrySample, Setpoint
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission.approach import Approach
from dart_flight.core.mission.position_loop import ATTITUDE_LAG_S
from dart_flight.core.mission.setpoint_generator import (
    ARRIVED_M,
    ARRIVED_M_S,
    ARRIVED_S,
    MEAN_SPEED_S,
    SetpointGenerator,
)
from dart_flight.core.mission.trajectories import PlannedTrajectory, TransitTrajectory
from dart_flight.core.sense.state import FlightState

MISSION = load_mission(packaged("missions", "paper_single_wall.yaml"))
FLYING, ALTITUDE_M = MISSION.vehicle.flying, MISSION.altitude_m
FRAME = MissionFrame(2.0, -1.0, 0.3, 0.6)
NO_PUSH: Vec3 = (0.0, 0.0, 0.0)
INTO_A_WALL = PlannedTrajectory(
    (0.0, 1.0, 0.5, 0.1, 0.0, 0.0), (0.0, -0.4, 0.25, -0.2, 0.0, 0.0), 2.0, ALTITUDE_M
)


def parts(setpoint: Setpoint) -> tuple[Vec3, Vec3 | None, Vec3 | None]:
    """Position, velocity, acceleration in the mission frame."""
    v, a = setpoint.velocity_ned, setpoint.acceleration_ned
    return (
        FRAME.point_from_ned(setpoint.position_ned),
        None if v is None else FRAME.vector_from_ned(v),
        None if a is None else FRAME.vector_from_ned(a),
    )


def says(setpoint: Setpoint, *wanted: Vec3 | None) -> bool:
    """Whether the first of its parts are these."""
    pairs = zip(parts(setpoint), wanted, strict=False)
    return all(found == (None if one is None else pytest.approx(one)) for found, one in pairs)


def standing() -> SetpointGenerator:
    references = SetpointGenerator(MISSION)
    references.stand((1.0, 2.0, 0.7), 0.2, 0)
    return references


def standing_on(trajectory: PlannedTrajectory) -> SetpointGenerator:
    references = standing()
    references.follow_trajectory(trajectory)
    return references


def test_it_stands_on_the_ground_climbs_and_flies_at_its_altitude() -> None:
    references = standing()
    assert (references.target, references.yaw, references.on_transit) == ((1.0, 2.0, 0.0), 0.2, False)
    assert references.duration_s == 0.0
    references.climb()
    assert references.on_transit
    assert references.target == (1.0, 2.0, ALTITUDE_M)
    climb_s = references.duration_s
    assert climb_s >= 1.8 * ALTITUDE_M / FLYING.climb_speed_m_s
    references.fly_to((2.0, 2.0))
    default_s = references.duration_s
    assert references.target == (2.0, 2.0, ALTITUDE_M)
    references.hold((1.0, 2.0))
    references.fly_to((2.0, 2.0), 0.5 * FLYING.transit_speed_m_s)
    assert references.duration_s > default_s
    references.fly_to_waypoint((0.0, 0.0, 2.5), 1.0)
    assert (references.target, references.altitude_m) == ((0.0, 0.0, 2.5), 2.5)
    references.hold((3.0, 3.0, 9.0))
    assert (references.target, references.on_transit) == ((3.0, 3.0, 2.5), False)  # the altitude is kept


def test_a_step_says_only_where_and_a_way_also_how_fast() -> None:
    references = standing()
    references.hold((1.0, 2.0))
    step = references.setpoint(FRAME, 500, 600, None)
    assert (step.t_us, step.trigger_received_us, step.recovery) == (500, 600, False)
    assert says(step, (1.0, 2.0, ALTITUDE_M), None, None)
    assert step.yaw_ned_rad == pytest.approx(FRAME.yaw_to_ned(0.2))
    pushed = references.setpoint(FRAME, 500, 600, None, (0.5, -0.2, 0.0))
    assert says(pushed, (1.0, 2.0, ALTITUDE_M), NO_PUSH, (0.5, -0.2, 0.0))
    recovery = references.recovery_setpoint(FRAME, 500, 600)
    assert (recovery.recovery, parts(recovery)) == (True, parts(step))
    references.fly_to((4.0, 2.0))
    assert parts(references.setpoint(FRAME, 500, 600, None))[1] is None  # not begun
    half_us = round(0.5e6 * references.duration_s)
    position, velocity, _ = parts(references.setpoint(FRAME, 500 + half_us, 0, 500))
    assert position == pytest.approx((2.5, 2.0, ALTITUDE_M), abs=1e-5)
    assert velocity == pytest.approx((1.875 * 3.0 / references.duration_s, 0.0, 0.0), abs=1e-5)


def test_drag_and_what_the_d_term_takes_are_fed_forward_ahead_of_the_attitudes_lag() -> None:
    """Drag b v, in a lag's time b (v + lag a); the reference's own a (1 + kd), and its change."""
    references = standing()
    x, y = (0.0, 1.0, 0.5, 0.1, 0.0, 0.0), (0.0, -0.4, 0.25, -0.2, 0.0, 0.0)
    way = PlannedTrajectory(x, y, 5.0, ALTITUDE_M)
    references.follow_trajectory(way)
    assert references.target == way.at(5.0).position
    at, (_, velocity, fed) = way.at(1.0), parts(references.setpoint(FRAME, 1_000_000, 0, 0))
    assert velocity == pytest.approx(at.velocity)
    assert fed is not None
    kd = MISSION.vehicle.px4.mpc_xy_vel_d_acc
    for axis, drag in enumerate(MISSION.vehicle.airframe.drag_per_s[:2]):
        later_m_s = at.velocity[axis] + ATTITUDE_LAG_S * at.acceleration[axis]
        later_m_s2 = at.acceleration[axis] + ATTITUDE_LAG_S * at.jerk[axis]
        assert fed[axis] == pytest.approx(drag * later_m_s + later_m_s2 + kd * at.acceleration[axis])


def late(delay_s: float, dead_s: float = 0.0) -> SetpointGenerator:
    """On a mission that says so much of the autopilot's delays."""
    flying = structs.replace(FLYING, setpoint_delay_s=delay_s, attitude_delay_s=dead_s)
    vehicle = structs.replace(MISSION.vehicle, flying=flying)
    references = SetpointGenerator(structs.replace(MISSION, vehicle=vehicle))
    references.stand((1.0, 2.0, 0.7), 0.2, 0)
    references.follow_trajectory(INTO_A_WALL)
    return references


@given(st.floats(0.0, 0.1), st.floats(0.0, 1.9))
def test_a_setpoint_is_of_the_moment_at_which_it_is_flown(delay_s: float, since_s: float) -> None:
    """Along a trajectory: that of one without a delay, so much later."""
    at_us, later_us = round(since_s * 1e6), round((since_s + delay_s) * 1e6)
    found = parts(late(delay_s).setpoint(FRAME, at_us, 0, 0))
    wanted = parts(standing_on(INTO_A_WALL).setpoint(FRAME, later_us, 0, 0))
    for one, other in zip(found, wanted, strict=True):
        assert one == pytest.approx(other, abs=1e-4)


@given(st.floats(0.0, 0.1), st.floats(0.0, 0.1), st.floats(0.0, 2.2))
def test_thrust_is_asked_for_ahead_of_the_attitudes_dead_time(
    delay_s: float, dead_s: float, since_s: float
) -> None:
    """Position and velocity of one moment, acceleration and jerk of another, neither beyond the wall."""
    at_us, end_s = round(since_s * 1e6), INTO_A_WALL.duration_s
    place, velocity, fed = parts(late(delay_s, dead_s).setpoint(FRAME, at_us, 0, 0))
    flown_s = max(at_us * 1e-6, min(at_us * 1e-6 + delay_s, end_s))
    flown, tilted = INTO_A_WALL.at(flown_s), INTO_A_WALL.at(max(flown_s, min(flown_s + dead_s, end_s)))
    assert place == pytest.approx(flown.position, abs=1e-9)
    assert velocity == pytest.approx(flown.velocity, abs=1e-9)
    assert fed is not None
    kd, lead_s = MISSION.vehicle.px4.mpc_xy_vel_d_acc, ATTITUDE_LAG_S - dead_s
    for axis, drag in enumerate(MISSION.vehicle.airframe.drag_per_s[:2]):
        push = (1.0 + kd + lead_s * drag) * tilted.acceleration[axis] + lead_s * tilted.jerk[axis]
        assert fed[axis] == pytest.approx(push + drag * flown.velocity[axis], abs=1e-9)


def test_before_a_wall_the_delay_asks_for_nothing_beyond_it() -> None:
    """The last moments ask for the thrust at the wall, and of the velocity what the vehicle has."""
    references, end_us = late(0.03, 0.05), round(1e6 * INTO_A_WALL.duration_s)
    wall, motion = MISSION.walls[0], (0.7, -0.1, 0.0)
    sample = OdometrySample(
        end_us - 10_000, 0, FRAME.point_to_ned((2.0, 1.0, ALTITUDE_M)), FRAME.vector_to_ned(motion)
    )
    place, velocity, fed = parts(references.coasting_setpoint(FRAME, sample, 0, wall))
    at_wall = INTO_A_WALL.at(INTO_A_WALL.duration_s)
    assert fed is not None
    kd, lead_s = MISSION.vehicle.px4.mpc_xy_vel_d_acc, ATTITUDE_LAG_S - 0.05
    for axis, drag in enumerate(MISSION.vehicle.airframe.drag_per_s[:2]):
        push = (1.0 + kd + lead_s * drag) * at_wall.acceleration[axis] + lead_s * at_wall.jerk[axis]
        assert fed[axis] == pytest.approx(push + drag * at_wall.velocity[axis])
    assert velocity is not None
    across = [wall.normal[axis] for axis in range(2)]
    assert sum(v * n for v, n in zip(velocity, across, strict=False)) == pytest.approx(
        sum(v * n for v, n in zip(motion, across, strict=False))
    )
    # Where the vehicle is when the setpoint is flown, across the wall: nothing to brake for.
    there = (2.0 + 0.03 * motion[0], 1.0 + 0.03 * motion[1])
    assert sum(p * n for p, n in zip(place, across, strict=False)) == pytest.approx(
        sum(p * n for p, n in zip(there, across, strict=False))
    )


def test_on_the_climb_only_drag_is_added() -> None:
    references = standing()
    references.climb()
    at_us = round(0.3e6 * references.duration_s)
    _, velocity, fed = parts(references.setpoint(FRAME, at_us, 0, 0))
    _, before, _ = parts(references.setpoint(FRAME, at_us - 100, 0, 0))
    _, after, _ = parts(references.setpoint(FRAME, at_us + 100, 0, 0))
    assert velocity is not None
    assert before is not None
    assert after is not None
    assert fed is not None
    drag = MISSION.vehicle.airframe.drag_per_s[2]
    assert fed[2] == pytest.approx((after[2] - before[2]) / 200e-6 + drag * velocity[2], abs=1e-3)


def test_an_approach_is_flown_without_a_new_target() -> None:
    references = standing()
    references.hold((1.0, 2.0))
    references.approach(Approach((1.0, 2.0), (3.0, 2.0), (1.0, 0.0), 1.0, 0.5, ALTITUDE_M))
    assert (references.target, references.on_transit) == ((1.0, 2.0, ALTITUDE_M), False)
    position, velocity, _ = parts(references.setpoint(FRAME, 1_000_000, 0, 0))
    assert position == pytest.approx((1.75, 2.0, ALTITUDE_M))
    assert velocity == pytest.approx((1.0, 0.0, 0.0))


def test_in_a_contact_it_asks_for_the_vehicles_own_motion_at_its_altitude() -> None:
    references = standing()
    place, motion = (1.5, 1.0, 1.3), (0.4, -0.3, 0.2)
    sample = OdometrySample(700, 800, FRAME.point_to_ned(place), FRAME.vector_to_ned(motion))
    asked = references.contact_setpoint(FRAME, sample, (1.0, 2.0, 0.0))
    assert (asked.t_us, asked.trigger_received_us) == (700, 800)
    assert says(asked, (1.5, 1.0, ALTITUDE_M), (0.4, -0.3, 0.0), (1.0, 2.0, 0.0))
    unpushed = references.contact_setpoint(FRAME, sample, None)
    assert says(unpushed, (1.5, 1.0, ALTITUDE_M), (0.4, -0.3, 0.0), NO_PUSH)


def test_it_has_arrived_once_it_was_there_slow_and_heading_right_for_a_while() -> None:
    references, state, t_us = standing(), FlightState(), 0
    state.anchor(MissionFrame())
    references.hold((0.0, 0.0))

    def after(seconds: float, beside_m: float = 0.0, yaw: float = 0.0, speed_m_s: float = 0.0) -> bool:
        """Whether it has arrived in any of the samples of so long."""
        nonlocal t_us
        arrived = False
        for _ in range(round(seconds / 0.01)):
            t_us += 10_000
            half = 0.5 * yaw
            state.take_attitude(AttitudeSample(t_us, t_us, (math.cos(half), 0.0, 0.0, -math.sin(half))))
            there, moving = (beside_m, 0.0, -ALTITUDE_M), (speed_m_s, 0.0, 0.0)
            state.take_odometry(OdometrySample(t_us, t_us, there, moving))
            arrived = references.has_arrived(state, 0.0) or arrived
        return arrived

    long_s = ARRIVED_S + 0.02
    assert not after(2.0 * long_s, beside_m=1.02 * ARRIVED_M)
    assert not after(2.0 * long_s, yaw=0.052)
    assert not after(2.0 * long_s, yaw=-0.052)
    assert not after(2.0 * long_s + MEAN_SPEED_S, speed_m_s=1.02 * ARRIVED_M_S)
    assert not after(MEAN_SPEED_S, beside_m=9.0)
    assert not after(ARRIVED_S - 0.02)
    assert not after(0.05, beside_m=9.0)  # it counts anew
    assert not after(ARRIVED_S - 0.02, 0.98 * ARRIVED_M, 0.048, 0.98 * ARRIVED_M_S)
    references.phase_begins()
    assert not after(ARRIVED_S - 0.02)
    assert after(0.04)


def test_the_heading_turns_the_short_way_at_its_rate() -> None:
    references, rate = standing(), math.radians(FLYING.yaw_rate_deg_s)
    references.stand((0.0, 0.0, 0.0), 3.0, 1_000_000)
    references.slew_yaw(-3.0, 1_100_000)
    assert references.yaw == pytest.approx(3.0 + min(0.1 * rate, 2.0 * math.pi - 6.0))
    references.stand((0.0, 0.0, 0.0), 1.0, 2_000_000)
    references.slew_yaw(-1.0, 2_010_000)
    references.slew_yaw(-1.0, 2_030_000)
    assert references.yaw == pytest.approx(1.0 - 0.03 * rate)
    references.slew_yaw(-1.0, 99_000_000)
    assert references.yaw == pytest.approx(-1.0)


def test_a_transit_to_where_it_is_takes_a_tenth_of_a_second() -> None:
    """A time of nothing would be divided by."""
    here = (1.0, 2.0, ALTITUDE_M)
    assert TransitTrajectory.between(here, here, 1.0, FLYING).duration_s == 0.1


@pytest.mark.parametrize(
    ("mission", "share", "off_rad", "arrives"),
    [
        ("paper_single_wall", 0.99, 0.049, True),
        ("paper_single_wall", 0.99, 0.051, False),
        ("paper_single_wall", 1.01, 0.0, False),
        ("dual_collision_gps", 2.49, 0.0, True),  # a position that drifts does not come as near
        ("dual_collision_gps", 2.51, 0.0, False),
    ],
)
def test_how_near_and_how_straight_it_is_when_it_has_arrived(
    mission: str, share: float, off_rad: float, arrives: bool
) -> None:
    references = SetpointGenerator(load_mission(packaged("missions", f"{mission}.yaml")))
    state = FlightState()
    x, y, z = references.target
    state.position, state.yaw = (x + share * ARRIVED_M, y, z), off_rad
    references.has_arrived(state, 0.0)
    state.now_us = 60_000_000
    assert references.has_arrived(state, 0.0) is arrives
