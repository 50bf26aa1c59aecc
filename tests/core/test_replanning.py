"""Replanning in the core: requests, accepted and refused answers, and missing answers."""

import itertools
import math

import msgspec
import pytest

from dart_flight.base.records import ForceEstimate, PlanAnswer, PlanRequest, PlanTaken
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Collision, Mission, load_mission
from dart_flight.config.mission_file import TrajectoryPieces
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission.lock_commands import LockCommandState
from dart_flight.core.mission.mission_progress import NO_CHANGE, Change, MissionProgress
from dart_flight.core.mission.replan import Replan
from dart_flight.core.mission.replan_requests import (
    _AGAIN_US,
    _FELT_WITHIN_US,
    _HELD_TO_M,
    _LATER_S,
    _NOT_AGAIN_US,
    _TRIES,
    ReplanRequests,
)
from dart_flight.core.mission.wall_uncertainty import _MIN_CLOSING_M_S, SURE_SD
from dart_flight.core.sense.senses import Sensed
from dart_flight.core.sense.state import FlightState
from tests.core.conftest import known

MISSION = load_mission(packaged("missions", "dual_collision_replan.yaml"))
NOW_US = 10_000_000


def state_at(now_us: int, position: tuple[float, float, float] = (1.0, -1.0, 1.0)) -> FlightState:
    state = FlightState()
    state.now_us, state.position, state.velocity = now_us, position, (0.4, 0.5, 0.0)
    return state


class Planning:
    """The replanning rules of a mission with its state, updated as the executive updates it."""

    def __init__(self, mission: Mission) -> None:
        self.rules, self.progress = ReplanRequests(mission), MissionProgress(mission, {})
        self.progress.course = self.progress.course.hold((2.0, -0.8))

    @property
    def replan(self) -> Replan:
        return self.progress.replan

    def apply(self, change: Change) -> Change:
        if change.replan is not None:
            self.progress.replan = change.replan
        return change

    def request(
        self, between: tuple[Collision, Collision], state: FlightState, sensed: Sensed, square_us: int = 0
    ) -> PlanRequest | None:
        """Return the request between a hit and the next one, if there is one."""
        hit, following = between
        self.progress.index = self.progress.mission.collisions.index(hit) + 1
        self.progress.collisions[self.progress.index :] = [following]
        change = self.apply(self.rules.request(self.progress, state, sensed, square_us, False))
        assert all(isinstance(o, PlanRequest) for o in change.outputs)
        return next((o for o in change.outputs if isinstance(o, PlanRequest)), None)

    def accept(self, answer: PlanAnswer, now_us: int) -> Change:
        return self.apply(self.rules.accept(self.replan, answer, now_us))

    def trajectory(self, state: FlightState) -> Change:
        return self.apply(self.rules.trajectory(self.progress, state))

    def flies(self, state: FlightState) -> bool:
        return self.trajectory(state).course is not None

    def contact_begins(self) -> None:
        self.progress.replan = self.replan.contact_begins()

    def is_late(self, wall: Wall, state: FlightState) -> bool:
        return self.rules.is_late(self.replan, wall, state)


OVER = Sensed(estimate=ForceEstimate(NOW_US, (0.0, 0.0, 0.0), False))
BETWEEN = (MISSION.collisions[0], MISSION.collisions[1])


def planning_with_request() -> tuple[Planning, PlanRequest]:
    planning = Planning(MISSION)
    request = known(planning.request(BETWEEN, state_at(NOW_US), OVER))
    assert request.setpoint_mission == (2.0, -0.8, 1.0)
    assert planning.request(BETWEEN, state_at(NOW_US + 4_000), OVER) is None  # once after each contact
    return planning, request


def refusal_to(planning: Planning, answer: PlanAnswer, now_us: int) -> str | None:
    """Return why an answer is refused, or None if it is accepted."""
    return refusal_in(planning.accept(answer, now_us))


def refusal_in(change: Change) -> str | None:
    if not change.outputs:
        return None
    (taken,) = change.outputs
    assert isinstance(taken, PlanTaken)
    assert not taken.taken
    return taken.reason


