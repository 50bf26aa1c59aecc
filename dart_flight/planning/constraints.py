"""What a plan may not do: the reasons to refuse a candidate, and the tests behind them.

The rules are those that the executive and the guard hold in flight (`dart_flight.flight`), so that a plan is
not broken off by them, and what the mission file limits.
"""

from __future__ import annotations

import math
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from dart_flight.config.scenario import Scenario
from dart_flight.geometry import GRAVITY_M_S2, Wall
from dart_flight.planning.closed_loop import least_distance_m
from dart_flight.planning.flight_model import Leg, Window

Array = NDArray[np.float64]
Codes = NDArray[np.int8]

STOP_TIME_S = 0.5  # the guard's: PX4's loop stops within about half a second of way
STOP_MARGIN_M = 0.02  # the executive's, of "holding still stops short of the wall"
LEAST_REBOUND_M_S = 0.05
# A wall counts as touched when it would be reached within this time: forces begin before the plane (`lcp`).
_TOUCH_S = 0.01
_LOCK_POLL_S = 0.02


class Refusal(StrEnum):
    """Why a candidate is refused; in the order in which the tests come."""

    APPROACH_SPEED = "approach_speed"
    BEYOND_WALL = "beyond_wall"
    RUN_UP_ROOM = "run_up_room"
    RUN_UP_BLOCKED = "run_up_blocked"
    NOT_DETECTED = "not_detected"
    PEAK_FORCE = "peak_force"
    NO_REBOUND = "no_rebound"
    ACCELERATION = "acceleration"
    SPEED = "speed"
    BOUNDS = "bounds"
    OBSTACLE = "obstacle"
    WALL_NOT_REACHED = "wall_not_reached"
    TOO_SOON = "too_soon"
    SERVO_TRAVEL = "servo_travel"


REFUSALS = tuple(Refusal)
CODE = {reason: i + 1 for i, reason in enumerate(REFUSALS)}

ADVICE = {
    Refusal.APPROACH_SPEED: "raise limits.speed_m_s or search slower approaches",
    Refusal.BEYOND_WALL: "lengthen the wall, move start, or search less tangential velocity",
    Refusal.RUN_UP_ROOM: "widen bounds_m, move start back, or search slower approaches",
    Refusal.RUN_UP_BLOCKED: "move the wall that stands in the way of the run-up, or start",
    Refusal.NOT_DETECTED: "lower detection.force_threshold_n or search faster approaches",
    Refusal.PEAK_FORCE: "raise limits.peak_force_n, search slower approaches or the flexible mode",
    Refusal.NO_REBOUND: "search faster approaches or the rigid mode",
    Refusal.ACCELERATION: "lower the wall's alpha or raise MPC_TILTMAX_AIR",
    Refusal.SPEED: "raise limits.speed_m_s or lower the wall's alpha",
    Refusal.BOUNDS: "widen bounds_m or lower the wall's alpha",
    Refusal.OBSTACLE: "move or shorten the wall in the way, or put it into sequence",
    Refusal.WALL_NOT_REACHED: "raise the alpha of the wall before it, move the wall nearer, or lengthen it",
    Refusal.TOO_SOON: "move the walls apart or lower detection.refractory_s",
    Refusal.SERVO_TRAVEL: "allow the same mode at both walls, a faster servo, or more way between the walls",
}


