"""The fastest flights with and without collisions, against Ruckig, a grid, bounds and simulated flights."""

from __future__ import annotations

import functools
import itertools
import json
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dart_flight
from dart_flight.base.records import Mode
from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.lab.search import quickest
from dart_flight.lab.search.free_time import straight_time_s
from dart_flight.lab.search.mission_writer import write_mission
from dart_flight.lab.search.optimal_trajectory import (
    ContactResponse,
    Hit,
    HitLimits,
    Part,
    Problem,
    solve,
)
from dart_flight.lab.search.plan import MotionLimits, Plan, SearchResult
from dart_flight.lab.search.plan_table import describe_quickest
from dart_flight.lab.search.quickest import LeastTimes, LegEnd, plan_quickest
from dart_flight.lab.search.scenario import Scenario, load_scenario
from tests.extras import needs_ruckig, ruckig

pytestmark = needs_ruckig

MAPS = Path(__file__).parents[2] / "data" / "scenarios"
LIMITS = {"speed_m_s": 3.0, "acceleration_m_s2": 5.0, "jerk_m_s3": 8.0, "peak_force_n": 150.0}


def scenario_between_walls(
    east_m: float = 2.0, visits: list[Any] | None = None, sequence: Any = "any", **other: Any
) -> Scenario:
    """Return a scenario with one wall to the east and one to the west of start and goal."""
    wall = {"length_m": 4.0, "material": "acrylic"}
    tree = {
        "version": 1,
        "name": "between",
        "start": {"position_m": [0.0, 0.0], "altitude_m": 1.0},
        "goal": {"position_m": [0.0, 0.0]},
        "bounds_m": {"x": [-5.0, 5.0], "y": [-3.0, 3.0], "z": [0.3, 2.5]},
        "walls": {
            "east": wall | {"point_m": [east_m, 0.0], "normal": [-1.0, 0.0]},
            "west": wall | {"point_m": [-2.0, 0.0], "normal": [1.0, 0.0]},
        },
        "visits": [{"position_m": [east_m, 0.0], "within_m": 0.05}] if visits is None else visits,
        "sequence": sequence,
        "objective": "quickest",
        "limits": LIMITS,
    }
    return load_scenario(tree | other)


@functools.cache
def one_turn() -> SearchResult:
    """Return the plans of the scenario between walls, with one turn at the east wall."""
    return plan_quickest(scenario_between_walls())


def assert_within(found: Plan, limits: MotionLimits) -> None:
    assert limits.jerk_m_s3 is not None
    for leg in found.legs:
        for _, jx, jy in leg.pieces:
            assert math.hypot(jx, jy) <= limits.jerk_m_s3 * 1.001
        for state in leg.states():
            assert math.hypot(*state.velocity) <= limits.speed_m_s + 1e-3
            assert math.hypot(*state.acceleration) <= limits.acceleration_m_s2 + 1e-3


def test_a_collision_reverses_the_vehicle_faster_than_braking() -> None:
    result = one_turn()
    assert result.free is not None
    assert result.best is result.colliding
    assert result.best.sequence == ("east",)
    assert result.saving_s is not None
    # An independent optimal control saves 15 to 19 %, with one reversal and places within 5 cm.
    assert 0.12 < result.saving_s / result.free.time_to_goal_s < 0.22
    assert result.gap_s == 0.0
    limits = MotionLimits(3.0, 5.0, 8.0, 45.0)
    assert_within(result.best, limits)
    assert_within(result.free, limits)
    leg = Trajectory.from_mission(result.free.legs[0], 1.0)
    positions = [leg.at(t).position[0] for t in np.linspace(0.0, leg.duration_s, 2000)]
    assert max(positions) == pytest.approx(2.0 - 0.04, abs=2e-3)


