"""The planner in flight: ways that begin where the vehicle will be and end as the mission has planned."""

import itertools
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from dart_flight.base.geometry import GRAVITY_M_S2, Vec2, distance2
from dart_flight.base.records import FrameAnchor, Mode, PlanAnswer, PlanRequest, WallEstimate
from dart_flight.base.walls import Post
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.mission_file import CollisionPrediction
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission.position_loop import ATTITUDE_LAG_S
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.planning.predicted_flight import predict_mission
from dart_flight.planning.replanner import Replanner, _straights
from dart_flight.recording.about import flown_mission
from dart_flight.recording.reader import read_log

MISSION = load_mission(packaged("missions", "dual_collision_replan.yaml"))
REPLANNER = Replanner(MISSION)
ACRYLIC = MISSION.collisions[1].wall
TO_WALL = PlanRequest(
    0, 1, 100_000, 2, (1.0, -1.05, 1.0), (0.3, 0.45, 0.0), (0.0, 0.0, 0.0), (2.6, -0.75, 1.0), 450_000
)
TO_GOAL = msgspec.structs.replace(
    TO_WALL, collision=None, position_mission=(1.55, -0.7, 1.0), velocity_mission=(-0.8, 0.2, 0.0),
    setpoint_mission=(0.5, -0.7, 1.0),
)  # fmt: skip


def way_of(answer: PlanAnswer) -> Trajectory:
    return Trajectory.from_plan(answer, MISSION.altitude_m)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.4, 1.3), st.floats(-1.08, -0.8), st.floats(-0.2, 0.6), st.floats(0.1, 0.6))
def test_a_way_to_the_wall_meets_it_as_planned_once_the_lock_is_ready(
    x: float, y: float, vx: float, vy: float
) -> None:
    request = msgspec.structs.replace(TO_WALL, position_mission=(x, y, 1.0), velocity_mission=(vx, vy, 0.0))
    answer = REPLANNER.answer(request, 0)
    assert answer == REPLANNER.answer(request, 0)
    assert answer.problem == ""
    assert answer.impact_s is not None
    way, planned = way_of(answer), predict_mission(MISSION).hits[2]
    met = way.at(answer.impact_s)
    assert ACRYLIC.signed_distance(met.position) == pytest.approx(0.0, abs=1e-6)
    assert ACRYLIC.spans(met.position)
    normal, tangential, _ = ACRYLIC.to_collision(met.velocity)
    assert (normal, tangential) == pytest.approx((answer.normal_m_s, answer.tangential_m_s))
    assert normal >= planned.normal_m_s - 1e-9
    assert request.lock_ready_us is not None
    assert answer.impact_s * 1e6 >= request.lock_ready_us - request.begin_us
    # It begins near where the vehicle will be: 0.1 s ahead under the setpoint in force.
    begin = way.at(0.0).position
    assert math.dist(begin[:2], (x + 0.1 * vx, y + 0.1 * vy)) < 0.05
    _assert_flyable(way)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.2, 1.55), st.floats(-1.0, 0.5), st.floats(-1.0, 0.3), st.floats(-0.4, 0.4))
def test_a_way_to_the_goal_ends_there_at_rest(x: float, y: float, vx: float, vy: float) -> None:
    request = msgspec.structs.replace(TO_GOAL, position_mission=(x, y, 1.0), velocity_mission=(vx, vy, 0.0))
    answer = REPLANNER.answer(request, 0)
    assert answer.problem == ""
    way = way_of(answer)
    end = way.at(answer.duration_s + 1.0)
    assert end.position[:2] == pytest.approx(MISSION.goal.position_m, abs=1e-6)
    assert math.hypot(*end.velocity[:2]) < 1e-6
    assert answer.impact_s is None
    _assert_flyable(way)


def _assert_flyable(way: Trajectory) -> None:
    limit = GRAVITY_M_S2 * math.tan(math.radians(MISSION.vehicle.px4.mpc_tiltmax_air))
    for t in np.linspace(0.0, way.duration_s, 50):
        at = way.at(float(t))
        assert math.hypot(*at.acceleration[:2]) < 0.7 * limit
        assert math.hypot(*at.velocity[:2]) <= MISSION.limits.speed_m_s + 1e-6
        assert MISSION.bounds.excess2(at.position) < 1e-3


