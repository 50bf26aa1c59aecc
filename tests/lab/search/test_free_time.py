"""The flight without collisions: optimal on a straight path, and printed beside every plan."""

from __future__ import annotations

import itertools
import json
import math

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.cli import main
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission.approach import plan_approach
from dart_flight.core.mission.trajectories import transit_time_s
from dart_flight.lab.search.free_time import least_free_time, straight_time_s
from dart_flight.lab.search.plan import MotionLimits
from dart_flight.lab.search.routes import Obstacles, least_length_m
from dart_flight.lab.search.scenario import Scenario, load_scenario
from dart_flight.lab.search.search import search
from tests.extras import needs_ruckig

pytestmark = needs_ruckig

SCENARIO = packaged("missions", "scenarios", "dual_collision.yaml")
LIMITS = st.builds(
    MotionLimits, st.floats(0.5, 5.0), st.floats(1.0, 8.0), st.floats(2.0, 40.0), st.just(45.0)
)


@given(st.floats(0.05, 20.0), st.floats(0.5, 5.0), st.floats(0.5, 10.0))
def test_the_time_without_a_jerk_limit_matches_the_closed_form(
    length: float, speed: float, acceleration: float
) -> None:
    reached = min(speed, math.sqrt(length * acceleration))
    expected = reached / acceleration + length / reached
    assert straight_time_s(length, MotionLimits(speed, acceleration, None, 45.0)) == pytest.approx(
        expected, rel=1e-6
    )


@given(st.floats(0.05, 20.0), LIMITS)
def test_no_smooth_transit_is_faster(length: float, limits: MotionLimits) -> None:
    smooth = transit_time_s(length, limits.speed_m_s, limits.acceleration_m_s2, limits.jerk_m_s3)
    assert straight_time_s(length, limits) <= smooth * (1.0 + 1e-9)


@given(st.floats(0.1, 10.0), LIMITS, st.sampled_from(["speed_m_s", "acceleration_m_s2", "jerk_m_s3"]))
def test_a_wider_limit_never_lengthens_the_flight(length: float, limits: MotionLimits, which: str) -> None:
    wider = msgspec.structs.replace(limits, **{which: 1.5 * getattr(limits, which)})
    assert straight_time_s(length, wider) <= straight_time_s(length, limits) + 1e-9


def scenario_with_wall(offset_m: float) -> Scenario:
    """Return a scenario with a wall of 2 m between start and goal, with its middle offset to the side."""
    text = {
        "version": 1,
        "start": {"position_m": [0.0, 0.0], "altitude_m": 1.0},
        "goal": {"position_m": [3.0, 0.0]},
        "bounds_m": {"x": [-3.0, 6.0], "y": [-4.0, 4.0], "z": [0.3, 2.0]},
        "walls": {
            "wood": {
                "point_m": [1.5, offset_m],
                "normal": [-1.0, 0.0],
                "length_m": 2.0,
                "material": "wood",
            }
        },
        "sequence": ["wood"],
        "search": {
            "normal_m_s": {"min": -1.0, "max": -0.5, "step": 0.5},
            "tangential_m_s": {"min": 0.0, "max": 0.0, "step": 1.0},
        },
        "alpha_wall_m_per_n": {"wood": [0.05, 0.0]},
        "limits": {"speed_m_s": 3.0, "acceleration_m_s2": 5.0, "jerk_m_s3": 8.0},
    }
    return load_scenario(text)