def test_a_planned_collision_follows_the_contact_law() -> None:
    scenario, found = one_turn().scenario, one_turn().best
    (hit,), (into, out) = found.collisions, found.legs
    response = ContactResponse.at_wall(scenario.vehicle, scenario.walls["east"], hit.mode)
    before, after = into.states()[-1], out.states()[0]
    assert before.velocity[0] == pytest.approx(-hit.normal_m_s, abs=1e-3)
    dead_s = scenario.vehicle.flying.replan_within_s
    left = after.velocity[0] - dead_s * after.acceleration[0]
    assert left == pytest.approx(-response.restitution * before.velocity[0], abs=1e-3)
    # The thrust is unchanged by the contact; the drag follows the velocity.
    drag = scenario.vehicle.airframe.drag_per_s[0]
    released_m_s = -response.restitution * before.velocity[0]
    thrust_m_s2 = before.acceleration[0] + drag * before.velocity[0]
    assert after.acceleration[0] == pytest.approx(thrust_m_s2 - drag * released_m_s, abs=1e-3)
    assert after.acceleration[1] == pytest.approx(before.acceleration[1], abs=1e-3)
    # The contact force begins before the plane, by the lead time times the speed.
    assert before.position[0] == pytest.approx(2.0 - response.lead_s * before.velocity[0], abs=1e-3)
    assert out.states()[-1].position == pytest.approx((0.0, 0.0), abs=1e-3)
    total_s = into.duration_s + response.contact_s + dead_s + out.duration_s
    assert found.time_to_goal_s == pytest.approx(total_s, abs=1e-3)


@pytest.mark.parametrize("sequence", [["far"], pytest.param(["near", "far"], marks=pytest.mark.rest)])
def test_the_far_side_of_a_partition_is_reached_around_its_end(sequence: list[str]) -> None:
    """The partition is two walls back to back; neither can be reached through the other."""
    wall = {"length_m": 1.0, "material": "acrylic"}
    walls = {
        "near": wall | {"point_m": [1.0, 0.0], "normal": [-1.0, 0.0]},
        "far": wall | {"point_m": [1.5, 0.0], "normal": [1.0, 0.0]},
    }
    found = plan_quickest(scenario_between_walls(visits=[], walls=walls, sequence=sequence)).best
    assert [hit.wall for hit in found.collisions] == sequence
    assert found.collisions[-1].normal_m_s < 0.0
    places = np.array([state.position for leg in found.legs for state in leg.states()])
    between_them = (places[:, 0] > 1.02) & (places[:, 0] < 1.48)
    assert between_them.any()
    assert np.abs(places[between_them, 1]).min() > 0.5


def visits_at(*x_m: float) -> list[Any]:
    return [{"position_m": [x, 0.0], "within_m": 0.05} for x in x_m]


@pytest.mark.rest
def test_every_visit_may_be_a_collision_up_to_the_number_that_is_computed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    room = scenario_between_walls(1.25, visits_at(1.25, -2.0, 1.25))
    whole = plan_quickest(room)
    assert whole.best.sequence == ("east", "west", "east")
    assert (whole.most_hits, whole.gap_s) == (None, 0.0)
    assert "hits were not computed" not in describe_quickest(whole)
    monkeypatch.setattr(quickest, "MOST_HITS", 2)
    limited = plan_quickest(room)
    assert len(limited.best.sequence) <= 2
    assert limited.most_hits == 2
    assert limited.gap_s >= limited.best.time_to_goal_s - whole.best.time_to_goal_s > 0.1
    assert "sequences of more than 2 hits were not computed" in describe_quickest(limited)


@pytest.mark.rest
def test_a_required_sequence_may_have_up_to_sixteen_walls() -> None:
    result = plan_quickest(scenario_between_walls(1.25, [], ["east", "west"] * 2))
    assert result.best.sequence == ("east", "west") * 2
    with pytest.raises(InputError, match="expected a list of 1 to 16 walls or the word `any`, not 18"):
        scenario_between_walls(1.25, [], ["east", "west"] * 9)


@pytest.mark.rest
def test_the_choice_of_mode_may_change_the_best_sequence(monkeypatch: pytest.MonkeyPatch) -> None:
    """The partition is faster in flexible mode; the end wall is faster in rigid mode, which allows a lean."""
    monkeypatch.setattr(quickest, "MOST_HITS", 1)
    result = plan_quickest(load_scenario(MAPS / "hairpin_3.yaml"))
    assert result.colliding is not None
    assert (result.colliding.sequence, result.colliding.modes) == (("end",), (Mode.RIGID,))
    assert result.best is result.colliding


def test_the_free_plan_is_returned_if_a_collision_costs_time() -> None:
    """With a goal beside the wall, a restitution of 0.7 leaves too much speed to brake."""
    goal = {"position_m": [1.7, 0.0]}
    result = plan_quickest(scenario_between_walls(visits=[], goal=goal))
    assert result.best is result.free
    assert result.free is not None
    assert result.free.collisions == ()
    required = plan_quickest(scenario_between_walls(visits=[], goal=goal, sequence=["east"]))
    assert required.best.sequence == ("east",)
    assert required.saving_s is not None
    assert required.saving_s < 0.0


