"""The replanner: trajectories from the predicted state of the vehicle to the planned impact or goal."""

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


def trajectory_of(answer: PlanAnswer) -> Trajectory:
    return Trajectory.from_plan(answer, MISSION.altitude_m)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.4, 1.3), st.floats(-1.08, -0.8), st.floats(-0.2, 0.6), st.floats(0.1, 0.6))
def test_a_replanned_trajectory_hits_the_wall_as_planned_after_the_lock_is_ready(
    x: float, y: float, vx: float, vy: float
) -> None:
    request = msgspec.structs.replace(TO_WALL, position_mission=(x, y, 1.0), velocity_mission=(vx, vy, 0.0))
    answer = REPLANNER.answer(request)
    assert answer == REPLANNER.answer(request)
    assert answer.problem == ""
    assert answer.impact_s is not None
    trajectory, planned = trajectory_of(answer), predict_mission(MISSION).hits[2]
    impact = trajectory.at(answer.impact_s)
    assert ACRYLIC.signed_distance(impact.position) == pytest.approx(0.0, abs=1e-6)
    assert ACRYLIC.spans(impact.position)
    normal, tangential, _ = ACRYLIC.to_collision(impact.velocity)
    assert (normal, tangential) == pytest.approx((answer.normal_m_s, answer.tangential_m_s))
    assert normal >= planned.normal_m_s - 1e-9
    assert request.lock_ready_us is not None
    assert answer.impact_s * 1e6 >= request.lock_ready_us - request.begin_us
    # The plan begins 0.1 s ahead, close to the state predicted under the current setpoint.
    begin = trajectory.at(0.0).position
    assert math.dist(begin[:2], (x + 0.1 * vx, y + 0.1 * vy)) < 0.05
    _assert_flyable(trajectory)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.2, 1.55), st.floats(-1.0, 0.5), st.floats(-1.0, 0.3), st.floats(-0.4, 0.4))
def test_a_replanned_trajectory_to_the_goal_ends_there_at_rest(
    x: float, y: float, vx: float, vy: float
) -> None:
    request = msgspec.structs.replace(TO_GOAL, position_mission=(x, y, 1.0), velocity_mission=(vx, vy, 0.0))
    answer = REPLANNER.answer(request)
    assert answer.problem == ""
    trajectory = trajectory_of(answer)
    end = trajectory.at(answer.duration_s + 1.0)
    assert end.position[:2] == pytest.approx(MISSION.goal.position_m, abs=1e-6)
    assert math.hypot(*end.velocity[:2]) < 1e-6
    assert answer.impact_s is None
    _assert_flyable(trajectory)


def _assert_flyable(trajectory: Trajectory) -> None:
    limit = GRAVITY_M_S2 * math.tan(math.radians(MISSION.vehicle.px4.mpc_tiltmax_air))
    for t in np.linspace(0.0, trajectory.duration_s, 50):
        at = trajectory.at(float(t))
        assert math.hypot(*at.acceleration[:2]) < 0.7 * limit
        assert math.hypot(*at.velocity[:2]) <= MISSION.limits.speed_m_s + 1e-6
        assert MISSION.bounds.excess2(at.position) < 1e-3


@pytest.mark.parametrize(("most_m_s2", "most_m_s3"), [(2.0, 8.0), (3.0, 4.0)])
def test_a_replanned_trajectory_respects_the_missions_limits(most_m_s2: float, most_m_s3: float) -> None:
    limits = msgspec.structs.replace(MISSION.limits, acceleration_m_s2=most_m_s2, jerk_m_s3=most_m_s3)
    bound = Replanner(msgspec.structs.replace(MISSION, limits=limits))
    request = msgspec.structs.replace(
        TO_GOAL, position_mission=(0.3, -0.6, 1.0), velocity_mission=(0.2, 0.0, 0.0)
    )
    unbound, answer = (trajectory_of(one.answer(request)) for one in (REPLANNER, bound))
    states = [answer.at(float(t)) for t in np.linspace(0.0, answer.duration_s, 100)]
    assert max(math.hypot(*at.acceleration[:2]) for at in states) <= most_m_s2 + 1e-2
    changes = (math.dist(a.acceleration, b.acceleration) for a, b in itertools.pairwise(states))
    assert max(changes) * 99 / answer.duration_s <= most_m_s3 * 1.1
    assert unbound.duration_s < answer.duration_s