def answer_to(request: PlanRequest) -> PlanAnswer:
    """Return an answer that continues straight from the predicted position of the vehicle."""
    ahead_s = (request.begin_us - request.t_us) * 1e-6
    x, y, _ = (
        p + v * ahead_s for p, v in zip(request.position_mission, request.velocity_mission, strict=True)
    )
    vx, vy, _ = request.velocity_mission
    return PlanAnswer(
        0, request.number, request.begin_us, 1.0, (x, vx, 0.0, 0.0, 0.0, 0.0), (y, vy, 0.0, 0.0, 0.0, 0.0),
        request.collision, 1.3, -1.2, 0.2, 75.0,
    )  # fmt: skip


def moved_to(request: PlanRequest) -> FlightState:
    ahead_s = (request.begin_us - request.t_us) * 1e-6
    x, y, z = (
        p + v * ahead_s for p, v in zip(request.position_mission, request.velocity_mission, strict=True)
    )
    return state_at(request.begin_us, (x, y, z))


def test_an_answer_in_time_is_flown_from_its_start_time() -> None:
    planning, request = planning_with_request()
    planning.accept(answer_to(request), NOW_US + 40_000)
    assert planning.trajectory(state_at(NOW_US + 90_000)) == NO_CHANGE
    assert planning.replan.since_us is None
    change = planning.trajectory(moved_to(request))
    assert change.course is not None
    assert change.outputs == (PlanTaken(request.begin_us, request.number, True),)
    assert planning.replan.since_us == request.begin_us
    assert planning.trajectory(moved_to(request)) == NO_CHANGE  # once
    impact = known(planning.replan.predict_impact(1.2, state_at(request.begin_us + 300_000)))
    assert impact.after_s == pytest.approx(1.0)
    assert impact.normal_m_s == -1.2
    beyond = known(planning.replan.predict_impact(1.2, state_at(request.begin_us + 1_400_000)))
    assert beyond.after_s == 0.0  # due, but not over
    end_us = request.begin_us + 1_000_000
    assert [planning.replan.is_over(t_us) for t_us in (end_us - 1, end_us)] == [False, True]
    late_us = request.begin_us + 1_300_000 + round(MISSION.vehicle.guard.wall_late_s * 1e6)
    assert not planning.is_late(MISSION.walls[1], state_at(late_us))
    assert planning.is_late(MISSION.walls[1], state_at(late_us + 1))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"number": 7}, "outdated state"),
        ({"problem": "no trajectory to wall acrylic"}, "no trajectory to wall acrylic"),
        ({"begin_us": 1}, "the plan does not match the request"),
        ({"collision": None}, "the plan does not match the request"),
        ({"impact_s": None}, "the plan does not match the request"),
        ({"duration_s": 0.0}, "the plan does not match the request"),
        ({"x_mission": (1.0, 2.0)}, "the plan does not match the request"),
        ({"y_mission": (math.nan,) * 6}, "the plan does not match the request"),
        ({"x_mission": (math.inf,) * 6}, "the plan does not match the request"),
    ],
)
def test_an_unusable_answer_is_refused_with_its_reason(change: dict[str, object], reason: str) -> None:
    planning, request = planning_with_request()
    answer = msgspec.structs.replace(answer_to(request), **change)
    assert reason in (refusal_to(planning, answer, NOW_US + 40_000) or "")
    assert not planning.flies(moved_to(request))
    assert planning.replan.since_us is None


def test_a_request_for_the_same_wall_waits_for_its_estimate() -> None:
    """It waits for a limited time after each contact; a request for another wall is sent at once."""
    hit, following = MISSION.collisions

    def sends_request(again: bool, after_us: int, estimated: bool = False) -> bool:
        sensed = Sensed(estimate=ForceEstimate(NOW_US, (0.0, 0.0, 0.0), False))
        planning.contact_begins()
        planning.progress.replan = planning.replan._replace(has_wall_estimate=estimated)
        planning.progress.lock = LockCommandState(contact_end_us=NOW_US)
        between = (hit, hit if again else following)
        return planning.request(between, state_at(NOW_US + after_us), sensed) is not None

    planning = Planning(MISSION)
    assert sends_request(False, 0)
    assert not sends_request(True, _FELT_WITHIN_US - 1)
    assert sends_request(True, _FELT_WITHIN_US)
    assert sends_request(True, 10_000, estimated=True)
    assert not sends_request(True, 10_000)