def test_the_plan_matches_an_exhaustive_grid_of_impacts_with_time_optimal_legs() -> None:
    """The grid has steps of impact velocity and thrust; Ruckig computes both legs along the normal."""
    scenario, found = one_turn().scenario, one_turn().best
    hit = found.collisions[0]
    response = ContactResponse.at_wall(scenario.vehicle, scenario.walls["east"], hit.mode)
    drag, dead_s = scenario.vehicle.airframe.drag_per_s[0], scenario.vehicle.flying.replan_within_s
    best = math.inf
    for v, thrust in itertools.product(np.arange(1.0, 3.01, 0.05), (0.15, 0.3, 0.45)):
        a = -(thrust + drag * v)  # the wall is to the east
        x = 2.0 - response.lead_s * v
        out = -response.restitution * v
        released = 2.0 + response.lead_s * out
        after = released + out * dead_s + 0.5 * a * dead_s**2
        leg_s = _leg_s((0.0, 0.0, 0.0), (x, v, a)) + _leg_s((after, out + a * dead_s, a), (0.0, 0.0, 0.0))
        best = min(best, leg_s + response.contact_s + dead_s)
    assert found.time_to_goal_s <= 1.02 * best
    assert found.time_to_goal_s >= 0.97 * best  # a plan much faster than the grid would be infeasible


def _leg_s(begin: tuple[float, float, float], end: tuple[float, float, float]) -> float:
    parameters = ruckig.InputParameter(1)
    for name, value in zip(("position", "velocity", "acceleration"), begin, strict=True):
        setattr(parameters, f"current_{name}", [float(value)])
    for name, value in zip(("position", "velocity", "acceleration"), end, strict=True):
        setattr(parameters, f"target_{name}", [float(value)])
    parameters.max_velocity, parameters.max_acceleration, parameters.max_jerk = [3.0], [5.0], [8.0]
    found = ruckig.Trajectory(1)
    try:
        result = ruckig.Ruckig(1).calculate(parameters, found)
    except ruckig.RuckigError:
        return math.inf
    return float(found.duration) if result in (ruckig.Result.Working, ruckig.Result.Finished) else math.inf


@given(st.floats(0.05, 8.0), st.floats(1.0, 4.0), st.floats(2.0, 8.0), st.floats(4.0, 40.0))
def test_the_bounds_of_a_leg_are_ordered_and_above_its_length_over_speed(
    length: float, speed: float, a: float, jerk: float
) -> None:
    limits = MotionLimits(speed, a, jerk, 45.0)
    least = LeastTimes(limits, 0.8 * speed)
    assert least.leg_s(length, LegEnd.REST, LegEnd.REST) <= straight_time_s(length, limits) + 1e-9
    for begin, end in itertools.product(LegEnd, LegEnd):
        assert least.leg_s(length, begin, end) >= length / speed - 1e-9
        assert least.leg_s(length, begin, end) <= least.leg_s(length, LegEnd.REST, LegEnd.REST) + 1e-9


@settings(max_examples=5, deadline=None)
@given(st.floats(1.0, 3.0), st.floats(0.05, 0.5))
@pytest.mark.rest
def test_the_best_plan_is_the_faster_of_free_and_colliding(east_m: float, within_m: float) -> None:
    result = plan_quickest(
        scenario_between_walls(east_m, [{"position_m": [east_m, 0.0], "within_m": within_m}])
    )
    times = [plan.time_to_goal_s for plan in (result.free, result.colliding) if plan is not None]
    assert result.best.time_to_goal_s == min(times)


def test_the_chosen_modes_respect_the_peak_force() -> None:
    """Rigid contacts are shorter but too hard at 3 m/s, and the lock needs time between collisions."""
    visits = [{"position_m": [x, 0.0], "within_m": 0.05} for x in (2.0, -2.0)]
    result = plan_quickest(scenario_between_walls(visits=visits))
    assert result.best.sequence == ("east", "west")
    for hit in result.best.collisions:
        assert hit.peak_force_n <= 150.0 + 1e-3
        assert hit.mode in (Mode.RIGID, Mode.FLEXIBLE)