def test_rejoining_the_missions_trajectory_stays_near_its_limits_if_possible() -> None:
    """The vehicle's full performance would allow a faster trajectory."""
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
    bound, unlimited_plan = (
        trajectory_of(Replanner(mission).answer(request))
        for mission in (hairpin, msgspec.structs.replace(hairpin, limits=unlimited))
    )
    pushes = [
        max(
            math.hypot(*trajectory.at(float(t)).acceleration[:2])
            for t in np.linspace(0.0, trajectory.duration_s, 200)
        )
        for trajectory in (bound, unlimited_plan)
    ]
    assert pushes[0] < 0.9 * pushes[1]
    assert pushes[0] <= 1.25 * 3.0 * 1.02
    assert unlimited_plan.duration_s < bound.duration_s


def test_a_lock_fault_or_a_missing_trajectory_is_reported_as_the_problem() -> None:
    no_lock = REPLANNER.answer(msgspec.structs.replace(TO_WALL, lock_ready_us=None))
    assert no_lock.problem == "lock fault"
    behind = REPLANNER.answer(msgspec.structs.replace(TO_WALL, position_mission=(3.0, 0.0, 1.0)))
    assert "no trajectory to wall acrylic" in behind.problem


def test_the_missions_predicted_impact_takes_precedence_over_the_model() -> None:
    predicted_impact = CollisionPrediction(2.0, ACRYLIC.point, -0.9, 0.1, 40.0, 0.05)
    hit, following = MISSION.collisions
    mission = msgspec.structs.replace(
        MISSION, collisions=(hit, msgspec.structs.replace(following, predicted=predicted_impact))
    )
    answer = Replanner(mission).answer(TO_WALL)
    assert answer.problem == ""
    assert (answer.normal_m_s, answer.tangential_m_s) == pytest.approx((-0.9, 0.1))


def test_no_plan_is_made_without_a_planned_impact_velocity(monkeypatch: pytest.MonkeyPatch) -> None:
    replanner = Replanner(MISSION)
    # Every mission that a loader accepts has this velocity.
    monkeypatch.setattr(replanner, "_planned", {})
    assert replanner.answer(TO_WALL).problem == "no velocity is planned for wall acrylic"


def test_a_slow_lock_delays_the_impact() -> None:
    quick = REPLANNER.answer(TO_WALL)
    slow = REPLANNER.answer(msgspec.structs.replace(TO_WALL, lock_ready_us=2_000_000))
    assert quick.impact_s is not None
    assert slow.impact_s is not None
    assert slow.impact_s >= 1.9 > quick.impact_s


def test_an_impact_over_the_missions_peak_force_is_refused() -> None:
    weak = msgspec.structs.replace(MISSION, limits=msgspec.structs.replace(MISSION.limits, peak_force_n=50.0))
    answer = Replanner(weak).answer(TO_WALL)
    assert "peak_force" in answer.problem


def test_an_exception_in_the_planner_is_reported_as_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("by hand")

    # No request is known to raise an exception.
    monkeypatch.setattr(REPLANNER, "_choose", fail)
    answer = REPLANNER.answer(TO_GOAL)
    assert answer.problem == "the planner failed: ZeroDivisionError: by hand"
    assert answer.number == TO_GOAL.number


def wall_estimate(reported: Mode | None, identified: Mode | None, stiffer: float) -> WallEstimate:
    c = MISSION.vehicle.materials["acrylic"].coefficients(Mode.RIGID)
    own, spread, plane = (stiffer * c.k, c.f, c.mu, c.nu), (0.1, 0.1, 0.1, 0.1), (0.0, 0.1, 0.0, 0.1)
    return WallEstimate(1, 0, "acrylic", reported, identified, 0.0, *own, *spread, *plane)


