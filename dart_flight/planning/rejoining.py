"""Trajectories from the state after an impact back to the trajectory that was planned before the flight.

Each rejoining trajectory is the sum of the planned trajectory and a fifth-order polynomial per axis. The
vehicle may join the planned trajectory at a later point, and fly the rest more slowly than planned. The
polynomial starts with the deviation of the vehicle's state from the plan. Some time before the trajectory's
end, the polynomial and its first two derivatives reach zero. The trajectory therefore keeps the optimised
shape, the end and the final velocity of the plan, with small additional accelerations.

In the last tenths of a second before a wall, only two differences from the plan remain. The end is shifted to
the estimated wall, and the final acceleration gives the desired tilt of the vehicle. If the correction lasted
until the impact, the vehicle would still be rotating at the impact.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from dart_flight.base.arithmetic import sum_in_order
from dart_flight.base.geometry import Vec2
from dart_flight.contact.coefficients import Array, Rows
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.planning.polynomials import derivative, quintic

_SAMPLES = 24
_STEP_S = 0.03  # step between the times on the planned trajectory at which candidates begin
_SLOWER = (1.0, 1.05, 1.1, 1.2, 1.35, 1.6, 2.0)
_LEAST_S = 0.2  # shortest trajectory
_SAME_S = 1e-6  # a shorter piece is omitted
SETTLED_S = 0.2  # last part before a wall, without correction; longer than the attitude's lag
_SETTLED_SHARE = 0.3  # the last part is at most this fraction of a trajectory


class RejoiningTrajectories(NamedTuple):
    """Candidate trajectories (n) that lead back to a planned trajectory; each is sampled at k times.

    Attributes:
        shares: (k,) sampling times, as fractions of each duration.
        from_s: (n,) time on the planned trajectory at which the candidate begins.
        slower: (n,) factor, 1 or larger, by which the candidate slows down the planned trajectory.
        duration_s: (n,) duration of the candidate, s.
        settled_s: (n,) time from the candidate's beginning to the end of the correction.
        added: (2, n, 6) coefficients of the added polynomials before `settled_s`, constant term first.
        kept: (2, n, 6) coefficients of the added polynomials after `settled_s`, as functions of the time
            since `settled_s`. The polynomials shift the end state and add an acceleration at the end.
        position, velocity, acceleration, jerk: (2, n, k) samples, mission frame.
    """

    planned: Trajectory
    shares: Array
    from_s: Array
    slower: Array
    duration_s: Array
    settled_s: Array
    added: Array
    kept: Array
    position: Array
    velocity: Array
    acceleration: Array
    jerk: Array

    def select(self, rows: Rows) -> RejoiningTrajectories:
        by_row = (v[rows] for v in self[2:6])
        return RejoiningTrajectories(self.planned, self.shares, *by_row, *(v[:, rows] for v in self[6:]))

    def trajectory(self, row: int) -> Trajectory:
        planned, slower, begin = self.planned, float(self.slower[row]), float(self.from_s[row])
        pieces: list[float] = []
        axes: tuple[list[float], list[float]] = ([], [])
        settled_s, ends = float(self.settled_s[row]), np.cumsum(planned.pieces_s)
        settled = begin + settled_s / slower
        bounds = sorted({begin, *(float(end) for end in ends if end > begin), min(settled, float(ends[-1]))})
        for first, last in itertools.pairwise(bounds):
            if last - first <= _SAME_S:
                continue
            i = min(int(np.searchsorted(ends, first + 0.5 * _SAME_S, side="right")), ends.size - 1)
            since = first - (float(ends[i - 1]) if i else 0.0)
            before = first < settled - 0.5 * _SAME_S
            more, at_s = (self.added, 0.0) if before else (self.kept, settled_s)
            for axis, written in enumerate((planned.x, planned.y)):
                shape = _shift_polynomial(written[6 * i : 6 * i + 6], since)
                added = _shift_polynomial(tuple(more[axis, row]), slower * (first - begin) - at_s)
                slowed = [c / slower**k for k, c in enumerate(shape)]
                axes[axis].extend(float(c + d) for c, d in zip(slowed, added, strict=True))
            pieces.append(slower * (last - first))
        return Trajectory.level(*axes, planned.z[0], pieces)


def candidate_trajectories(
    planned: Trajectory,
    start: tuple[Array, Array],
    moved: Vec2,
    pushed: Vec2 = (0.0, 0.0),
    settled_s: float = 0.0,
) -> RejoiningTrajectories:
    """Return the candidate trajectories back to a planned trajectory.

    Args:
        start: initial position, velocity and acceleration per axis; mission frame.
        moved: final position minus the planned one, m.
        pushed: final acceleration minus the planned one, m/s2.
        settled_s: duration of the last part, in which only `moved` and `pushed` are added to the plan. This
            part is shortened if the trajectory is short.
    """
    tried = [
        (begin, slower)
        for begin, slower in itertools.product(np.arange(0.0, planned.duration_s, _STEP_S), _SLOWER)
        if planned.duration_s - begin >= _LEAST_S
    ]
    from_s, slower = np.array(tried).reshape(-1, 2).T
    duration = (planned.duration_s - from_s) * slower
    shares = np.linspace(0.0, 1.0, _SAMPLES)
    times = from_s[:, None] + shares * (planned.duration_s - from_s)[:, None]
    shape = _sampled(planned, times) / slower[:, None] ** np.arange(4)[:, None, None, None]
    settled = np.minimum(settled_s, _SETTLED_SHARE * duration)  # before the end
    until = duration - settled
    added, kept = np.empty((2, from_s.size, 6)), np.zeros((2, from_s.size, 6))
    for axis in range(2):
        away = [start[axis][order] - shape[order, axis, :, 0] for order in range(3)]
        push = pushed[axis] * np.ones_like(duration)
        left = (moved[axis] + 0.5 * push * settled**2, -push * settled, push)
        added[axis] = quintic(away, left, until).T
        kept[axis, :, :3] = np.stack([left[0], left[1], 0.5 * push], axis=1)
    since = shares * duration[:, None]
    early, late = np.minimum(since, until[:, None]), np.maximum(since - until[:, None], 0.0)
    before, after = (np.moveaxis(rows, -1, 0)[..., None] for rows in (added, kept))
    states = [
        shape[order] + np.where(late > 0.0, derivative(after, late, order), derivative(before, early, order))
        for order in range(4)
    ]
    return RejoiningTrajectories(planned, shares, from_s, slower, duration, until, added, kept, *states)


def _sampled(planned: Trajectory, times: Array) -> Array:
    """Return (4, 2, n, k): position, velocity, acceleration and jerk at times (n, k) of a trajectory."""
    begins = np.cumsum([0.0, *planned.pieces_s[:-1]])
    piece = np.clip(np.searchsorted(begins, times, side="right") - 1, 0, begins.size - 1)
    since = times - begins[piece]
    by_axis = np.array([planned.x, planned.y]).reshape(2, -1, 6)
    rows = np.moveaxis(by_axis[:, piece], -1, 0)  # one polynomial for every time
    return np.stack([derivative(rows, since, order) for order in range(4)])


def _shift_polynomial(coefficients: tuple[float, ...], by: float) -> list[float]:
    """Return a polynomial's coefficients after shifting the origin of time by `by`."""
    return [
        sum_in_order(math.comb(n, k) * coefficients[n] * by ** (n - k) for n in range(k, len(coefficients)))
        for k in range(len(coefficients))
    ]
