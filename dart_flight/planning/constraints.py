"""Constraints of a plan: the reasons to refuse a candidate, and their tests.

The tests apply the limits of the mission file and the rules of the core (`core.mission`, `core.guard`), so
that the core does not abort a plan in flight. Most tests return refusal codes: `CODE`, or 0 for an accepted
candidate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dart_flight.base.arithmetic import Number
from dart_flight.base.geometry import GRAVITY_M_S2, Vec2
from dart_flight.base.walls import Post, Wall
from dart_flight.contact.coefficients import Array
from dart_flight.core.mission.commitment import (
    SETPOINT_OUTSIDE_M,
    SETTLED_BEFORE_S,
    STOP_MARGIN_M,
    is_acceptable_in_either_mode,
    setpoint_outside_m,
)
from dart_flight.core.mission.position_loop import ATTITUDE_LAG_S, STOP_TIME_S, least_distance_m, stop_share
from dart_flight.core.mission.wall_uncertainty import spans_with_margin
from dart_flight.planning.flight_model import GridWindow, SetpointResponse
from dart_flight.planning.task import Task

Codes = NDArray[np.int8]

MIN_REBOUND_M_S = 0.05
# A wall counts as touched if the vehicle would reach the plane within this time. With the onset rule `lcp`,
# the force begins before the plane.
_TOUCH_S = 0.01
_THICK_M = 0.5  # a vehicle farther behind the plane is on the wall's other side
_LOCK_POLL_S = 0.02


class Refusal(StrEnum):
    """Reasons to refuse a candidate, in the order of the tests."""

    APPROACH_SPEED = "approach_speed"
    BEYOND_WALL = "beyond_wall"
    RUN_UP_ROOM = "run_up_room"
    RUN_UP_BLOCKED = "run_up_blocked"
    NOT_DETECTED = "not_detected"
    PEAK_FORCE = "peak_force"
    CLOSING = "closing"
    SLIDING = "sliding"
    FRICTION = "friction"
    NO_REBOUND = "no_rebound"
    SETPOINT = "setpoint"
    ACCELERATION = "acceleration"
    SPEED = "speed"
    BOUNDS = "bounds"
    OBSTACLE = "obstacle"
    WALL_NOT_REACHED = "wall_not_reached"
    INCIDENCE = "incidence"
    TOO_SOON = "too_soon"
    SERVO_TRAVEL = "servo_travel"


REFUSALS = tuple(Refusal)
CODE = {reason: i + 1 for i, reason in enumerate(REFUSALS)}


class Constraints:
    """The tests of one task, vectorised over candidates.

    The tests skip the reasons in `ignored`. A caller can thereby find out which reasons prevent a plan.
    """

    def __init__(
        self, task: Task, ignored: frozenset[Refusal] = frozenset(), posts: tuple[Post, ...] = ()
    ) -> None:
        self._ignored, self._posts = ignored, posts
        self.bounds, self.limits = task.bounds, task.limits
        self.walls = tuple(task.walls.values())
        vehicle = self._vehicle = task.vehicle
        self._alphas = task.alphas
        self.threshold_n = vehicle.detection.force_threshold_n
        self.refractory_s = vehicle.detection.refractory_s
        self.most_acceleration = GRAVITY_M_S2 * math.tan(math.radians(vehicle.px4.mpc_tiltmax_air))
        lock = vehicle.lock
        self.lock_s = lock.relaxation_s + lock.switch_time_s + _LOCK_POLL_S if lock else 0.0
        self._corner_m = vehicle.airframe.corner_m  # reach of the guards' corners, which may touch a post
        self._reach = _reach_tables(task)

    def mark(
        self, codes: Codes, where: NDArray[np.bool_] | NDArray[np.intp] | np.bool_, reason: Refusal
    ) -> None:
        if reason not in self._ignored:
            codes[where] = CODE[reason]

    def hit(
        self, velocity: tuple[Array, Array], normal_n: Array, tangential_n: Array, rebound_m_s: Array
    ) -> Codes:
        """Check each impact, given its velocity at the onset and its normal velocity after the contact."""
        codes, limits = np.zeros(normal_n.shape, dtype=np.int8), self.limits
        normal, tangential = velocity
        if limits.closing_m_s is not None:
            self.mark(codes, -normal > limits.closing_m_s, Refusal.CLOSING)
        if limits.sliding_m_s is not None:
            self.mark(codes, np.abs(tangential) > limits.sliding_m_s, Refusal.SLIDING)
        if limits.friction_ratio is not None:
            self.mark(codes, np.abs(tangential_n) > limits.friction_ratio * normal_n, Refusal.FRICTION)
        self.mark(codes, ~(rebound_m_s >= MIN_REBOUND_M_S), Refusal.NO_REBOUND)
        self.mark(codes, np.hypot(normal_n, tangential_n) > self.limits.peak_force_n, Refusal.PEAK_FORCE)
        self.mark(codes, normal_n < self.threshold_n, Refusal.NOT_DETECTED)
        return codes

    def command(self, leg: SetpointResponse, loop: tuple[float, float, float, float, float]) -> Codes:
        """Check each recovery by its setpoint and first command.

        The recovery setpoint may lie at most `SETPOINT_OUTSIDE_M` outside the bounds. The command must be
        within PX4's tilt limit, because the linear model does not hold beyond this limit.
        """
        kp, kv, _, kd, _ = loop
        ax = kv * (-kp * leg.x[0] - leg.x[1]) + leg.x[3] - kd * leg.x[2]
        ay = kv * (-kp * leg.y[0] - leg.y[1]) + leg.y[3] - kd * leg.y[2]
        codes = np.zeros(leg.size, dtype=np.int8)
        self.mark(codes, ax * ax + ay * ay > self.most_acceleration**2, Refusal.ACCELERATION)
        outside_m = setpoint_outside_m(self.bounds, leg.goal_x, leg.goal_y)
        self.mark(codes, outside_m > SETPOINT_OUTSIDE_M, Refusal.SETPOINT)
        return codes

    def path(
        self,
        window: GridWindow,
        until: NDArray[np.intp],
        target: Wall | None,
        begins: bool,
        walls: Sequence[Wall] | None = None,
    ) -> Codes:
        """Check each flight against the walls, posts, bounds and speed limit.

        Args:
            until: first grid index that is not checked, for each candidate.
            target: the next wall or post that the plan hits; it is no obstacle.
            begins: whether the first grid point is the release from a wall.
            walls: estimated walls, or None to use the mission's walls.
        """
        w = window
        bad = w.vx * w.vx + w.vy * w.vy > np.float32(self.limits.speed_m_s**2)
        bad |= _outside(self.bounds.x, w.x, w.vx)
        bad |= _outside(self.bounds.y, w.y, w.vy)
        # Compare by name: the planner's process has decoded the mission, so equal walls are separate objects.
        walls = self.walls if walls is None else walls
        obstacles = [wall for wall in walls if target is None or wall.name != target.name]
        for wall in obstacles:
            bad |= _touches_wall(wall, w)
        posts = [post for post in self._posts if target is None or post.name != target.name]
        for post in posts:
            bad |= _hits_post(post, self._corner_m, w)
        bad &= np.arange(w.times.size) < until[:, None]
        codes = np.zeros(until.size, dtype=np.int8)
        rows = np.flatnonzero(bad.any(axis=1))
        if rows.size:  # find the reason only for the few candidates that fail
            part = GridWindow(w.times, *(v[rows] for v in (w.x, w.y, w.vx, w.vy)))
            codes[rows] = self._classify(part, until[rows], obstacles, posts, begins)
        return codes

    def _classify(
        self, w: GridWindow, until: NDArray[np.intp], obstacles: list[Wall], posts: list[Post], begins: bool
    ) -> Codes:
        codes = np.zeros(until.size, dtype=np.int8)
        alive = np.arange(w.times.size) < until[:, None]
        over = w.vx * w.vx + w.vy * w.vy > self.limits.speed_m_s**2
        self.mark(codes, (over & alive).any(axis=1), Refusal.SPEED)
        self.mark(codes, (self._leaves_bounds(w) & alive).any(axis=1), Refusal.BOUNDS)
        if begins:
            alive[:, 0] = False
        for wall in obstacles:
            place: tuple[Number, Number] = (w.x, w.y)
            # Count only a passage through the front. A point farther behind the plane is beyond the wall.
            inside = wall.signed_distance(place) > -min(_THICK_M, wall.behind_m)
            touched = _touches_wall(wall, w) & spans_with_margin(wall, place) & inside
            self.mark(codes, (touched & alive).any(axis=1), Refusal.OBSTACLE)
        for post in posts:
            self.mark(codes, (_hits_post(post, self._corner_m, w) & alive).any(axis=1), Refusal.OBSTACLE)
        return codes

    def _leaves_bounds(self, w: GridWindow) -> NDArray[np.bool_]:
        """Return the grid points at which the vehicle is outside the bounds or could not stop inside them.

        If a wall ahead stops the vehicle earlier, the stopping distance is shorter (`stop_share`). The core's
        guard (`core.guard`) applies the same rule.
        """
        share = stop_share(self.walls, (w.x, w.y), (w.vx, w.vy))
        leaves = _outside(self.bounds.x, w.x, share * w.vx)
        leaves |= _outside(self.bounds.y, w.y, share * w.vy)
        return leaves

    def last_setpoint(self, leg: SetpointResponse, hit: Wall) -> Codes:
        """Refuse each candidate whose last recovery setpoint is behind another wall than the one hit."""
        codes = np.zeros(leg.size, dtype=np.int8)
        place, target = (leg.x[0] + leg.goal_x, leg.y[0] + leg.goal_y), (leg.goal_x, leg.goal_y)
        for wall in self.walls:
            if wall.name != hit.name:
                self.mark(codes, leads_behind(wall, place, target), Refusal.SETPOINT)
        return codes

    def to_goal(self, x: Array, y: Array, goal: Vec2) -> Codes:
        """Refuse each candidate that has a wall between its closest approach (x, y) and the goal."""
        codes = np.zeros(x.shape, dtype=np.int8)
        closest: tuple[Number, Number] = (x, y)
        for wall in self.walls:
            here, there = wall.signed_distance(closest), wall.signed_distance(goal)
            # Just after the release the vehicle may still be slightly behind the plane.
            crosses = (here > 0.0) if there < 0.0 else (here < -min(_THICK_M, wall.behind_m))
            _, place = wall.crossing(closest, goal)
            self.mark(codes, crosses & spans_with_margin(wall, place), Refusal.OBSTACLE)
        return codes

    def lock_in_time(self, leg: SetpointResponse, wall: Wall) -> NDArray[np.bool_]:
        """Return, for each state, whether a command to hold position would stop the vehicle before the wall.

        The executive uses the same prediction (`least_distance_m`).
        """
        nx, ny = wall.normal
        distance = wall.signed_distance((leg.x[0] + leg.goal_x, leg.y[0] + leg.goal_y))
        closing = -(nx * leg.x[1] + ny * leg.y[1])
        pushing = -(nx * leg.x[2] + ny * leg.y[2])
        size = np.maximum(closing, 0.0) + ATTITUDE_LAG_S * np.abs(pushing) + 1e-12
        share = np.maximum(closing, 0.0) / size
        towards, away, knots = self._reach
        reach = size * np.where(
            pushing > 0.0, np.interp(share, knots, towards), np.interp(share, knots, away)
        )
        in_time: NDArray[np.bool_] = distance - reach >= STOP_MARGIN_M
        in_time |= (closing <= 0.0) & (distance > 0.0)
        return in_time

    def lock_too_late(
        self, ready: SetpointResponse, impact: SetpointResponse, after_s: Array, wall: Wall
    ) -> NDArray[np.bool_]:
        """Return whether the executive would abort the approach because the lock is still moving.

        `ready` contains the states at the time at which the lock has settled; `after_s` is the time from the
        release to the impact.
        """
        late = after_s < self.lock_s
        rows = np.flatnonzero(~late & ~self.lock_in_time(ready, wall))
        if rows.size:
            at = impact.select(rows)
            (nx, ny), (tx, ty) = wall.normal, wall.tangent
            bearable = is_acceptable_in_either_mode(
                self._vehicle,
                self.limits,
                self.bounds,
                wall,
                self._alphas[wall.name],
                (at.x[0] + at.goal_x, at.y[0] + at.goal_y),
                (nx * at.x[1] + ny * at.y[1], tx * at.x[1] + ty * at.y[1]),
            )
            late[rows] = ~(bearable & (after_s[rows] >= self.lock_s + SETTLED_BEFORE_S))
        return late


def leads_behind(wall: Wall, place: tuple[Number, Number], target: tuple[Number, Number]) -> Number:
    """Return whether `target` is behind a wall and `place` in front of it; coordinates may be arrays."""
    crosses = (wall.signed_distance(place) > 0.0) & (wall.signed_distance(target) <= 0.0)
    return crosses & spans_with_margin(wall, target)


def _outside(limits: tuple[float, float], x: NDArray[Any], v: NDArray[Any]) -> NDArray[np.bool_]:
    """Return whether the vehicle is outside the limits of a coordinate, or cannot stop within them."""
    stop = x + np.float32(STOP_TIME_S) * v
    outside: NDArray[np.bool_] = np.minimum(x, stop) < np.float32(limits[0])
    outside |= np.maximum(x, stop) > np.float32(limits[1])
    return outside


def _touches_wall(wall: Wall, w: GridWindow) -> NDArray[np.bool_]:
    """Return whether the vehicle has passed the plane of a wall, or will pass it within `_TOUCH_S`."""
    (nx, ny), (px, py) = wall.normal, wall.point
    soon, offset = np.float32(_TOUCH_S), np.float32(nx * px + ny * py)
    depth: NDArray[Any]
    if ny == 0.0:
        depth = np.float32(nx) * (w.x + soon * w.vx)
    elif nx == 0.0:
        depth = np.float32(ny) * (w.y + soon * w.vy)
    else:
        depth = np.float32(nx) * (w.x + soon * w.vx) + np.float32(ny) * (w.y + soon * w.vy)
    touches: NDArray[np.bool_] = depth < offset
    return touches


def _hits_post(post: Post, corner_m: float, w: GridWindow) -> NDArray[np.bool_]:
    """Return whether the vehicle moves towards a post that is within the reach of the vehicle's corners.

    The path between two grid points is treated as a straight line, because the points may be farther apart
    than the post is wide.
    """
    x, y = w.x - np.float32(post.centre[0]), w.y - np.float32(post.centre[1])
    reach2 = np.float32((post.radius_m + corner_m) ** 2)
    comes = x * w.vx + y * w.vy < 0.0
    meets: NDArray[np.bool_] = comes & (x * x + y * y < reach2)
    dx, dy = np.diff(x, axis=1), np.diff(y, axis=1)
    x, y = x[:, :-1], y[:, :-1]
    share = np.clip(-(x * dx + y * dy) / np.maximum(dx * dx + dy * dy, np.float32(1e-12)), 0.0, 1.0)
    meets[:, 1:] |= comes[:, :-1] & ((x + share * dx) ** 2 + (y + share * dy) ** 2 < reach2)
    return meets


def _reach_tables(task: Task) -> tuple[Array, Array, Array]:
    """Return tables of the braking distance for `lock_in_time`, computed by the executive's rule.

    The braking distance is proportional to the sum of the speed and of `ATTITUDE_LAG_S` times the magnitude
    of the acceleration. The tables give the braking distance at which this sum is 1 m/s. The first table
    holds for an acceleration towards the wall, the second for an acceleration away from the wall. Both tables
    are functions of the speed's fraction of this sum, which the third array lists.
    """
    knots = np.linspace(0.0, 1.0, 41)
    far = 100.0
    tables = []
    for sign in (1.0, -1.0):
        tables.append(
            [
                far - least_distance_m(far, s, sign * (1.0 - s) / ATTITUDE_LAG_S, far, task.vehicle.px4)
                for s in knots
            ]
        )
    return np.array(tables[0]), np.array(tables[1]), knots
