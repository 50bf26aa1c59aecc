"""The planner in flight: ways that begin where the vehicle will be and end as the mission has planned."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.base.records import Mode, PlanAnswer, PlanRequest, WallEstimate
from dart_flight.config.mission import load_mission
from dart_flight.config.mission_file import CollisionPrediction
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission.position_loop import ATTITUDE_LAG_S
from dart_flight.core.mission.trajectories import PlannedTrajectory
from dart_flight.planning.predicted_flight import predict_mission
from dart_flight.planning.replanner import Replanner

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


def way_of(answer: PlanAnswer) -> PlannedTrajectory:
    return PlannedTrajectory(answer.x_mission, answer.y_mission, answer.duration_s, MISSION.altitude_m)


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


def _assert_flyable(way: PlannedTrajectory) -> None:
    limit = GRAVITY_M_S2 * math.tan(math.radians(MISSION.vehicle.px4.mpc_tiltmax_air))
    for t in np.linspace(0.0, way.duration_s, 50):
        at = way.at(float(t))
        assert math.hypot(*at.acceleration[:2]) < 0.7 * limit
        assert math.hypot(*at.velocity[:2]) <= MISSION.limits.speed_m_s + 1e-6
        assert MISSION.bounds.excess2(at.position) < 1e-3


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

    monkeypatch.setattr(REPLANNER, "_best", fail)
    answer = REPLANNER.answer(TO_GOAL, 0)
    assert answer.problem == "the planner failed: ZeroDivisionError: by hand"
    assert answer.number == TO_GOAL.number


def felt(reported: Mode | None, found: Mode | None, stiffer: float) -> WallEstimate:
    c = MISSION.vehicle.materials["acrylic"].of(Mode.RIGID)
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
