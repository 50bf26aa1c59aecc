"""Candidate trajectories that lead from the state after a contact back to the planned trajectory."""

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


def test_a_vehicle_on_the_trajectory_continues_as_planned() -> None:
    candidates = candidate_trajectories(PLANNED, state_at(0.12), (0.0, 0.0))
    row = next(
        k
        for k in range(candidates.from_s.size)
        if candidates.from_s[k] == 0.12 and candidates.slower[k] == 1.0
    )
    candidate = candidates.trajectory(row)
    assert candidate.duration_s == pytest.approx(PLANNED.duration_s - 0.12)
    for t in np.linspace(0.0, candidate.duration_s, 17):
        flown, planned = candidate.at(float(t)), PLANNED.at(float(t) + 0.12)
        assert flown.position == pytest.approx(planned.position, abs=1e-9)
        assert flown.velocity == pytest.approx(planned.velocity, abs=1e-9)
        assert flown.acceleration == pytest.approx(planned.acceleration, abs=1e-9)


@settings(max_examples=12)
@given(st.tuples(*[SMALL] * 6), st.tuples(SMALL, SMALL), st.sampled_from([0.0, 0.2]))
def test_every_candidate_begins_at_the_vehicle_and_ends_as_planned(
    away: tuple[float, ...], moved: tuple[float, float], settled_s: float
) -> None:
    start = state_at(0.1, away)
    candidates = candidate_trajectories(PLANNED, start, moved, (0.0, 0.0), settled_s)
    assert candidates.from_s.size > 20
    planned = PLANNED.at(PLANNED.duration_s)
    for row in range(0, candidates.from_s.size, 5):
        candidate, slower = candidates.trajectory(row), float(candidates.slower[row])
        begin, end = candidate.at(0.0), candidate.at(candidate.duration_s)
        for axis in range(2):
            mine = [v[axis] for v in (begin.position, begin.velocity, begin.acceleration)]
            assert mine == pytest.approx(list(start[axis]), abs=1e-8)
            assert end.position[axis] == pytest.approx(planned.position[axis] + moved[axis], abs=1e-8)
            assert end.velocity[axis] == pytest.approx(planned.velocity[axis] / slower, abs=1e-8)


@settings(max_examples=12)
@given(st.tuples(*[SMALL] * 6), st.tuples(SMALL, SMALL), st.tuples(SMALL, SMALL))
def test_every_candidate_follows_the_plan_in_the_last_tenths_before_a_wall(
    away: tuple[float, ...], moved: tuple[float, float], pushed: tuple[float, float]
) -> None:
    candidates = candidate_trajectories(PLANNED, state_at(0.1, away), moved, pushed, 0.2)
    for row in range(0, candidates.from_s.size, 7):
        candidate, slower = candidates.trajectory(row), float(candidates.slower[row])
        settled_s = candidate.duration_s - float(candidates.settled_s[row])
        assert settled_s == pytest.approx(min(0.2, 0.3 * candidate.duration_s))
        for before_s in (0.999 * settled_s, 0.5 * settled_s, 0.0):
            flown = candidate.at(candidate.duration_s - before_s)
            planned = PLANNED.at(PLANNED.duration_s - before_s / slower)
            for axis in range(2):
                shifted = planned.position[axis] + moved[axis] + 0.5 * pushed[axis] * before_s**2
                assert flown.position[axis] == pytest.approx(shifted, abs=1e-8)
                leaned = planned.acceleration[axis] / slower**2 + pushed[axis]
                assert flown.acceleration[axis] == pytest.approx(leaned, abs=1e-6)


@settings(max_examples=12)
@given(st.tuples(*[SMALL] * 6), st.sampled_from([0.0, 0.2]))
def test_the_samples_of_a_candidate_match_its_smooth_polynomials(
    away: tuple[float, ...], settled_s: float
) -> None:
    """Compare the samples that the choice uses with the polynomials sent, which join without a step."""
    candidates = candidate_trajectories(PLANNED, state_at(0.0, away), (0.1, 0.0), (0.0, 0.3), settled_s)
    for row in range(0, candidates.from_s.size, 11):
        candidate = candidates.trajectory(row)
        for k, share in enumerate(candidates.shares[:-1]):
            at = candidate.at(float(share * candidates.duration_s[row]))
            for axis in range(2):
                assert at.position[axis] == pytest.approx(candidates.position[axis, row, k], abs=1e-8)
                assert at.acceleration[axis] == pytest.approx(candidates.acceleration[axis, row, k], abs=1e-6)
        t = 0.0
        for length in candidate.pieces_s[:-1]:
            t += length
            before, after = candidate.at(t - 1e-9), candidate.at(t + 1e-9)
            assert math.dist(before.position, after.position) < 1e-6
            assert math.dist(before.velocity, after.velocity) < 1e-6
            # A short trajectory has a jerk of up to 2e4 m/s3.
            assert math.dist(before.acceleration, after.acceleration) < 1e-4


def test_no_candidate_exists_too_close_to_the_end_of_the_trajectory() -> None:
    short = Trajectory.from_mission(TrajectoryPieces((0.0, 0.0), [(0.15, 1.0, 0.0)]), 1.0)
    assert candidate_trajectories(short, state_at(0.0), (0.0, 0.0)).from_s.size == 0


def test_a_candidate_survives_encoding_for_the_planners_pipe() -> None:
    candidate = candidate_trajectories(PLANNED, state_at(0.1, (0.1,) * 6), (0.0, 0.0)).trajectory(3)
    assert msgspec.json.decode(msgspec.json.encode(candidate), type=Trajectory) == candidate
