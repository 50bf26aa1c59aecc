"""An independent rigid body that hits posts and wall ends, integrated by SciPy between events.

World axes: north, west, up. Body axes: forward, left, up. Rotations are matrices, Qhull gives the outline,
and the equilibrium of a bar on two springs is solved for. The integrator finds the events at which the
contact memory changes. Nothing of the package is used.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.spatial import ConvexHull

from tests.oracles.rigid_body import Body, Law, guards

Array = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])
NUDGE_S = 1e-7  # step past an event
EDGE_RADIUS_M = 0.01


class Board(NamedTuple):
    """A wall: the middle of its surface, its outward normal (level), half its length."""

    middle: Array
    normal: Array
    half_length: float

    @property
    def along(self) -> Array:
        return np.cross(UP, self.normal)

    def pillars(self) -> list[Pillar]:
        """Return the two edges of the wall."""
        axis = self.middle - EDGE_RADIUS_M * self.normal
        return [Pillar((axis + side * self.half_length * self.along)[:2], EDGE_RADIUS_M) for side in (-1, 1)]


class Pillar(NamedTuple):
    """A post or an edge, seen from above."""

    centre: Array  # (2,)
    radius: float


class Nearest(NamedTuple):
    gap: float
    normal: Array
    pair: tuple[int, int]
    weights: tuple[float, float]
    share: float


def spring_share(s: float) -> float:
    """Return the stiffness of a rigid bar on two springs, pressed at `s`, relative to both springs."""
    # Unknowns: deflections d1, d2 and the force. Forces and moments balance; the pressed point moves by 1.
    equations = np.array([[0.5, 0.5, -1.0], [0.0, 0.5, -s], [1.0 - s, s, 0.0]])
    return float(np.linalg.solve(equations, np.array([0.0, 0.0, 1.0]))[2])


def nearest(points: Array, pillar: Pillar) -> Nearest:
    """Return the point of the horizontal hull of `points` (n, 3) closest to a pillar, or deepest in it."""
    flat = points[:, :2]
    hull = ConvexHull(flat)
    out = hull.equations[:, :2]
    heights = out @ pillar.centre + hull.equations[:, 2]
    ends = flat[hull.simplices]
    line = ends[:, 1] - ends[:, 0]
    s = np.einsum("ij,ij->i", pillar.centre - ends[:, 0], line) / np.einsum("ij,ij->i", line, line)
    s = np.clip(s, 0.0, 1.0)
    feet = ends[:, 0] + s[:, None] * line
    distances = np.linalg.norm(feet - pillar.centre, axis=1)
    i = int(np.argmin(distances))
    first, second = (int(n) for n in hull.simplices[i])
    if 0.0 < s[i] < 1.0:
        gap, normal = heights[i], -out[i]
    else:
        gap, normal = distances[i], (feet[i] - pillar.centre) / distances[i]
    return Nearest(
        float(gap) - pillar.radius,
        np.append(normal, 0.0),
        (first, second),
        (1.0 - s[i], s[i]),
        spring_share(float(s[i])),
    )


class Scene:
    """A body, the obstacles that it may hit, and the memory of their contacts."""

    def __init__(self, body: Body, law: Law, board: Board | None, posts: list[Pillar]) -> None:
        self.body, self.law, self.board = body, law, board
        self.pillars = posts + (board.pillars() if board is not None else [])
        self.edges = range(len(posts), len(self.pillars))
        self.at, self.rub_at = guards(body)
        self.share: dict[int, float] = {}
        self.ignored_edges: set[int] = set()
        self.guards_past_end: set[int] = set()

    def _split(self, y: Array) -> tuple[Array, Array, Array, Array]:
        return y[:3], y[3:6], y[6:15].reshape(3, 3), y[15:]

    def _facing(self, y: Array) -> tuple[Array, Array, Array]:
        """Return each guard's distance from the board, its position along it, and its demand k x + f v."""
        x, v, r, w = self._split(y)
        assert self.board is not None
        away = x + self.at @ r.T - self.board.middle
        speed = v + np.cross(r @ w, self.at @ r.T)
        height = away @ self.board.normal
        demand = self.law.k * height + self.law.f * (speed @ self.board.normal)
        return height, away @ self.board.along, demand

    def _guards_on_face(self, y: Array) -> list[int]:
        if self.board is None:
            return []
        _, foot, demand = self._facing(y)
        return [
            i
            for i in range(len(self.at))
            if abs(foot[i]) <= self.board.half_length and i not in self.guards_past_end and demand[i] < 0.0
        ]

    def _pillar_demand(self, y: Array, number: int) -> tuple[Nearest, float]:
        x, v, r, w = self._split(y)
        one = nearest(x + self.at @ r.T, self.pillars[number])
        (a, b), (p, q) = one.pair, one.weights
        lever = r @ (p * self.at[a] + q * self.at[b])
        speed = float(one.normal @ (v + np.cross(r @ w, lever)))
        return one, self.law.k * one.gap + self.law.f * speed

    def remember(self, y: Array) -> None:
        """Update the contact memory with a state just after an event."""
        if self.board is not None:
            height, foot, _ = self._facing(y)
            for i in range(len(self.at)):
                if height[i] > 0.0:
                    self.guards_past_end.discard(i)
                elif abs(foot[i]) > self.board.half_length:
                    self.guards_past_end.add(i)
        pressed = set(self._guards_on_face(y))
        for number in range(len(self.pillars)):
            one, demand = self._pillar_demand(y, number)
            bearing = {n for n, weight in zip(one.pair, one.weights, strict=True) if weight > 0.0}
            if one.gap > 0.0:
                self.ignored_edges.discard(number)
            if number in self.edges and pressed & bearing:
                self.share.pop(number, None)
                if one.gap <= 0.0:
                    self.ignored_edges.add(number)
            elif number not in self.ignored_edges:
                if demand < 0.0:
                    self.share.setdefault(number, one.share)
                elif one.gap > 0.0:
                    self.share.pop(number, None)

    def slope(self, _: float, y: Array) -> Array:
        v, r, w = self._split(y)[1:]
        turning = r @ w
        pushes: list[tuple[float, Array, Array, Array]] = []
        if self.board is not None:
            demands = self._facing(y)[2]
            for i in self._guards_on_face(y):
                on_guard = -0.5 * float(demands[i])
                pushes.append((on_guard, self.board.normal, r @ self.at[i], r @ self.rub_at[i]))
        pressed = set(self._guards_on_face(y))
        for number, share in self.share.items():
            one, demand = self._pillar_demand(y, number)
            (a, b), (p, q) = one.pair, one.weights
            if demand < 0.0 and not (number in self.edges and pressed & {a, b} and 0.0 < p < 1.0):
                lever, rub_lever = (r @ (p * at[a] + q * at[b]) for at in (self.at, self.rub_at))
                pushes.append((-share * demand, one.normal, lever, rub_lever))
        total = sum(push for push, *_ in pushes)
        force, torque = np.zeros(3), np.zeros(3)
        for push, normal, lever, rub_lever in pushes:
            along = np.cross(normal, UP)
            rub = -self.law.mu * push * float(along @ (v + np.cross(turning, rub_lever))) * along
            lift = -self.law.vertical_sign * self.law.nu * push / (1.0 + total) * UP
            force += push * normal + rub + lift
            torque += np.cross(lever, push * normal) + np.cross(rub_lever, rub)
            torque += np.cross(-self.body.vertical_lever * normal, lift)
        inertia = self.body.inertia
        spin = (r.T @ torque - np.cross(w, inertia * w)) / inertia
        turn = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
        return np.concatenate((v, force / self.body.mass, (r @ turn).ravel(), spin))

    def _watched(self, y: Array) -> Array:
        """Return all quantities whose sign change is an event."""
        found: list[float] = []
        if self.board is not None:
            height, foot, demands = self._facing(y)
            found += [*height.tolist(), *(np.abs(foot) - self.board.half_length).tolist(), *demands.tolist()]
        for number in range(len(self.pillars)):
            one, demand = self._pillar_demand(y, number)
            found += [one.gap, demand]
        return np.array(found)

    def fly(self, y: Array, duration_s: float) -> Array:
        """Return the state after `duration_s`: position, velocity, rotation matrix (by rows), body rate."""
        t = 0.0
        self.remember(y)
        cached, values = y, self._watched(y)

        def watched(z: Array, number: int) -> float:
            nonlocal cached, values
            if z is not cached:  # the integrator evaluates every event at the same state
                cached, values = z, self._watched(z)
            return float(values[number])

        while t < duration_s:
            events = [lambda _, z, i=i: watched(z, i) for i in range(len(values))]
            for event in events:
                event.terminal = True  # type: ignore[attr-defined]
            part = solve_ivp(
                self.slope,
                (t, duration_s),
                y,
                method="DOP853",
                rtol=1e-8,
                atol=1e-10,
                max_step=5e-3,
                events=events,
            )
            t, y = float(part.t[-1]), part.y[:, -1]
            if part.status == 1:
                t, y = t + NUDGE_S, y + NUDGE_S * self.slope(t, y)
                self.remember(y)
        return y
