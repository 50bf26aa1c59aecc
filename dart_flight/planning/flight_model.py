"""Free flight under PX4's position loop, in closed form, for many candidates together.

The equations hold for each axis of the mission frame. p is the position relative to the setpoint, v the
velocity, and a the acceleration at the current attitude. i is the velocity loop's integral, and b the air
drag. `core/mission/position_loop.py` defines kp, kv, ki, kd and tau:

    p' = v,   v' = a - b v,   i' = ki (-kp p - v)
    a' = (kv (-kp p - v) + i - kd v' - a) / tau

These equations are linear with constant coefficients, so the state at any time is exp(A t) times the initial
state. One matrix product gives the positions of all candidates on a grid of times. An event, such as an
impact, is first found between two grid points. Near a grid point, the solution is the Taylor series of the
matrix exponential. Within half a grid step of the grid point, this series is exact to rounding. Newton's
method finds the time of the event in this series. The model does not step through time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.mission.position_loop import PositionLoop
from dart_flight.planning.contact_stage import expm
from dart_flight.planning.polynomials import with_derivatives

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Rows = NDArray[np.intp]

GRID_S = 0.05
WINDOW = 20  # number of grid steps evaluated together: 1 s, in which most events occur
_ORDER = 11  # order of the series; over a grid step, the next term is below 1e-13 of the position
_NEWTON_STEPS = 6
_SINGLE_M = 1e-4  # tolerance for the rounding of single precision, which is far smaller


class SetpointResponse(NamedTuple):
    """Flights of n candidates, each to a constant setpoint.

    Attributes:
        x, y: initial states (4, n) along each axis: p relative to the setpoint, v, a, i.
        goal_x, goal_y: setpoints (n,), mission frame, m.
    """

    x: Array
    y: Array
    goal_x: Array
    goal_y: Array

    def select(self, rows: Rows | NDArray[np.bool_]) -> SetpointResponse:
        return SetpointResponse(self.x[:, rows], self.y[:, rows], self.goal_x[rows], self.goal_y[rows])

    @property
    def size(self) -> int:
        return int(self.goal_x.size)


class GridWindow(NamedTuple):
    """Positions (mission frame, m) and velocities on a part of the time grid; arrays (n, times).

    Single precision (1e-6 m) suffices to bracket events and to check constraints.
    """

    times: Array
    x: Array32
    y: Array32
    vx: Array32
    vy: Array32


def loop_matrix(loop: PositionLoop, drag_per_s: float) -> Array:
    """Return A of the module's equations for the states (p, v, a, i): (4, 4)."""
    kp, kv, ki, kd, tau = loop
    return np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [0.0, -drag_per_s, 1.0, 0.0],
            [-kv * kp / tau, (-kv + kd * drag_per_s) / tau, (-1.0 - kd) / tau, 1.0 / tau],
            [-ki * kp, -ki, 0.0, 0.0],
        ]
    )


class _Axis:
    """Tables of the loop's solution along one axis, at the points of the time grid."""

    def __init__(self, matrix: Array, count: int) -> None:
        self.matrix = matrix
        powers = np.stack((np.eye(4), expm(matrix * GRID_S)))
        while len(powers) <= count:  # multiply all powers by the last one, which doubles the table
            powers = np.concatenate((powers, powers[1:] @ powers[-1]))
        self.at_grid = powers[: count + 1]  # (count + 1, 4, 4)
        self.position = np.ascontiguousarray(self.at_grid[:, 0, :].T, dtype=np.float32)  # (4, count + 1)
        self.velocity = np.ascontiguousarray(self.at_grid[:, 1, :].T, dtype=np.float32)
        # Largest contribution of each initial state to the position, at any time from each grid point on.
        self.reach = np.maximum.accumulate(np.abs(self.at_grid[::-1, 0, :]), axis=0)[::-1]  # (count + 1, 4)
        rows = [np.eye(4)]
        for n in range(1, _ORDER + 1):
            rows.append(matrix @ rows[-1] / n)
        self.series = np.array(rows)  # (order + 1, 4, 4): exp(A d) = sum series d^n
        self.position_series = np.ascontiguousarray(self.series[:, 0, :])  # (order + 1, 4)


class FreeFlight:
    """Tables of the position loop of one vehicle, from 0 to `horizon_s`."""

    def __init__(self, vehicle: VehicleConfig, horizon_s: float) -> None:
        self.loop = PositionLoop.from_px4(vehicle.px4)
        self.count = math.ceil(horizon_s / GRID_S / WINDOW) * WINDOW
        self.times: Array = GRID_S * np.arange(self.count + 1, dtype=np.float64)
        bx, by, _ = vehicle.airframe.drag_per_s
        self.axes = (
            _Axis(loop_matrix(self.loop, bx), self.count),
            _Axis(loop_matrix(self.loop, by), self.count),
        )

    def grid(self, leg: SetpointResponse) -> Grid:
        x, y = (np.ascontiguousarray(z.T, dtype=np.float32) for z in (leg.x, leg.y))
        goals = (leg.goal_x[:, None].astype(np.float32), leg.goal_y[:, None].astype(np.float32))
        return Grid(self, x, y, *goals)

    def at(self, leg: SetpointResponse, t_s: float) -> SetpointResponse:
        """Return the states of every candidate at a time after the start of the leg."""
        x, y = (expm(axis.matrix * t_s) @ z for axis, z in zip(self.axes, (leg.x, leg.y), strict=True))
        return SetpointResponse(x, y, leg.goal_x, leg.goal_y)

    def along(self, leg: SetpointResponse, times_s: Array) -> tuple[Array, Array]:
        """Return two arrays (n, 4): the first candidate's states along x and y at n times of the leg."""
        x, y = (
            expm(axis.matrix * times_s[:, None, None]) @ z[:, 0]
            for axis, z in zip(self.axes, (leg.x, leg.y), strict=True)
        )
        return x, y

    def near(self, leg: SetpointResponse, index: Rows) -> SeriesSolution:
        """Return the exact solutions about one grid point per candidate."""
        states: list[Array] = [
            np.einsum("njk,kn->jn", axis.at_grid[index], z)
            for axis, z in zip(self.axes, (leg.x, leg.y), strict=True)
        ]
        return SeriesSolution(self, leg, self.times[index], states[0], states[1])