@pytest.mark.parametrize(
    ("reported", "identified", "ratio"),
    [
        (Mode.RIGID, None, 2.0),  # undecided, so the lock's report counts
        (None, Mode.RIGID, 2.0),
        (Mode.RIGID, Mode.FLEXIBLE, 1.0),  # the estimate is for the other mode
        (None, None, 1.0),
    ],
)
def test_a_wall_estimate_updates_only_the_mode_of_its_contact(
    reported: Mode | None, identified: Mode | None, ratio: float
) -> None:
    """The peak force is about proportional to the square root of the stiffness."""
    before = REPLANNER.answer(TO_WALL)
    replanner = Replanner(MISSION)
    replanner.update_wall(wall_estimate(reported, identified, 2.0))
    after = replanner.answer(TO_WALL)
    assert before.peak_force_n is not None
    assert after.peak_force_n is not None
    force = after.peak_force_n / before.peak_force_n
    speed = (after.normal_m_s or 0.0) / (before.normal_m_s or 1.0)
    assert force / speed == pytest.approx(math.sqrt(ratio), rel=0.08)


def test_a_measured_wall_stays_in_place_when_the_frame_is_corrected() -> None:
    """Moving the frame's origin 6 cm along the wall's normal brings the wall 6 cm closer."""
    replanner, (nx, ny) = Replanner(MISSION), ACRYLIC.normal
    replanner.update_wall(wall_estimate(Mode.RIGID, None, 1.0))
    replanner.move_frame(FrameAnchor(2, "acrylic", (0.06 * nx, 0.06 * ny), 0.1, 0.02, None, (nx, ny), 2, 0))
    answer = replanner.answer(TO_WALL)
    assert answer.impact_s is not None
    impact = trajectory_of(answer).at(answer.impact_s).position
    assert ACRYLIC.signed_distance(impact) == pytest.approx(-0.06, abs=1e-6)


def test_the_straight_segment_grows_with_the_age_of_the_contact_in_a_drifting_frame() -> None:
    """Its length is 3 standard deviations of the position, which grow by `estimation.position_drift_m_s`."""
    mission = MISSION.replace({"frame.anchored_by": "touch"})
    drift_m_s, straights = mission.vehicle.estimation.position_drift_m_s, []
    for age_s in (0.5, 3.0):
        replanner = Replanner(mission)
        contact_us = TO_WALL.t_us - round(1e6 * age_s)
        for wall in mission.walls:
            replanner.move_frame(
                FrameAnchor(contact_us, wall.name, (0.0, 0.0), 0.1, 0.01, None, wall.normal, contact_us, 0)
            )
        answer = replanner.answer(TO_WALL)
        assert answer.impact_s is not None
        assert answer.normal_m_s is not None
        straights.append((answer.impact_s - answer.duration_s) * -answer.normal_m_s)
    sds = [math.hypot(0.01, drift_m_s * age_s) for age_s in (0.5, 3.0)]
    assert straights[1] - straights[0] == pytest.approx(3.0 * (sds[1] - sds[0]), rel=0.1)


@pytest.mark.parametrize(("behind_m", "problem"), [(0.14, ""), (0.16, "no trajectory to the goal")])
def test_a_trajectory_may_begin_while_the_arms_are_compressed(behind_m: float, problem: str) -> None:
    """More than 15 cm behind the plane, the trajectory would lead through the wall."""
    (x, y), (nx, ny) = ACRYLIC.foot((1.6, -0.7)), ACRYLIC.normal
    pressed = msgspec.structs.replace(
        TO_GOAL, begin_us=TO_GOAL.t_us, position_mission=(x - behind_m * nx, y - behind_m * ny, 1.0)
    )
    assert problem in REPLANNER.answer(pressed).problem
    assert bool(REPLANNER.answer(pressed).problem) is bool(problem)


def test_an_uncertain_wall_lengthens_the_straight_segment_if_space_permits() -> None:
    assert _straights(0.0) == [(0.3, 0.0), (0.1, 0.0)]
    assert _straights(0.05) == [(0.3, 1.0), (0.1, 1.0), (0.1, 0.0)]


