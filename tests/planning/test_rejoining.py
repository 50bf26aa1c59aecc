"""Back to a planned trajectory from where a hit really led."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.config.mission_file import TrajectoryPieces
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.planning.rejoining import candidate_trajectories

PLANNED = Trajectory.from_mission(
    TrajectoryPieces(
        (1.2, 0.1),
        [(0.3, -4.0, 1.0), (0.2, 0.0, -3.0), (0.4, 6.0, 0.5), (0.5, -1.0, 0.0)],
        (-1.4, 0.2),
        (-0.3, 0.0),
    ),
    1.0,
)
SMALL = st.floats(-0.3, 0.3)


def state_at(t_s: float, away: tuple[float, ...] = (0.0,) * 6) -> tuple[np.ndarray, np.ndarray]:
    at = PLANNED.at(t_s)
    x, y = (np.array([v[axis] for v in (at.position, at.velocity, at.acceleration)]) for axis in (0, 1))
    return x + np.array(away[:3]), y + np.array(away[3:])


def test_on_the_trajectory_it_goes_on_as_planned() -> None:
    ways = candidate_trajectories(PLANNED, state_at(0.12), (0.0, 0.0))
    row = next(k for k in range(ways.from_s.size) if ways.from_s[k] == 0.12 and ways.slower[k] == 1.0)
    way = ways.trajectory(row)
    assert way.duration_s == pytest.approx(PLANNED.duration_s - 0.12)
    for t in np.linspace(0.0, way.duration_s, 17):
        flown, planned = way.at(float(t)), PLANNED.at(float(t) + 0.12)
        assert flown.position == pytest.approx(planned.position, abs=1e-9)
        assert flown.velocity == pytest.approx(planned.velocity, abs=1e-9)
        assert flown.acceleration == pytest.approx(planned.acceleration, abs=1e-9)


@settings(max_examples=40)
@given(st.tuples(*[SMALL] * 6), st.tuples(SMALL, SMALL), st.sampled_from([0.0, 0.2]))
def test_every_way_begins_at_the_vehicle_and_ends_as_planned(
    away: tuple[float, ...], moved: tuple[float, float], settled_s: float
) -> None:
    start = state_at(0.1, away)
    ways = candidate_trajectories(PLANNED, start, moved, (0.0, 0.0), settled_s)
    assert ways.from_s.size > 20
    planned = PLANNED.at(PLANNED.duration_s)
    for row in range(0, ways.from_s.size, 5):
        way, slower = ways.trajectory(row), float(ways.slower[row])
        begin, end = way.at(0.0), way.at(way.duration_s)
        for axis in range(2):
            mine = [v[axis] for v in (begin.position, begin.velocity, begin.acceleration)]
            assert mine == pytest.approx(list(start[axis]), abs=1e-8)
            assert end.position[axis] == pytest.approx(planned.position[axis] + moved[axis], abs=1e-8)
            assert end.velocity[axis] == pytest.approx(planned.velocity[axis] / slower, abs=1e-8)


@settings(max_examples=40)
@given(st.tuples(*[SMALL] * 6), st.tuples(SMALL, SMALL), st.tuples(SMALL, SMALL))
def test_before_a_wall_the_last_tenths_are_the_plans(
    away: tuple[float, ...], moved: tuple[float, float], pushed: tuple[float, float]
) -> None:
    ways = candidate_trajectories(PLANNED, state_at(0.1, away), moved, pushed, 0.2)
    for row in range(0, ways.from_s.size, 7):
        way, slower = ways.trajectory(row), float(ways.slower[row])
        settled_s = way.duration_s - float(ways.settled_s[row])
        assert settled_s == pytest.approx(min(0.2, 0.3 * way.duration_s))
        for before_s in (0.999 * settled_s, 0.5 * settled_s, 0.0):
            flown = way.at(way.duration_s - before_s)
            planned = PLANNED.at(PLANNED.duration_s - before_s / slower)
            for axis in range(2):
                shifted = planned.position[axis] + moved[axis] + 0.5 * pushed[axis] * before_s**2
                assert flown.position[axis] == pytest.approx(shifted, abs=1e-8)
                leaned = planned.acceleration[axis] / slower**2 + pushed[axis]
                assert flown.acceleration[axis] == pytest.approx(leaned, abs=1e-6)


@settings(max_examples=40)
@given(st.tuples(*[SMALL] * 6), st.sampled_from([0.0, 0.2]))
def test_what_is_judged_is_what_is_flown(away: tuple[float, ...], settled_s: float) -> None:
    """Samples of a way, by which it is chosen, against the polynomials sent; and no step between those."""
    ways = candidate_trajectories(PLANNED, state_at(0.0, away), (0.1, 0.0), (0.0, 0.3), settled_s)
    for row in range(0, ways.from_s.size, 11):
        way = ways.trajectory(row)
        for k, share in enumerate(ways.shares[:-1]):
            at = way.at(float(share * ways.duration_s[row]))
            for axis in range(2):
                assert at.position[axis] == pytest.approx(ways.position[axis, row, k], abs=1e-8)
                assert at.acceleration[axis] == pytest.approx(ways.acceleration[axis, row, k], abs=1e-6)
        t = 0.0
        for length in way.pieces_s[:-1]:
            t += length
            before, after = way.at(t - 1e-9), way.at(t + 1e-9)
            assert math.dist(before.position, after.position) < 1e-6
            assert math.dist(before.velocity, after.velocity) < 1e-6
            # Of jerks to 2e4 m/s3, where a trajectory is short.
            assert math.dist(before.acceleration, after.acceleration) < 1e-4


def test_too_near_to_its_end_there_is_no_way_back() -> None:
    short = Trajectory.from_mission(TrajectoryPieces((0.0, 0.0), [(0.15, 1.0, 0.0)]), 1.0)
    assert candidate_trajectories(short, state_at(0.0), (0.0, 0.0)).from_s.size == 0


def test_a_way_goes_over_the_pipe_of_the_planner() -> None:
    way = candidate_trajectories(PLANNED, state_at(0.1, (0.1,) * 6), (0.0, 0.0)).trajectory(3)
    assert msgspec.json.decode(msgspec.json.encode(way), type=Trajectory) == way