class Grid(NamedTuple):
    """Legs of n candidates on the time grid, from initial states (n, 4) to setpoints (n, 1)."""

    flight: FreeFlight
    x: Array32
    y: Array32
    goal_x: Array32
    goal_y: Array32

    def select(self, rows: Rows | NDArray[np.bool_]) -> Grid:
        return Grid(self.flight, self.x[rows], self.y[rows], self.goal_x[rows], self.goal_y[rows])

    def window(self, first: int) -> GridWindow:
        """Return the grid points from `first` to `first + WINDOW`, including both."""
        ax, ay = self.flight.axes
        part = slice(first, first + WINDOW + 1)
        x, y = self.x @ ax.position[:, part], self.y @ ay.position[:, part]
        x += self.goal_x
        y += self.goal_y
        return GridWindow(
            self.flight.times[part], x, y, self.x @ ax.velocity[:, part], self.y @ ay.velocity[:, part]
        )

    def stays_before(self, normal: tuple[float, float], offset: float, index: int) -> NDArray[np.bool_]:
        """Return which candidates stay in front of the plane normal . p = offset from a grid point on."""
        ax, ay = self.flight.axes
        nearest = normal[0] * self.goal_x[:, 0] + normal[1] * self.goal_y[:, 0] - offset
        if normal[0]:
            nearest = nearest - np.abs(self.x) @ (abs(normal[0]) * ax.reach[index])
        if normal[1]:
            nearest = nearest - np.abs(self.y) @ (abs(normal[1]) * ay.reach[index])
        return np.asarray(nearest > _SINGLE_M)


class SeriesSolution:
    """The motion of each candidate near one of its grid points, as a power series in time."""

    def __init__(self, flight: FreeFlight, leg: SetpointResponse, times: Array, zx: Array, zy: Array) -> None:
        ax, ay = flight.axes
        self.times, self._flight, self._leg, self._zx, self._zy = times, flight, leg, zx, zy
        self.x = ax.position_series @ zx  # (order + 1, n)
        self.y = ay.position_series @ zy
        self.x[0] += leg.goal_x
        self.y[0] += leg.goal_y

    def along(self, direction: tuple[float, float]) -> Array:
        """Return coefficients (order + 1, n) of the position along a direction."""
        if direction[1] == 0.0:
            return direction[0] * self.x
        if direction[0] == 0.0:
            return direction[1] * self.y
        return direction[0] * self.x + direction[1] * self.y

    def leg_at(self, d: Array) -> SetpointResponse:
        """Return the states at `d` seconds after the grid point, with the same setpoints."""
        states = []
        for axis, z in zip(self._flight.axes, (self._zx, self._zy), strict=True):
            terms = (axis.series.reshape(-1, 4) @ z).reshape(_ORDER + 1, 4, -1)
            states += with_derivatives(terms, d, 0)
        return SetpointResponse(states[0], states[1], self._leg.goal_x, self._leg.goal_y)


def first_crossing(position: Array, lead_s: float, low: float, high: float) -> Array:
    """Return the time between `low` and `high` at which x + lead_s x' falls below 0.

    `position` contains the coefficients (order + 1, n) of x. All times count from the grid point.
    """
    g = position
    if lead_s:
        g = position.copy()
        g[:-1] += lead_s * np.arange(1, position.shape[0])[:, None] * position[1:]
    d = np.zeros(position.shape[1])
    for _ in range(_NEWTON_STEPS):
        value, slope = with_derivatives(g, d, 1)
        step = value / np.where(slope < 0.0, slope, -1.0)
        new = np.clip(d - step, low, high)
        done = bool((np.abs(new - d) <= 1e-9).all())
        d = new
        if done:
            break
    return d


def closest(
    x: Array, y: Array, goal: tuple[float, float], low: Array, high: Array
) -> tuple[Array, Array, tuple[Array, Array, Array, Array]]:
    """Return time, distance and state (x, y, vx, vy) of each candidate's closest approach to the goal.

    The results have the shape (n,). A time counts from the candidate's grid point, in seconds.

    Args:
        x, y: power series (order + 1, n) of the position about the grid point.
        low, high: range of the search: one grid step before and after the grid point. `low` is 0 if a flight
            begins at the grid point, and `high` is 0 if a flight ends there.
    """
    both = np.stack((x, y), axis=1)
    at = np.array(goal)[:, None]
    d = np.zeros(x.shape[1])
    for _ in range(_NEWTON_STEPS + 2):
        p, u, b = with_derivatives(both, d, 2)
        p -= at
        slope = (p * u).sum(axis=0)
        speed2 = (u * u).sum(axis=0)
        curve = speed2 + (p * b).sum(axis=0)
        # Far from the minimum the curvature may be negative; Gauss-Newton's curvature is never negative.
        step = slope / np.where(curve > 0.1 * speed2, np.where(curve > 0.0, curve, 1.0), speed2 + 1e-12)
        new = np.clip(d - step, low, high)
        done = bool((np.abs(new - d) <= 1e-8).all())
        d = new
        if done:
            break
    p, u = with_derivatives(both, d, 1)
    return d, np.hypot(p[0] - goal[0], p[1] - goal[1]), (p[0], p[1], u[0], u[1])