class Constraints:
    """The tests of one scenario, vectorised over candidates.

    Args:
        scenario: limits, bounds, walls.
        ignored: reasons that do not count, to find out which of them stand in the way.
    """

    def __init__(self, scenario: Scenario, ignored: frozenset[Refusal] = frozenset()) -> None:
        self._ignored = ignored
        self.bounds, self.limits = scenario.bounds, scenario.limits
        self.walls = tuple(scenario.walls.values())
        vehicle = scenario.vehicle
        self.threshold_n = vehicle.detection.force_threshold_n
        self.refractory_s = vehicle.detection.refractory_s
        self.most_acceleration = GRAVITY_M_S2 * math.tan(math.radians(vehicle.px4.mpc_tiltmax_air))
        self.lock_s = vehicle.lock.relaxation_s + vehicle.lock.switch_time_s + _LOCK_POLL_S
        self._reach = _reach_tables(scenario)

    def mark(self, codes: Codes, where: NDArray[np.bool_] | NDArray[np.intp], reason: Refusal) -> None:
        """Refuse some candidates."""
        if reason not in self._ignored:
            codes[where] = CODE[reason]

    def hit(self, normal_n: Array, tangential_n: Array, rebound_m_s: Array) -> Codes:
        """Codes (0: fine) for the peaks and the outward speed of a hit."""
        codes = np.zeros(normal_n.shape, dtype=np.int8)
        self.mark(codes, ~(rebound_m_s >= LEAST_REBOUND_M_S), Refusal.NO_REBOUND)
        self.mark(codes, np.hypot(normal_n, tangential_n) > self.limits.peak_force_n, Refusal.PEAK_FORCE)
        self.mark(codes, normal_n < self.threshold_n, Refusal.NOT_DETECTED)
        return codes

    def command(self, leg: Leg, loop: tuple[float, float, float, float, float]) -> Codes:
        """Whether the first command of a recovery is within PX4's tilt limit, where the model is linear."""
        kp, kv, _, kd, _ = loop
        ax = kv * (-kp * leg.x[0] - leg.x[1]) + leg.x[3] - kd * leg.x[2]
        ay = kv * (-kp * leg.y[0] - leg.y[1]) + leg.y[3] - kd * leg.y[2]
        codes = np.zeros(leg.size, dtype=np.int8)
        self.mark(codes, ax * ax + ay * ay > self.most_acceleration**2, Refusal.ACCELERATION)
        return codes

    def path(self, window: Window, until: NDArray[np.intp], target: Wall | None, begins: bool) -> Codes:
        """What a piece of flight runs into before its grid index `until` (exclusive).

        Args:
            window: positions and velocities.
            until: per candidate.
            target: the wall that the plan hits next, no obstacle.
            begins: whether the first grid point is the release from a wall.
        """
        w, low, high = window, self.bounds, self.bounds
        alive = np.arange(w.times.size) < until[:, None]
        codes = np.zeros(until.size, dtype=np.int8)
        over = w.vx * w.vx + w.vy * w.vy > self.limits.speed_m_s**2
        self.mark(codes, (over & alive).any(axis=1), Refusal.SPEED)
        sx, sy = w.x + STOP_TIME_S * w.vx, w.y + STOP_TIME_S * w.vy
        out = (
            (np.minimum(w.x, sx) < low.x[0])
            | (np.maximum(w.x, sx) > high.x[1])
            | (np.minimum(w.y, sy) < low.y[0])
            | (np.maximum(w.y, sy) > high.y[1])
        )
        out &= alive
        suspects = np.flatnonzero(out.any(axis=1))
        if suspects.size:
            self.mark(codes, suspects[self._leaves(w, out, suspects)], Refusal.BOUNDS)
        if begins:
            alive[:, 0] = False
        for wall in self.walls:
            if wall is target:
                continue
            (nx, ny), (px, py) = wall.normal, wall.point
            depth = nx * (w.x - px + _TOUCH_S * w.vx) + ny * (w.y - py + _TOUCH_S * w.vy)
            touched = (depth < 0.0) & alive
            rows = np.flatnonzero(touched.any(axis=1))
            if rows.size:
                tx, ty = wall.tangent
                along = tx * (w.x[rows] - px) + ty * (w.y[rows] - py)
                # Behind a wall is not in it: only passing through its front counts.
                near = (np.abs(along) <= 0.5 * wall.length_m) & (depth[rows] > -0.5)
                self.mark(codes, rows[(touched[rows] & near).any(axis=1)], Refusal.OBSTACLE)
        return codes

    def _leaves(self, w: Window, out: NDArray[np.bool_], rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Whether rows that may leave the bounds do: a wall in the way stops a vehicle earlier (guard)."""
        x, y, vx, vy = (v[rows] for v in (w.x, w.y, w.vx, w.vy))
        share = np.ones_like(x)
        for wall in self.walls:
            (nx, ny), (px, py) = wall.normal, wall.point
            here = nx * (x - px) + ny * (y - py)
            there = here + STOP_TIME_S * (nx * vx + ny * vy)
            tx, ty = wall.tangent
            spans = np.abs(tx * (x - px) + ty * (y - py)) <= 0.5 * wall.length_m
            stops = (here > there) & (there < 0.0) & (here > -0.3) & spans
            way = np.where(stops, here - there, 1.0)
            share = np.where(stops, np.minimum(share, np.maximum(here / way, 0.0)), share)
        sx, sy = x + share * STOP_TIME_S * vx, y + share * STOP_TIME_S * vy
        b = self.bounds
        leaves = (np.minimum(x, sx) < b.x[0]) | (np.maximum(x, sx) > b.x[1])
        leaves |= (np.minimum(y, sy) < b.y[0]) | (np.maximum(y, sy) > b.y[1])
        return np.asarray((leaves & out[rows]).any(axis=1))

    def lock_in_time(self, leg: Leg, wall: Wall) -> NDArray[np.bool_]:
        """Whether holding still at these states still stops short of the wall (executive)."""
        nx, ny = wall.normal
        distance = nx * (leg.x[0] + leg.goal_x - wall.point[0]) + ny * (leg.y[0] + leg.goal_y - wall.point[1])
        closing = -(nx * leg.x[1] + ny * leg.y[1])
        pushing = -(nx * leg.x[2] + ny * leg.y[2])
        size = np.maximum(closing, 0.0) + self._lag * np.abs(pushing) + 1e-12
        share = np.maximum(closing, 0.0) / size
        towards, away, knots = self._reach
        reach = size * np.where(pushing > 0.0, np.interp(share, knots, towards), np.interp(share, knots, away))
        return (distance - reach >= STOP_MARGIN_M) | ((closing <= 0.0) & (distance > 0.0))

    _lag = 0.15


def _reach_tables(scenario: Scenario) -> tuple[Array, Array, Array]:
    """Braking way by the executive's own rule; it is homogeneous in speed and acceleration."""
    knots = np.linspace(0.0, 1.0, 41)
    far = 100.0
    tables = []
    for sign in (1.0, -1.0):
        tables.append(
            [
                far
                - least_distance_m(
                    far, s, sign * (1.0 - s) / Constraints._lag, far, scenario.vehicle.px4
                )
                for s in knots
            ]
        )
    return np.array(tables[0]), np.array(tables[1]), knots