@pytest.mark.parametrize(
    ("normal_m_s", "tangential_m_s", "flown"),
    [(-0.5, 0.1, True), (0.0, 0.1, False), (0.5, 0.1, False), (None, 0.1, False), (-0.5, math.nan, False)],
)
def test_an_approach_from_rest_must_move_towards_its_wall(
    normal_m_s: float | None, tangential_m_s: float, flown: bool
) -> None:
    planning, hit = Planning(MISSION), MISSION.collisions[0]
    assert hit.approach_m_s is not None
    request = known(planning.request((hit, hit), state_at(NOW_US), OVER))
    answer = msgspec.structs.replace(answer_to(request), normal_m_s=normal_m_s, tangential_m_s=tangential_m_s)
    refusal = refusal_to(planning, answer, NOW_US + 40_000)
    assert refusal == (None if flown else "the plan does not match the request")
    change = planning.apply(planning.rules.approach(planning.progress, NOW_US + 40_000))
    approach = change.approach
    assert (approach is not None) is flown
    if approach is not None:
        at_wall = approach.at(approach.duration_s).velocity
        assert math.hypot(*at_wall) == pytest.approx(math.hypot(normal_m_s or 0.0, tangential_m_s))
        assert change.outputs == (PlanTaken(NOW_US + 40_000, request.number, True),)
        assert planning.rules.approach(planning.progress, NOW_US + 40_000) == NO_CHANGE  # once


def test_an_approach_without_room_is_refused_once_and_the_previous_approach_is_kept() -> None:
    """The run-up for 2.9 m/s would start outside the flight space."""
    planning, hit = Planning(MISSION), MISSION.collisions[0]
    request = known(planning.request((hit, hit), state_at(NOW_US), OVER))
    fast = msgspec.structs.replace(answer_to(request), normal_m_s=-2.9, tangential_m_s=0.0)
    assert refusal_to(planning, fast, NOW_US + 40_000) is None
    change = planning.apply(planning.rules.approach(planning.progress, NOW_US + 44_000))
    assert change.approach is None
    refusal = known(refusal_in(change))
    assert refusal.startswith("the run-up to wall wood at 2.90 m/s starts at (")
    (taken,) = change.outputs
    assert isinstance(taken, PlanTaken)
    assert (taken.t_us, taken.number) == (NOW_US + 44_000, request.number)
    assert planning.rules.approach(planning.progress, NOW_US + 48_000) == NO_CHANGE


def test_a_late_answer_is_refused() -> None:
    planning, request = planning_with_request()
    assert refusal_to(planning, answer_to(request), request.begin_us + 20_000) == "the plan is 20 ms late"


def test_a_wall_is_not_hit_before_the_vehicle_is_square_to_it() -> None:
    """Requests contain this time, and a plan with an earlier hit is replaced by a later one."""
    mission = msgspec.structs.replace(
        MISSION, goal_trajectory=TrajectoryPieces((0.0, 0.0), [(1.0, 0.0, 0.0)])
    )
    planning = Planning(mission)

    def request_at(now_us: int, square_us: int) -> PlanRequest:
        return known(planning.request(BETWEEN, state_at(now_us), OVER, square_us))

    first = request_at(NOW_US, NOW_US + 1_500_000)
    assert first.lock_ready_us == NOW_US + 1_500_000
    plan = msgspec.structs.replace(answer_to(first), impact_s=1.8, duration_s=1.8)
    planning.accept(plan, NOW_US + 40_000)
    assert planning.flies(moved_to(first))
    impact_us = first.begin_us + 1_800_000
    assert request_at(NOW_US + 350_000, impact_us - 1).under_way
    # The vehicle has turned further than predicted.
    late = request_at(NOW_US + 700_000, impact_us + 1)
    assert not late.under_way
    assert late.coasts
    later = msgspec.structs.replace(answer_to(late), impact_s=3.0, duration_s=3.0)
    planning.accept(later, NOW_US + 740_000)
    assert planning.flies(moved_to(late))


def test_a_trajectory_that_starts_elsewhere_is_refused() -> None:
    planning, request = planning_with_request()
    planning.accept(answer_to(request), NOW_US + 40_000)
    refused = planning.trajectory(state_at(request.begin_us, (1.3, -0.9, 1.0)))
    assert "m away from the start of the trajectory" in (refusal_in(refused) or "")
    assert refused.course is None