@pytest.mark.parametrize("most_n", [150.0, 12.0])
def test_an_impact_after_a_start_from_rest_uses_the_highest_permitted_speed(most_n: float) -> None:
    limits = msgspec.structs.replace(MISSION.limits, peak_force_n=most_n)
    request = msgspec.structs.replace(TO_WALL, collision=1)
    answer = Replanner(msgspec.structs.replace(MISSION, limits=limits)).answer(request)
    assert answer.problem == ""
    assert answer.normal_m_s is not None
    planned = -0.6
    assert (answer.normal_m_s == pytest.approx(planned)) is (most_n > 100.0)
    assert planned - 1e-9 <= answer.normal_m_s < 0.0


def test_a_plan_begins_at_the_state_predicted_by_the_position_loop() -> None:
    """In 0.1 s under the current setpoint the vehicle moves by about a tenth of its velocity."""
    begins = []
    for ahead_us in (0, 100_000, 200_000):
        request = msgspec.structs.replace(TO_WALL, begin_us=TO_WALL.t_us + ahead_us, lock_ready_us=600_000)
        begins.append(trajectory_of(REPLANNER.answer(request)).at(0.0).position)
    assert begins[0][:2] == pytest.approx(TO_WALL.position_mission[:2], abs=1e-6)
    for axis in (0, 1):
        first, second = (begins[i + 1][axis] - begins[i][axis] for i in (0, 1))
        assert first == pytest.approx(0.1 * TO_WALL.velocity_mission[axis], rel=0.6)
        assert second == pytest.approx(first, rel=0.8)


# --- along the mission's own trajectories ------------------------------------------------------------------

FLIGHT = Path(__file__).parents[1] / "data" / "flights" / "fast.mcap"


def plan_numbers(answer: PlanAnswer) -> list[float]:
    hit = (answer.impact_s, answer.normal_m_s, answer.tangential_m_s, answer.peak_force_n)
    pieces = (answer.duration_s, *answer.pieces_s, *answer.x_mission, *answer.y_mission)
    return [*pieces, *(number or 0.0 for number in hit)]


def test_the_requests_of_a_recorded_flight_give_the_recorded_answers() -> None:
    """The flight rejoins the mission's trajectory after three contacts and finds none after another.

    The mission is decoded from the log's text, as the planner in flight decodes it.
    """
    log = read_log(FLIGHT)
    replanner = Replanner(flown_mission(log.about, log.source))
    answers: dict[int, PlanAnswer] = {}
    for record in (entry.record for entry in log.entries):
        if isinstance(record, WallEstimate):
            replanner.update_wall(record)
        elif isinstance(record, PlanRequest):
            answers[record.number] = replanner.answer(record)
        elif isinstance(record, PlanAnswer):
            replayed = answers.pop(record.number)
            # An older version may have worded a problem differently.
            assert (bool(replayed.problem), replayed.collision) == (bool(record.problem), record.collision)
            assert plan_numbers(replayed) == pytest.approx(plan_numbers(record), rel=1e-5, abs=1e-5)
    assert answers == {}


@pytest.mark.parametrize(("height_m", "lean"), [(0.02, 0.1), (-0.02, -0.1), (0.5, 0.3), (-0.5, -0.3)])
def test_a_contact_above_the_centre_of_mass_plans_a_lean_into_the_wall(height_m: float, lean: float) -> None:
    """The tilt brings the guards level with the centre of mass, up to a limit."""
    log = read_log(FLIGHT)
    mission = flown_mission(log.about, log.source)
    replanner, wall = Replanner(mission), mission.collisions[1].wall
    request = next(e.record for e in log.entries if isinstance(e.record, PlanRequest))
    pushes = []
    for height in (0.0, height_m):
        trajectory = trajectory_of(
            replanner.answer(msgspec.structs.replace(request, contact_height_m=height))
        )
        push, _, _ = wall.to_collision(trajectory.at(trajectory.duration_s).acceleration)
        pushes.append(push)
    assert pushes[0] - pushes[1] == pytest.approx(lean * GRAVITY_M_S2, abs=0.4)