def test_a_colliding_plan_completes_as_a_mission(tmp_path: Path) -> None:
    result = one_turn()
    write_mission(result.scenario, result.best, tmp_path / "turn.yaml")
    mission = dart_flight.load_mission(tmp_path / "turn.yaml")
    assert dart_flight.load_mission(mission.to_dict()).to_dict() == mission.to_dict()
    flown = dart_flight.simulate(mission, seed=2)
    assert flown.verdict.outcome == "completed"
    (hit,) = flown.verdict.collisions
    assert hit.truth is not None
    assert hit.planned is not None
    assert hit.truth.normal_m_s == pytest.approx(hit.planned.normal_m_s, abs=0.15)
    phases = flown.log["/event/phase"]
    began = next(t for t, p in zip(phases["t_us"], phases["after"], strict=True) if p == "approach")
    goal = next(t for t, p in zip(phases["t_us"], phases["after"], strict=True) if p == "goal")
    assert (goal - began) * 1e-6 == pytest.approx(result.best.time_to_goal_s, rel=0.1)


@pytest.mark.rest
def test_the_free_plan_completes_as_a_mission(tmp_path: Path) -> None:
    result = one_turn()
    assert result.free is not None
    write_mission(result.scenario, result.free, tmp_path / "free.yaml")
    flown = dart_flight.simulate(dart_flight.load_mission(tmp_path / "free.yaml"), seed=2)
    assert flown.verdict.outcome == "completed"
    truth = flown.log["/truth/state"]["position_mission"]
    assert 1.94 < max(p[0] for p in truth) < 2.0


SEARCH = {
    "normal_m_s": {"min": -1.0, "max": -0.5, "step": 0.5},
    "tangential_m_s": {"min": 0.0, "max": 0.0, "step": 0.5},
}
POST = {"centre_m": [1.0, 0.05], "radius_m": 0.1, "material": "acrylic"}


@functools.cache
def turn_around_a_post() -> SearchResult:
    """Return the plans of `one_turn` with a post on the straight line to the wall."""
    return plan_quickest(scenario_between_walls(posts={"mast": POST}))


@pytest.mark.rest
@pytest.mark.parametrize("kind", ["free", "colliding"])
def test_a_post_is_passed_with_clearance_for_any_heading(kind: str) -> None:
    result = turn_around_a_post()
    plan, unhindered = getattr(result, kind), getattr(one_turn(), kind)
    airframe = result.scenario.vehicle.airframe
    clearance_m = 0.1 + math.hypot(airframe.contact_distance_m, airframe.guard_along_m)
    for leg in plan.legs:
        flown = Trajectory.from_mission(leg, 1.0)
        for t in np.arange(0.0, flown.duration_s, 0.02):
            assert math.dist(flown.at(float(t)).position[:2], (1.0, 0.05)) >= clearance_m + 0.1
    assert plan.time_to_goal_s > unhindered.time_to_goal_s


@pytest.mark.rest
@pytest.mark.parametrize("kind", ["free", "colliding"])
def test_a_plan_around_a_post_completes_as_a_mission(kind: str, tmp_path: Path) -> None:
    result = turn_around_a_post()
    write_mission(result.scenario, getattr(result, kind), tmp_path / "post.yaml")
    mission = dart_flight.load_mission(tmp_path / "post.yaml")
    assert [post.name for post in mission.posts] == ["mast"]
    assert dart_flight.simulate(mission, seed=2).verdict.outcome == "completed"


def test_the_end_of_a_wall_is_passed_at_the_minimum_clearance() -> None:
    """The minimum clearance from the edge is half the vehicle's width plus a margin."""
    panel = {"point_m": [1.0, 1.0], "normal": [-1.0, 0.0], "length_m": 2.0, "material": "acrylic"}
    scenario = scenario_between_walls(
        goal={"position_m": [2.5, 1.0]},
        start={"position_m": [0.0, 1.0], "altitude_m": 1.0},
        walls={"panel": panel},
        visits=[],
    )
    free = plan_quickest(scenario).free
    assert free is not None
    (leg,) = free.legs
    flown = Trajectory.from_mission(leg, 1.0)
    places = [flown.at(float(t)).position[:2] for t in np.arange(0.0, flown.duration_s, 0.005)]
    nearest = min(min(math.dist(p, edge) for edge in ((1.2, 0.0), (1.2, 2.0))) for p in places)
    assert nearest == pytest.approx(0.2 + 0.13, abs=0.01)