@pytest.mark.parametrize(
    ("beside_m", "beside_m_s", "flown"),
    [(0.07, 0.0, True), (0.09, 0.0, False), (0.0, 0.2, True), (0.0, 0.3, False)],
)
def test_a_trajectory_is_flown_if_the_position_loop_can_still_reach_it(
    beside_m: float, beside_m_s: float, flown: bool
) -> None:
    planning, request = planning_with_request()
    planning.accept(answer_to(request), NOW_US + 40_000)
    state = moved_to(request)
    (x, y, z), (vx, vy, vz) = state.position, state.velocity
    state.position, state.velocity = (x, y + beside_m, z), (vx - beside_m_s, vy, vz)
    assert planning.flies(state) is flown
    assert not planning.flies(moved_to(request))  # once


def test_a_trajectory_is_compared_with_the_vehicle_at_the_present_time() -> None:
    """The first sample after the begin time may arrive late."""
    planning, request = planning_with_request()
    planning.accept(answer_to(request), NOW_US + 40_000)
    state = moved_to(request)
    (x, y, z), (vx, vy, _), late_s = state.position, state.velocity, 0.4
    state.now_us, state.position = request.begin_us + 400_000, (x + late_s * vx, y + late_s * vy, z)
    assert planning.flies(state)


def test_a_planned_trajectory_keeps_the_altitude_between_its_walls() -> None:
    """The waypoint after the second wall is higher."""
    higher = {"position_m": [0.0, 0.0], "altitude_m": 1.4, "after": 2}
    planning = Planning(MISSION.replace({"waypoints": [higher]}))
    request = known(planning.request(BETWEEN, state_at(NOW_US), OVER))
    planning.accept(answer_to(request), NOW_US + 40_000)
    course = known(planning.trajectory(moved_to(request)).course)
    assert course.target[2] == 1.0


def test_a_contact_discards_earlier_plans() -> None:
    planning, request = planning_with_request()
    planning.contact_begins()
    assert refusal_to(planning, answer_to(request), NOW_US + 40_000) is not None
    answered, request = planning_with_request()
    assert refusal_to(answered, answer_to(request), NOW_US + 40_000) is None
    answered.contact_begins()
    assert not answered.flies(moved_to(request))
    flown, request = planning_with_request()
    assert refusal_to(flown, answer_to(request), NOW_US + 40_000) is None
    assert flown.flies(moved_to(request))
    flown.contact_begins()
    much_later = state_at(request.begin_us + 60_000_000)
    assert flown.replan.since_us is None
    assert flown.replan.predict_impact(1.2, much_later) is None
    assert not flown.is_late(MISSION.walls[1], much_later)
    assert not flown.replan.is_over(much_later.now_us)


@pytest.mark.parametrize(
    ("velocity", "closing_m_s"), [((0.7, -0.1, 0.0), 0.5), ((-0.7, 0.1, 0.0), _MIN_CLOSING_M_S)]
)
def test_the_lateness_limit_of_a_wall_includes_its_position_uncertainty(
    velocity: tuple[float, float, float], closing_m_s: float
) -> None:
    """The uncertainty is divided by the closing speed, or by a low speed if there is none."""
    planning, request = planning_with_request()
    assert refusal_to(planning, answer_to(request), NOW_US + 40_000) is None
    assert planning.flies(moved_to(request))
    wall = msgspec.structs.replace(MISSION.walls[1], position_sd_m=0.1, normal=(-0.8, -0.6))
    late_s = MISSION.vehicle.guard.wall_late_s + SURE_SD * 0.1 / closing_m_s
    due_us = request.begin_us + 1_300_000 + round(late_s * 1e6)
    for beside_us, late in ((-1000, False), (1000, True)):
        state = state_at(due_us + beside_us)
        state.velocity = velocity
        assert planning.is_late(wall, state) is late


# --- along the mission's own trajectories ------------------------------------------------------------------

ALONG = load_mission(packaged("missions", "touch_and_return.yaml"))


def state_on_line(t_us: int, off_m: float = 0.0) -> FlightState:
    """Return a state on the line of `answer_to`, or `off_m` beside it."""
    since_s = (t_us - NOW_US) * 1e-6
    return state_at(t_us, (1.0 + 0.4 * since_s, -1.0 + 0.5 * since_s + off_m, 1.0))