def test_a_lean_into_the_wall_begins_early_enough_for_the_attitude_to_follow() -> None:
    """The fastest trajectory has a final jerk of 24 m/s3, of which the attitude lag would lose 1.5 m/s2."""
    log = read_log(FLIGHT)
    mission, checked = flown_mission(log.about, log.source), 0
    replanner = Replanner(mission)
    for request in (e.record for e in log.entries if isinstance(e.record, PlanRequest)):
        if request.collision is None:
            continue
        answer = replanner.answer(msgspec.structs.replace(request, contact_height_m=0.03))
        if answer.problem:
            continue
        trajectory, wall = trajectory_of(answer), mission.collisions[request.collision - 1].wall
        if trajectory.duration_s < 1.0:  # too short for an earlier lean
            continue
        jerks = [
            wall.to_collision(trajectory.at(share * trajectory.duration_s).jerk)[0]
            for share in np.linspace(0.92, 1.0, 9)
        ]
        assert min(jerks) > -8.5
        checked += 1
    assert checked == 4


@pytest.mark.parametrize(
    ("mode", "dead_s", "thrust_m_s2"),
    [(Mode.FLEXIBLE, None, 0.2), (Mode.RIGID, None, 0.1), (Mode.RIGID, 0.05, 0.0)],
)
def test_rigid_arms_reduce_the_planned_lean_away_from_the_wall(
    mode: Mode, dead_s: float | None, thrust_m_s2: float
) -> None:
    """An attitude that lags behind the trajectory halves it; the recorded plan ends with 0.2 m/s2."""
    log = read_log(FLIGHT)
    mission = flown_mission(log.about, log.source)
    collisions = tuple(msgspec.structs.replace(c, mode=mode) for c in mission.collisions)
    limits = msgspec.structs.replace(mission.limits, peak_force_n=1000.0)
    flying = msgspec.structs.replace(mission.vehicle.flying, attitude_delay_s=dead_s)
    vehicle = msgspec.structs.replace(mission.vehicle, flying=flying)
    changed = msgspec.structs.replace(mission, collisions=collisions, limits=limits, vehicle=vehicle)
    request = next(e.record for e in log.entries if isinstance(e.record, PlanRequest))
    trajectory = trajectory_of(
        Replanner(changed).answer(msgspec.structs.replace(request, contact_height_m=0.0))
    )
    end, wall = trajectory.at(trajectory.duration_s), mission.collisions[1].wall
    (push, _, _), (speed, _, _) = wall.to_collision(end.acceleration), wall.to_collision(end.velocity)
    thrust = push + mission.vehicle.airframe.drag_per_s[0] * speed
    assert thrust == pytest.approx(thrust_m_s2, abs=0.01)


@pytest.mark.parametrize("dead_s", [None, 0.05])
def test_a_trajectory_ends_with_the_planned_jerk_if_the_attitude_delay_is_known(dead_s: float | None) -> None:
    """The last 0.2 s before the wall have the mission's jerk; otherwise rejoining lasts until the wall."""
    log = read_log(FLIGHT)
    mission = flown_mission(log.about, log.source)
    flying = msgspec.structs.replace(mission.vehicle.flying, attitude_delay_s=dead_s)
    vehicle = msgspec.structs.replace(mission.vehicle, flying=flying)
    request = next(e.record for e in log.entries if isinstance(e.record, PlanRequest))
    trajectory = trajectory_of(Replanner(msgspec.structs.replace(mission, vehicle=vehicle)).answer(request))
    written = mission.collisions[1].trajectory
    assert written is not None
    planned = Trajectory.from_mission(written, mission.altitude_m)
    off = [
        math.dist(trajectory.at(trajectory.duration_s - s).jerk, planned.at(planned.duration_s - s).jerk)
        for s in (0.02, 0.1, 0.18)
    ]
    assert (max(off) < 1e-6) == (dead_s is not None)
    assert (
        math.dist(
            trajectory.at(trajectory.duration_s - 0.25).jerk, planned.at(planned.duration_s - 0.25).jerk
        )
        > 0.1
    )