def test_every_wall_is_touched_before_its_first_collision(tmp_path: Path) -> None:
    """Each wall is touched once, in the mode of its first collision, with a rest at the start after it."""
    visits = [{"position_m": [x, 0.0], "within_m": 0.05} for x in (2.0, -2.0, 2.0)]
    scenario = scenario_between_walls(visits=visits, touch_m_s=0.5)
    plan = plan_quickest(scenario).colliding
    assert plan is not None
    write_mission(scenario, plan, tmp_path / "touch.yaml")
    mission = dart_flight.load_mission(tmp_path / "touch.yaml")
    touches, hits = mission.collisions[:2], mission.collisions[2:]
    assert sorted(touch.wall.name for touch in touches) == ["east", "west"]
    for touch in touches:
        assert touch.approach_m_s == (-0.5, 0.0)
        assert touch.trajectory is None
        assert touch.mode is next(hit.mode for hit in hits if hit.wall.name == touch.wall.name)
    assert [hit.wall.name for hit in hits] == list(plan.sequence)
    assert [(w.after, w.position and w.position[:2]) for w in mission.waypoints] == [
        (1, (0.0, 0.0)),
        (2, (0.0, 0.0)),
    ]


def test_plan_reports_the_time_that_the_collision_saves(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    shipped = packaged("missions", "scenarios", "touch_and_return.yaml")
    assert main(["plan", str(shipped), "--json", "--no-verify", "-o", str(tmp_path / "m.yaml")]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["plans"][0]["saving_s"] == pytest.approx(
        output["free"]["time_s"] - output["plans"][0]["time_to_goal_s"]
    )
    assert output["plans"][0]["saving_s"] > 0.5
    assert output["free"]["limits"]["jerk_m_s3"] == 8.0
    assert dart_flight.load_mission(tmp_path / "m.yaml").goal_trajectory is not None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"objective": "nearest"}, "missing key `search`"),
        (
            {"objective": "nearest", "posts": {"mast": POST}, "visits": [], "search": SEARCH},
            "posts: this key is possible only",
        ),
        (
            {"objective": "nearest", "touch_m_s": 0.5, "visits": [], "search": SEARCH},
            "touch_m_s: this key is possible only",
        ),
        ({"posts": {"mast": POST | {"centre_m": [0.0, 0.0]}}}, "is in or at post mast"),
        ({"posts": {"east": POST}}, "a wall already has the name east"),
        ({"visits": [{"position_m": [9.0, 0.0], "within_m": 0.1}]}, "outside bounds_m"),
        (
            {"limits": LIMITS | {"peak_force_n": 5.0}, "sequence": ["east"]},
            "no feasible trajectory hits east",
        ),
    ],
)
def test_an_infeasible_scenario_is_refused_with_the_reason(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        plan_quickest(scenario_between_walls(**change))


def test_a_trajectory_with_other_end_states_is_refused(tmp_path: Path) -> None:
    result = one_turn()
    write_mission(result.scenario, result.best, tmp_path / "m.yaml")
    tree = dart_flight.load_mission(tmp_path / "m.yaml").to_dict()
    changes: list[tuple[dict[str, Any], str]] = [
        ({"start.position_m": [0.5, 0.0]}, "must begin at rest"),
        ({"collisions[0].predicted.normal_m_s": -1.0}, "not at the predicted velocity"),
        ({"goal.position_m": [0.5, 0.0]}, "from the goal"),
        ({"after_impact": "setpoint"}, "needs `after_impact: replan`"),
    ]
    mission = dart_flight.load_mission(tree)
    for change, message in changes:
        with pytest.raises(InputError, match=message):
            mission.replace(change)


def test_collisions_save_about_a_sixth_of_the_time_of_a_shuttle() -> None:
    result = plan_quickest(load_scenario(MAPS / "shuttle_4.yaml"), 20.0)
    assert result.free is not None
    assert result.colliding is not None
    assert 0.1 < 1.0 - result.colliding.time_to_goal_s / result.free.time_to_goal_s < 0.25


def test_two_collisions_guessed_at_one_place_give_a_valid_initial_point() -> None:
    """In a corner of two walls, the initial guess of the leg between them has no length."""
    scenario = scenario_between_walls()
    east, corner = scenario.walls["east"], (2.0, -1.0)
    south = msgspec.structs.replace(east, name="south", point=(0.0, -1.0), normal=(0.0, 1.0))
    hits = [Hit(wall, Mode.FLEXIBLE, guess=corner, velocity_m_s=(-1.0, 0.3)) for wall in (east, south)]
    parts = tuple(Part(to, ()) for to in (*hits, None))
    limits, hit_limits = MotionLimits(3.0, 5.0, 8.0, 45.0), HitLimits(150.0, None, None, None, 0.0)
    with np.errstate(all="raise"):
        found = solve(Problem(scenario.vehicle, (0.0, 0.0), (0.0, 0.0), parts, limits, hit_limits, 0.1))
    assert found is not None
    assert [hit.wall for hit in found.collisions] == [east.name, south.name]