def request_along(planning: Planning, state: FlightState) -> PlanRequest | None:
    """Return the request after the first contact, on the path to the second wall."""
    *_, hit, following, _ = ALONG.collisions
    over = Sensed(estimate=ForceEstimate(NOW_US, (1.3, 0.0, 0.0), False), height_m=0.02)
    return planning.request((hit, following), state, over)


def flown_planning(duration_s: float) -> tuple[Planning, PlanRequest]:
    """Return a planning whose first answer is flown, and the request for it."""
    planning = Planning(ALONG)
    request = known(request_along(planning, state_on_line(NOW_US)))
    assert request_along(planning, state_on_line(NOW_US + 100_000)) is None
    answer = msgspec.structs.replace(answer_to(request), duration_s=duration_s, impact_s=duration_s)
    assert refusal_to(planning, answer, NOW_US + 40_000) is None
    assert planning.replan.impact_in_s(state_on_line(NOW_US)) == -math.inf
    assert planning.flies(state_on_line(request.begin_us))
    return planning, request


def test_a_request_without_a_trajectory_is_repeated_for_each_contact() -> None:
    planning, times = Planning(ALONG), []
    for contact_us in (NOW_US, NOW_US + 5_000_000):
        planning.contact_begins()
        for t_us in range(contact_us, contact_us + 4_000_000, 10_000):
            request = request_along(planning, state_on_line(t_us))
            if request is not None:
                times.append(t_us - contact_us)
                assert (request.under_way, request.contact_height_m) == (False, 0.02)
                refused = msgspec.structs.replace(answer_to(request), problem="none")
                assert refusal_to(planning, refused, t_us) == "none"
    assert times == [_AGAIN_US * i for i in range(_TRIES)] * 2


def test_no_request_is_sent_while_an_answer_waits_for_its_start() -> None:
    planning = Planning(ALONG)
    request = known(request_along(planning, state_on_line(NOW_US)))
    assert refusal_to(planning, answer_to(request), NOW_US) is None
    assert request_along(planning, state_on_line(NOW_US + _AGAIN_US + 100_000)) is None


def test_a_flown_trajectory_is_replanned_until_shortly_before_its_end() -> None:
    planning, first = flown_planning(1.3)
    end_us = first.begin_us + 1_300_000
    assert planning.replan.impact_in_s(state_on_line(end_us - 300_000)) == pytest.approx(0.3)
    times = []
    for t_us in range(first.begin_us, end_us + 1_000_000, 10_000):
        request = request_along(planning, state_on_line(t_us))
        if request is not None:
            assert request.under_way
            times.append(t_us)
    within_us = round(ALONG.vehicle.flying.replan_within_s * 1e6)
    assert times[0] == NOW_US + _AGAIN_US
    assert {b - a for a, b in itertools.pairwise(times)} == {_AGAIN_US}
    assert 0 <= end_us - times[-1] - within_us - _NOT_AGAIN_US <= _AGAIN_US
    planning.contact_begins()
    assert planning.replan.impact_in_s(state_on_line(end_us)) == -math.inf


@pytest.mark.parametrize(
    ("later_s", "off_m", "taken"),
    [
        (_LATER_S - 0.02, 0.0, True),
        (_LATER_S + 0.02, 0.0, False),
        (_LATER_S + 0.02, _HELD_TO_M - 0.05, False),
        (_LATER_S + 0.02, _HELD_TO_M + 0.05, True),
        (-0.3, 0.0, True),
    ],
)
def test_a_trajectory_is_kept_if_its_replacement_ends_much_later(
    later_s: float, off_m: float, taken: bool
) -> None:
    """Unless the vehicle is far from it."""
    planning, first = flown_planning(1.3)
    request = known(request_along(planning, state_on_line(NOW_US + 400_000, off_m)))
    left_s = 1.3 - (request.begin_us - first.begin_us) * 1e-6
    there_s = left_s + later_s
    answer = msgspec.structs.replace(answer_to(request), duration_s=there_s, impact_s=there_s)
    assert refusal_to(planning, answer, request.t_us) is None
    change = planning.trajectory(state_on_line(request.begin_us, off_m))
    assert (change.course is not None) is taken
    why = "" if taken else "the trajectory flown is quicker"
    assert change.outputs == (PlanTaken(request.begin_us, request.number, taken, why),)
    assert planning.replan.since_us == (request if taken else first).begin_us