@settings(max_examples=15, deadline=None)
@given(st.floats(-1.0, 1.0))
def test_the_gap_of_a_flight_around_a_wall_is_a_valid_bound(offset: float) -> None:
    free = least_free_time(scenario_with_wall(offset))
    assert free.time_s is not None
    assert free.via
    assert all(abs(y - offset) > 1.0 for _, y in free.via)  # past the wall's end
    assert 0.0 < free.gap_s < free.time_s
    # The lower bound is the straight path past the wall's edge, by half a vehicle and a margin.
    scenario = scenario_with_wall(offset)
    edge_y = offset + math.copysign(1.0 + 0.2 + 0.12, -offset if offset else 1.0)
    beyond = [(1.5 + 0.2, y) for y in (edge_y, 2.0 * offset - edge_y)]
    least_m = min(math.dist((0.0, 0.0), b) + math.dist(b, (3.0, 0.0)) for b in beyond)
    assert least_length_m((0.0, 0.0), (3.0, 0.0), Obstacles.from_scenario(scenario)) == pytest.approx(least_m)
    assert free.time_s - free.gap_s == pytest.approx(straight_time_s(least_m, free.limits))
    # A stop at the corner is feasible within the same split of the limits, so it is an upper bound.
    split = msgspec.structs.replace(
        free.limits,
        **{
            name: getattr(free.limits, name) * math.sqrt(0.5)
            for name in ("speed_m_s", "acceleration_m_s2", "jerk_m_s3")
        },
    )
    places = [(0.0, 0.0), *free.via, (3.0, 0.0)]
    stopping = sum(straight_time_s(math.dist(p, q), split) for p, q in itertools.pairwise(places))
    assert free.time_s <= stopping * (1.0 + 1e-6)


def test_a_wall_beside_the_straight_path_needs_no_detour() -> None:
    free = least_free_time(scenario_with_wall(2.5))
    assert (free.via, free.gap_s) == ((), 0.0)


def test_an_approach_respects_the_missions_limits() -> None:
    mission = load_mission(packaged("missions", "single_wall.yaml")).to_dict()
    slow, fast = (
        load_mission({**mission, "limits": {"acceleration_m_s2": a, "jerk_m_s3": j}})
        for a, j in ((0.5, 2.0), (3.0, 4.0))
    )
    for one, a, j in ((slow, 0.5, 2.0), (fast, 3.0, 4.0)):
        approach = plan_approach(one, one.collisions[0])
        points = [approach.at(0.001 * k) for k in range(round(1000 * approach.pieces_s[0]))]
        assert max(math.hypot(*p.acceleration[:2]) for p in points) <= a * 1.001
        assert max(math.hypot(*p.jerk[:2]) for p in points) <= j * 1.001
    assert fast.vehicle.flying.transit_speed_m_s == 3.0  # limits.speed_m_s


@pytest.mark.parametrize(
    ("key", "reason"),
    [("closing_m_s", "closing"), ("sliding_m_s", "sliding"), ("friction_ratio", "friction")],
)
def test_an_impact_beyond_its_limit_is_refused(key: str, reason: str) -> None:
    document = msgspec.yaml.decode(SCENARIO.read_text())
    document["vehicle"] = str(packaged("configs", "dart.yaml"))
    refused = {}
    for value in (0.3, 20.0):
        document["limits"] = {key: value}
        result = search(load_scenario(document), top=3)
        refused[value] = {found.value for found in result.refused}
        for hit in (c for plan in result.plans for c in plan.collisions):
            flown = {
                "closing": -hit.normal_m_s,
                "sliding": abs(hit.tangential_m_s),
                "friction": hit.peak_friction_n / hit.peak_force_n,
            }
            assert flown[reason] <= value + 1e-9
    assert reason in refused[0.3]
    assert reason not in refused[20.0]


def test_plan_prints_free_and_colliding_times_and_their_difference(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["plan", str(SCENARIO), "--json", "--top", "1"]) == 0
    output = json.loads(capsys.readouterr().out)
    free, best = output["free"], output["plans"][0]
    assert set(free["limits"]) == {"speed_m_s", "acceleration_m_s2", "jerk_m_s3", "tilt_deg"}
    assert best["saving_s"] == pytest.approx(free["time_s"] - best["time_to_rest_s"])
    assert main(["plan", str(SCENARIO), "--top", "1"]) == 0
    assert "without any collision" in capsys.readouterr().out


def test_missing_ruckig_is_reported_by_plan(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("dart_flight.lab.search.search._free", lambda scenario: None)
    assert main(["plan", str(SCENARIO), "--top", "1"]) == 0
    assert "ruckig is not installed: " in " ".join(capsys.readouterr().out.split())