@pytest.mark.parametrize(("most_m_s2", "most_m_s3"), [(2.0, 8.0), (3.0, 4.0)])
def test_what_is_planned_anew_keeps_to_the_mission_s_limits(most_m_s2: float, most_m_s3: float) -> None:
    limits = msgspec.structs.replace(MISSION.limits, acceleration_m_s2=most_m_s2, jerk_m_s3=most_m_s3)
    bound = Replanner(msgspec.structs.replace(MISSION, limits=limits))
    request = msgspec.structs.replace(
        TO_GOAL, position_mission=(0.3, -0.6, 1.0), velocity_mission=(0.2, 0.0, 0.0)
    )
    unbound, answer = (way_of(one.answer(request, 0)) for one in (REPLANNER, bound))
    states = [answer.at(float(t)) for t in np.linspace(0.0, answer.duration_s, 100)]
    assert max(math.hypot(*at.acceleration[:2]) for at in states) <= most_m_s2 + 1e-2
    changes = (math.dist(a.acceleration, b.acceleration) for a, b in itertools.pairwise(states))
    assert max(changes) * 99 / answer.duration_s <= most_m_s3 * 1.1
    assert unbound.duration_s < answer.duration_s


def test_leading_back_to_the_mission_s_trajectory_stays_near_its_limits_where_it_can() -> None:
    """Quicker is possible with all that the vehicle can, and not chosen: the plan keeps to limits, too."""
    hairpin = load_mission(packaged("missions", "hairpin.yaml"))
    leg = hairpin.goal_trajectory
    assert leg is not None
    planned = Trajectory.from_mission(leg, 1.0).at(0.4)
    vx, vy, _ = planned.velocity
    request = msgspec.structs.replace(
        TO_GOAL, collision=None, begin_us=0, under_way=True, position_mission=planned.position,
        velocity_mission=(1.2 * vx, 1.2 * vy, 0.0), acceleration_mission=planned.acceleration,
    )  # fmt: skip
    unlimited = msgspec.structs.replace(hairpin.limits, motion=None, acceleration_m_s2=None, jerk_m_s3=None)
    bound, able = (
        way_of(Replanner(mission).answer(request, 0))
        for mission in (hairpin, msgspec.structs.replace(hairpin, limits=unlimited))
    )
    pushes = [
        max(math.hypot(*way.at(float(t)).acceleration[:2]) for t in np.linspace(0.0, way.duration_s, 200))
        for way in (bound, able)
    ]
    assert pushes[0] < 0.9 * pushes[1]
    assert pushes[0] <= 1.25 * 3.0 * 1.02
    assert able.duration_s < bound.duration_s


def test_without_a_lock_or_a_way_it_says_why() -> None:
    no_lock = REPLANNER.answer(msgspec.structs.replace(TO_WALL, lock_ready_us=None), 0)
    assert no_lock.problem == "lock fault"
    behind = REPLANNER.answer(msgspec.structs.replace(TO_WALL, position_mission=(3.0, 0.0, 1.0)), 0)
    assert "no trajectory to wall acrylic" in behind.problem


def test_what_the_mission_says_of_an_impact_comes_before_the_model() -> None:
    wanted = CollisionPrediction(2.0, ACRYLIC.point, -0.9, 0.1, 40.0, 0.05)
    hit, following = MISSION.collisions
    told = msgspec.structs.replace(
        MISSION, collisions=(hit, msgspec.structs.replace(following, predicted=wanted))
    )
    answer = Replanner(told).answer(TO_WALL, 0)
    assert answer.problem == ""
    assert (answer.normal_m_s, answer.tangential_m_s) == pytest.approx((-0.9, 0.1))


def test_where_neither_says_how_fast_there_is_no_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    replanner = Replanner(MISSION)
    monkeypatch.setattr(replanner, "_planned", {})
    assert replanner.answer(TO_WALL, 0).problem == "no velocity is planned for wall acrylic"