def test_a_trajectory_in_progress_is_not_replaced_by_a_slower_impact() -> None:
    """Half a second before the wall the planned speed is out of reach, so the trajectory continues."""
    shuttle = load_mission(packaged("missions", "shuttle.yaml"))
    late = PlanRequest(
        0, 1, 100_000, 5, (0.3, 0.011, 1.11), (2.2, -0.008, -0.244), (1.07, -0.02, 0.0),
        (1.48, 0.0, 1.0), 0, True,
    )  # fmt: skip
    replanner = Replanner(shuttle)
    assert replanner.answer(late).problem == "no feasible trajectory leads back to the mission's trajectory"
    early = msgspec.structs.replace(
        late, position_mission=(-0.935, 0.01, 1.142), velocity_mission=(2.038, -0.018, 0.074),
        acceleration_mission=(2.88, 0.02, 0.0),
    )  # fmt: skip
    assert replanner.answer(early).normal_m_s == pytest.approx(-2.81, abs=0.01)


def test_a_mission_decoded_from_json_gives_the_same_plan() -> None:
    """The planner process decodes its mission, whose collisions have equal but not identical walls."""
    shuttle = load_mission(packaged("missions", "shuttle.yaml"))
    request = PlanRequest(
        0, 1, 100_000, 4, (1.513, -0.018, 0.988), (-1.791, -0.007, 0.656), (-0.57, 0.07, 0.0),
        (-0.53, -0.01, 1.0), 0,
    )  # fmt: skip
    read = msgspec.json.decode(msgspec.json.encode(shuttle), type=Mission)
    answer = Replanner(read).answer(request)
    assert answer == Replanner(shuttle).answer(request)
    assert answer.normal_m_s == pytest.approx(-2.81, abs=0.05)


def test_a_trajectory_is_slowed_down_until_the_lock_is_ready() -> None:
    """The lock needs 0.05 s before the impact; the spacing of the candidates may add a little."""
    request = PlanRequest(
        0, 1, 100_000, 4, (1.513, -0.018, 0.988), (-1.791, -0.007, 0.656), (-0.57, 0.07, 0.0),
        (-0.53, -0.01, 1.0), 2_000_000,
    )  # fmt: skip
    answer = Replanner(load_mission(packaged("missions", "shuttle.yaml"))).answer(request)
    assert answer.problem == ""
    assert answer.impact_s is not None
    assert 1.95 <= answer.impact_s < 2.05


def test_a_plan_for_a_coasting_vehicle_begins_with_the_decay_of_its_tilt() -> None:
    """Without a command, a first-order lag halves the acceleration in 0.1 s."""
    request = msgspec.structs.replace(
        TO_WALL, acceleration_mission=(2.0, -1.0, 0.0), lock_ready_us=900_000, coasts=True
    )
    begin = trajectory_of(REPLANNER.answer(request)).at(0.0)
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
    """If the fastest trajectory would hit the post, the planner chooses another or none."""
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
        REPLANNER.answer(request),
        Replanner(msgspec.structs.replace(MISSION, posts=(post,))).answer(request),
    )
    assert not unaware.problem

    def nearest_m(answer: PlanAnswer) -> float:
        trajectory, times = trajectory_of(answer), np.linspace(0.0, answer.duration_s, 200)
        return min(distance2(trajectory.at(float(t)).position[:2], centre) for t in times)

    if nearest_m(unaware) > reach_m + 0.02:
        assert aware == unaware
    else:
        assert (
            aware.problem == "no trajectory to the goal is within the limits"
            or nearest_m(aware) > reach_m - 0.02
        )


@pytest.mark.parametrize("turned_rad", [0.0, 0.4, -0.9])
@pytest.mark.parametrize("straight_s", [0.1, 0.3])
def test_all_candidate_ends_lead_straight_to_the_wall(turned_rad: float, straight_s: float) -> None:
    wall = ACRYLIC.rotated(turned_rad)
    collision = msgspec.structs.replace(MISSION.collisions[1], wall=wall)
    # An answer shows only the best of the ends.
    ends = REPLANNER._to_wall(TO_WALL, collision, (-1.0, 0.3), straight_s)
    assert ends.x.size > 0
    for x, y, vx, vy in zip(ends.x, ends.y, ends.vx, ends.vy, strict=True):
        impact = (float(x + straight_s * vx), float(y + straight_s * vy))
        assert wall.signed_distance(impact) == pytest.approx(0.0, abs=1e-9)
        assert wall.to_collision((float(vx), float(vy), 0.0))[:2] == pytest.approx((-1.0, 0.3))