def test_a_lock_that_needs_long_lengthens_the_way() -> None:
    quick = REPLANNER.answer(TO_WALL, 0)
    slow = REPLANNER.answer(msgspec.structs.replace(TO_WALL, lock_ready_us=2_000_000), 0)
    assert quick.impact_s is not None
    assert slow.impact_s is not None
    assert slow.impact_s >= 1.9 > quick.impact_s


def test_a_hit_over_the_mission_s_force_is_refused() -> None:
    weak = msgspec.structs.replace(MISSION, limits=msgspec.structs.replace(MISSION.limits, peak_force_n=50.0))
    answer = Replanner(weak).answer(TO_WALL, 0)
    assert "peak_force" in answer.problem


def test_a_fault_of_the_planner_is_a_problem_and_no_exception(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("by hand")

    monkeypatch.setattr(REPLANNER, "_choose", fail)
    answer = REPLANNER.answer(TO_GOAL, 0)
    assert answer.problem == "the planner failed: ZeroDivisionError: by hand"
    assert answer.number == TO_GOAL.number


def felt(reported: Mode | None, found: Mode | None, stiffer: float) -> WallEstimate:
    c = MISSION.vehicle.materials["acrylic"].coefficients(Mode.RIGID)
    own, spread, plane = (stiffer * c.k, c.f, c.mu, c.nu), (0.1, 0.1, 0.1, 0.1), (0.0, 0.1, 0.0, 0.1)
    return WallEstimate(1, 0, "acrylic", reported, found, 0.0, *own, *spread, *plane)


@pytest.mark.parametrize(
    ("reported", "found", "ratio"),
    [
        (Mode.RIGID, None, 2.0),  # undecided: what the lock says
        (None, Mode.RIGID, 2.0),
        (Mode.RIGID, Mode.FLEXIBLE, 1.0),  # of the other mode: this one stays as it was
        (None, None, 1.0),
    ],
)
def test_what_was_felt_counts_for_the_mode_that_it_was_felt_in(
    reported: Mode | None, found: Mode | None, ratio: float
) -> None:
    """The peak goes about with the square root of the stiffness."""
    before = REPLANNER.answer(TO_WALL, 0)
    replanner = Replanner(MISSION)
    replanner.update_wall(felt(reported, found, 2.0))
    after = replanner.answer(TO_WALL, 0)
    assert before.peak_force_n is not None
    assert after.peak_force_n is not None
    force = after.peak_force_n / before.peak_force_n
    speed = (after.normal_m_s or 0.0) / (before.normal_m_s or 1.0)
    assert force / speed == pytest.approx(math.sqrt(ratio), rel=0.08)


def test_a_wall_that_was_felt_stays_where_it_is_when_the_frame_is_put_right() -> None:
    """The frame's origin goes 6 cm along the wall's normal: the wall comes as much nearer."""
    replanner, (nx, ny) = Replanner(MISSION), ACRYLIC.normal
    replanner.update_wall(felt(Mode.RIGID, None, 1.0))
    replanner.move_frame(FrameAnchor(2, "acrylic", (0.06 * nx, 0.06 * ny), 0.1, 0.02, None, (nx, ny), 2, 0))
    answer = replanner.answer(TO_WALL, 0)
    assert answer.impact_s is not None
    met = way_of(answer).at(answer.impact_s).position
    assert ACRYLIC.signed_distance(met) == pytest.approx(-0.06, abs=1e-6)


def test_where_the_frame_drifts_it_flies_straight_for_longer_the_older_the_contact_is() -> None:
    """3 standard deviations of the place, of which each second adds `estimation.position_drift_m_s`."""
    mission = MISSION.replace({"frame.anchored_by": "touch"})
    drift_m_s, straights = mission.vehicle.estimation.position_drift_m_s, []
    for age_s in (0.5, 3.0):
        replanner = Replanner(mission)
        contact_us = TO_WALL.t_us - round(1e6 * age_s)
        for wall in mission.walls:
            replanner.move_frame(
                FrameAnchor(contact_us, wall.name, (0.0, 0.0), 0.1, 0.01, None, wall.normal, contact_us, 0)
            )
        answer = replanner.answer(TO_WALL, 0)
        assert answer.impact_s is not None
        assert answer.normal_m_s is not None
        straights.append((answer.impact_s - answer.duration_s) * -answer.normal_m_s)
    sds = [math.hypot(0.01, drift_m_s * age_s) for age_s in (0.5, 3.0)]
    assert straights[1] - straights[0] == pytest.approx(3.0 * (sds[1] - sds[0]), rel=0.1)


@pytest.mark.parametrize(("behind_m", "problem"), [(0.14, ""), (0.16, "no trajectory to the goal")])
def test_a_way_may_begin_where_the_arms_are_still_pressed_in(behind_m: float, problem: str) -> None:
    """Up to 15 cm behind the plane; from further behind it would lead through the wall."""
    (x, y), (nx, ny) = ACRYLIC.foot((1.6, -0.7)), ACRYLIC.normal
    pressed = msgspec.structs.replace(
        TO_GOAL, begin_us=TO_GOAL.t_us, position_mission=(x - behind_m * nx, y - behind_m * ny, 1.0)
    )
    assert problem in REPLANNER.answer(pressed, 0).problem
    assert bool(REPLANNER.answer(pressed, 0).problem) is bool(problem)


def test_before_a_wall_whose_place_is_not_sure_it_flies_straight_for_longer_where_there_is_room() -> None:
    assert _straights(0.0) == [(0.3, 0.0), (0.1, 0.0)]
    assert _straights(0.05) == [(0.3, 1.0), (0.1, 1.0), (0.1, 0.0)]


@pytest.mark.parametrize("most_n", [150.0, 12.0])
def test_a_hit_that_is_flown_to_from_rest_is_as_fast_as_it_may_be(most_n: float) -> None:
    limits = msgspec.structs.replace(MISSION.limits, peak_force_n=most_n)
    request = msgspec.structs.replace(TO_WALL, collision=1)
    answer = Replanner(msgspec.structs.replace(MISSION, limits=limits)).answer(request, 0)
    assert answer.problem == ""
    assert answer.normal_m_s is not None
    planned = -0.6
    assert (answer.normal_m_s == pytest.approx(planned)) is (most_n > 100.0)
    assert planned - 1e-9 <= answer.normal_m_s < 0.0


def test_a_plan_begins_where_the_loop_will_have_flown_to() -> None:
    """Under the setpoint in force; a tenth of a second is about a tenth of the velocity."""
    begins = []
    for ahead_us in (0, 100_000, 200_000):
        request = msgspec.structs.replace(TO_WALL, begin_us=TO_WALL.t_us + ahead_us, lock_ready_us=600_000)
        begins.append(way_of(REPLANNER.answer(request, 0)).at(0.0).position)
    assert begins[0][:2] == pytest.approx(TO_WALL.position_mission[:2], abs=1e-6)
    for axis in (0, 1):
        first, second = (begins[i + 1][axis] - begins[i][axis] for i in (0, 1))
        assert first == pytest.approx(0.1 * TO_WALL.velocity_mission[axis], rel=0.6)
        assert second == pytest.approx(first, rel=0.8)


# --- along the mission's own trajectories ------------------------------------------------------------------

FLIGHT = Path(__file__).parents[1] / "data" / "flights" / "fast.mcap"


def numbers(answer: PlanAnswer) -> list[float]:
    hit = (answer.impact_s, answer.normal_m_s, answer.tangential_m_s, answer.peak_force_n)
    way = (answer.duration_s, *answer.pieces_s, *answer.x_mission, *answer.y_mission)
    return [*way, *(number or 0.0 for number in hit)]


def test_what_a_recorded_flight_asked_is_answered_again_as_it_was() -> None:
    """Ways back to the mission's trajectories after three hits, and one time none.

    By a mission that has come as text, as it comes to the planner in flight.
    """
    log = read_log(FLIGHT)
    replanner = Replanner(flown_mission(log.about, log.source))
    answers: dict[int, PlanAnswer] = {}
    for record in (entry.record for entry in log.entries):
        if isinstance(record, WallEstimate):
            replanner.update_wall(record)
        elif isinstance(record, PlanRequest):
            answers[record.number] = replanner.answer(record, 0)
        elif isinstance(record, PlanAnswer):
            found = answers.pop(record.number)
            assert (found.problem, found.collision) == (record.problem, record.collision)
            assert numbers(found) == pytest.approx(numbers(record), rel=1e-5, abs=1e-5)
    assert answers == {}


@pytest.mark.parametrize(("height_m", "lean"), [(0.02, 0.1), (-0.02, -0.1), (0.5, 0.3), (-0.5, -0.3)])
def test_who_is_pushed_above_the_centre_of_mass_leans_into_the_wall(height_m: float, lean: float) -> None:
    """By what brings the guards level with it, to a limit: acceleration into the wall at the impact."""
    log = read_log(FLIGHT)
    mission = flown_mission(log.about, log.source)
    replanner, wall = Replanner(mission), mission.collisions[1].wall
    request = next(e.record for e in log.entries if isinstance(e.record, PlanRequest))
    pushes = []
    for height in (0.0, height_m):
        way = way_of(replanner.answer(msgspec.structs.replace(request, contact_height_m=height), 0))
        push, _, _ = wall.to_collision(way.at(way.duration_s).acceleration)
        pushes.append(push)
    assert pushes[0] - pushes[1] == pytest.approx(lean * GRAVITY_M_S2, abs=0.4)


def test_a_lean_into_the_wall_does_not_come_so_late_that_it_is_not_there() -> None:
    """The attitude lags: of 24 m/s3, as the quickest of the last has it, 1.5 m/s2 would be missing."""
    log = read_log(FLIGHT)
    mission, led = flown_mission(log.about, log.source), 0
    replanner = Replanner(mission)
    for request in (e.record for e in log.entries if isinstance(e.record, PlanRequest)):
        if request.collision is None:
            continue
        answer = replanner.answer(msgspec.structs.replace(request, contact_height_m=0.03), 0)
        if answer.problem:
            continue
        way, wall = way_of(answer), mission.collisions[request.collision - 1].wall
        if way.duration_s < 1.0:  # no time is left for an earlier lean
            continue
        jerks = [
            wall.to_collision(way.at(share * way.duration_s).jerk)[0] for share in np.linspace(0.92, 1.0, 9)
        ]
        assert min(jerks) > -8.5
        led += 1
    assert led == 4


@pytest.mark.parametrize(
    ("mode", "dead_s", "thrust_m_s2"),
    [(Mode.FLEXIBLE, None, 0.2), (Mode.RIGID, None, 0.1), (Mode.RIGID, 0.05, 0.0)],
)
def test_rigid_arms_meet_a_wall_without_the_lean_off_it_that_was_planned(
    mode: Mode, dead_s: float | None, thrust_m_s2: float
) -> None:
    """Half of it, where the attitude lags behind the trajectory; the recorded plan ends with 0.2 m/s2."""
    log = read_log(FLIGHT)
    mission = flown_mission(log.about, log.source)
    collisions = tuple(msgspec.structs.replace(c, mode=mode) for c in mission.collisions)
    limits = msgspec.structs.replace(mission.limits, peak_force_n=1000.0)
    flying = msgspec.structs.replace(mission.vehicle.flying, attitude_delay_s=dead_s)
    vehicle = msgspec.structs.replace(mission.vehicle, flying=flying)
    changed = msgspec.structs.replace(mission, collisions=collisions, limits=limits, vehicle=vehicle)
    request = next(e.record for e in log.entries if isinstance(e.record, PlanRequest))
    way = way_of(Replanner(changed).answer(msgspec.structs.replace(request, contact_height_m=0.0), 0))
    end, wall = way.at(way.duration_s), mission.collisions[1].wall
    (push, _, _), (speed, _, _) = wall.to_collision(end.acceleration), wall.to_collision(end.velocity)
    thrust = push + mission.vehicle.airframe.drag_per_s[0] * speed
    assert thrust == pytest.approx(thrust_m_s2, abs=0.01)


@pytest.mark.parametrize("dead_s", [None, 0.05])
def test_it_ends_as_planned_where_the_attitude_follows_to_the_end(dead_s: float | None) -> None:
    """Before a wall, 0.2 s of the mission's own jerk; else what leads back to it lasts until the wall."""
    log = read_log(FLIGHT)
    mission = flown_mission(log.about, log.source)
    flying = msgspec.structs.replace(mission.vehicle.flying, attitude_delay_s=dead_s)
    vehicle = msgspec.structs.replace(mission.vehicle, flying=flying)
    request = next(e.record for e in log.entries if isinstance(e.record, PlanRequest))
    way = way_of(Replanner(msgspec.structs.replace(mission, vehicle=vehicle)).answer(request, 0))
    written = mission.collisions[1].trajectory
    assert written is not None
    planned = Trajectory.from_mission(written, mission.altitude_m)
    off = [
        math.dist(way.at(way.duration_s - s).jerk, planned.at(planned.duration_s - s).jerk)
        for s in (0.02, 0.1, 0.18)
    ]
    assert (max(off) < 1e-6) == (dead_s is not None)
    assert math.dist(way.at(way.duration_s - 0.25).jerk, planned.at(planned.duration_s - 0.25).jerk) > 0.1


def test_a_trajectory_under_way_is_not_given_up_for_a_slower_hit() -> None:
    """Half a second before the wall the planned speed can no longer be had: what is flown goes on."""
    shuttle = load_mission(packaged("missions", "shuttle.yaml"))
    late = PlanRequest(
        0, 1, 100_000, 5, (0.3, 0.011, 1.11), (2.2, -0.008, -0.244), (1.07, -0.02, 0.0),
        (1.48, 0.0, 1.0), 0, True,
    )  # fmt: skip
    replanner = Replanner(shuttle)
    assert (
        replanner.answer(late, 0).problem == "no feasible trajectory leads back to the mission's trajectory"
    )
    early = msgspec.structs.replace(
        late, position_mission=(-0.935, 0.01, 1.142), velocity_mission=(2.038, -0.018, 0.074),
        acceleration_mission=(2.88, 0.02, 0.0),
    )  # fmt: skip
    assert replanner.answer(early, 0).normal_m_s == pytest.approx(-2.81, abs=0.01)


def test_a_mission_that_was_read_from_a_line_has_the_same_ways() -> None:
    """The planner of real time is a process: there walls of hits and of the room are equal, not the same."""
    shuttle = load_mission(packaged("missions", "shuttle.yaml"))
    request = PlanRequest(
        0, 1, 100_000, 4, (1.513, -0.018, 0.988), (-1.791, -0.007, 0.656), (-0.57, 0.07, 0.0),
        (-0.53, -0.01, 1.0), 0,
    )  # fmt: skip
    read = msgspec.json.decode(msgspec.json.encode(shuttle), type=Mission)
    answer = Replanner(read).answer(request, 0)
    assert answer == Replanner(shuttle).answer(request, 0)
    assert answer.normal_m_s == pytest.approx(-2.81, abs=0.05)


def test_a_trajectory_is_slowed_down_until_its_lock_is_ready() -> None:
    """0.05 s before the hit, and then no longer than the ways that are looked at lie apart."""
    request = PlanRequest(
        0, 1, 100_000, 4, (1.513, -0.018, 0.988), (-1.791, -0.007, 0.656), (-0.57, 0.07, 0.0),
        (-0.53, -0.01, 1.0), 2_000_000,
    )  # fmt: skip
    answer = Replanner(load_mission(packaged("missions", "shuttle.yaml"))).answer(request, 0)
    assert answer.problem == ""
    assert answer.impact_s is not None
    assert 1.95 <= answer.impact_s < 2.05


def test_a_plan_for_a_vehicle_that_coasts_begins_with_it_righting_itself() -> None:
    """As a first-order lag does that is asked for nothing: half of its push is gone in 0.1 s."""
    request = msgspec.structs.replace(
        TO_WALL, acceleration_mission=(2.0, -1.0, 0.0), lock_ready_us=900_000, coasts=True
    )
    begin = way_of(REPLANNER.answer(request, 0)).at(0.0)
    t = np.linspace(0.0, 0.1, 2001)
    for axis, push in enumerate((2.0, -1.0)):
        a = push * np.exp(-t / ATTITUDE_LAG_S)
        gained = np.concatenate(([0.0], np.cumsum(0.5 * (a[1:] + a[:-1])))) * 5e-5
        v = request.velocity_mission[axis] + gained
        assert begin.acceleration[axis] == pytest.approx(a[-1], rel=1e-6)
        assert begin.velocity[axis] == pytest.approx(v[-1], abs=1e-6)
        assert begin.position[axis] == pytest.approx(
            request.position_mission[axis] + float(np.mean(v)) * 0.1, abs=1e-4
        )


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
@given(
    place=st.tuples(st.floats(1.2, 1.55), st.floats(-0.5, 0.5)),
    velocity=st.tuples(st.floats(-1.0, 0.3), st.floats(-0.4, 0.4)),
    share=st.floats(0.4, 0.6),
    beside_m=st.floats(-0.2, 0.2),
)
@example(place=(1.375, 0.0), velocity=(-1.0, 0.0), share=0.5, beside_m=0.0)  # between two samples
def test_no_trajectory_leads_into_a_post(place: Vec2, velocity: Vec2, share: float, beside_m: float) -> None:
    """Between vehicle and goal: where the quickest would meet it, another is flown, or none."""
    goal, radius_m = MISSION.goal.position_m, 0.05
    reach_m = radius_m + math.hypot(
        MISSION.vehicle.airframe.contact_distance_m, MISSION.vehicle.airframe.guard_along_m
    )
    centre = (place[0] + share * (goal[0] - place[0]), place[1] + share * (goal[1] - place[1]) + beside_m)
    assume(min(distance2(place, centre), distance2(goal, centre)) > reach_m + 0.02)
    post = Post("pole", centre, radius_m, "wood")
    request = msgspec.structs.replace(
        TO_GOAL, position_mission=(*place, 1.0), velocity_mission=(*velocity, 0.0)
    )
    unaware, aware = (
        REPLANNER.answer(request, 0),
        Replanner(msgspec.structs.replace(MISSION, posts=(post,))).answer(request, 0),
    )
    assert not unaware.problem

    def nearest_m(answer: PlanAnswer) -> float:
        way, times = way_of(answer), np.linspace(0.0, answer.duration_s, 200)
        return min(distance2(way.at(float(t)).position[:2], centre) for t in times)

    if nearest_m(unaware) > reach_m + 0.02:
        assert aware == unaware
    else:
        assert (
            aware.problem == "no trajectory to the goal within the limits"
            or nearest_m(aware) > reach_m - 0.02
        )


@pytest.mark.parametrize("turned_rad", [0.0, 0.4, -0.9])
@pytest.mark.parametrize("straight_s", [0.1, 0.3])
def test_straight_on_from_where_they_end_all_meet_the_wall(turned_rad: float, straight_s: float) -> None:
    wall = ACRYLIC.rotated(turned_rad)
    collision = msgspec.structs.replace(MISSION.collisions[1], wall=wall)
    ends = REPLANNER._to_wall(TO_WALL, collision, (-1.0, 0.3), straight_s)
    assert ends.x.size > 0
    for x, y, vx, vy in zip(ends.x, ends.y, ends.vx, ends.vy, strict=True):
        met = (float(x + straight_s * vx), float(y + straight_s * vy))
        assert wall.signed_distance(met) == pytest.approx(0.0, abs=1e-9)
        assert wall.to_collision((float(vx), float(vy), 0.0))[:2] == pytest.approx((-1.0, 0.3))
