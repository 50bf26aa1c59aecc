"""The flight of many candidates through one sequence of walls: approach, contact, recovery, ..., goal.

All candidates of a sequence, in all modes, are computed together, one leg after the other, in few long arrays
instead of many short ones. Candidates that fail are removed and counted by reason. Approaches are computed by
`approach_grid`, contacts by `contact_stage`, and the flights between contacts by `flight_model`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from dart_flight.base.geometry import Vec2
from dart_flight.base.records import Mode
from dart_flight.base.walls import Wall
from dart_flight.core.mission.recovery import PASSED_AFTER_S, PASSED_RISE_M
from dart_flight.core.mission.wall_uncertainty import end_margin_m
from dart_flight.planning.approach_grid import ApproachGrid, approach_grid
from dart_flight.planning.constraints import CODE, REFUSALS, Constraints, Refusal
from dart_flight.planning.contact_stage import (
    ContactStage,
    NormalOut,
    TangentialOut,
    TangentialShape,
    build_stages,
)
from dart_flight.planning.envelope import max_incidence_deg
from dart_flight.planning.flight_model import (
    GRID_S,
    WINDOW,
    Array,
    FreeFlight,
    Rows,
    SetpointResponse,
    closest,
    first_crossing,
)
from dart_flight.planning.task import Task, drag_along

_HORIZON_S = 6.0  # events are searched up to this time, when the position loop has settled
MIN_FACTOR = 0.1  # smallest ratio of a drawn coefficient to its nominal value
Outcome = TypeVar("Outcome", NormalOut, TangentialOut)
Stages = dict[tuple[str, Mode], ContactStage]


class PredictedContacts(NamedTuple):
    """The contacts of n candidates with one wall of the sequence; arrays (n,).

    Attributes:
        t_s: time from the start of the run-up to the onset.
        x, y: position at the onset, mission frame.
        normal_m_s, tangential_m_s: velocity at the onset, collision frame.
        normal_n, tangential_n: peaks of the normal and of the friction force.
        duration_s: duration of the contact.
        leg: state at the release and recovery setpoint, as the initial values of the following flight.
    """

    wall: Wall
    t_s: Array
    x: Array
    y: Array
    normal_m_s: Array
    tangential_m_s: Array
    normal_n: Array
    tangential_n: Array
    duration_s: Array
    leg: SetpointResponse

    @property
    def peak_force_n(self) -> Array:
        return np.hypot(self.normal_n, self.tangential_n)

    def select(self, rows: Rows | NDArray[np.bool_]) -> PredictedContacts:
        return PredictedContacts._make((self.wall, *(v[rows] for v in self[1:-1]), self.leg.select(rows)))


class Arrivals(NamedTuple):
    """Candidates that have completed the sequence and approach the goal; arrays (n,).

    Attributes:
        rows: index of the approach.
        modes: mode of each collision, the same for all candidates.
        miss_m: smallest distance to the goal after the last contact.
        t_s: time from the start of the run-up to the closest approach to the goal.
        force_n: largest peak force of all collisions.
        x, y, vx, vy: state at the closest approach.
        hits: the contacts with all walls, if `keep_hits`; otherwise empty.
    """

    rows: Rows
    modes: tuple[Mode, ...]
    miss_m: Array
    t_s: Array
    force_n: Array
    x: Array
    y: Array
    vx: Array
    vy: Array
    hits: tuple[PredictedContacts, ...]


class _AtWall(NamedTuple):
    """Candidates at the onset of a contact with one wall; arrays (n,), velocity in the wall's frame."""

    wall: Wall
    number: int  # number of the wall in the sequence, from 1
    rows: Rows
    modes: Rows
    t_s: Array
    force_n: Array
    hits: tuple[PredictedContacts, ...]
    position: tuple[Array, Array]
    velocity: tuple[Array, Array]
    normal: NormalOut
    tangential: TangentialOut


class _Released(NamedTuple):
    """Candidates at their release from a wall; arrays (n,)."""

    rows: Rows
    modes: Rows  # index of the mode sequence so far, as in `itertools.product`
    t_s: Array  # time of the release
    since_peak_s: Array  # time from the recovery setpoint to the release
    force_n: Array
    leg: SetpointResponse
    hits: tuple[PredictedContacts, ...]

    def select(self, rows: Rows | NDArray[np.bool_]) -> _Released:
        hits = tuple(hit.select(rows) for hit in self.hits)
        return _Released._make((*(v[rows] for v in self[:5]), self.leg.select(rows), hits))


def _merge(fronts: list[_Released]) -> _Released:
    if len(fronts) == 1:
        return fronts[0]
    hits = tuple(
        PredictedContacts._make(
            (
                same[0].wall,
                *_concatenate([hit[1:-1] for hit in same]),
                _concatenate_legs([hit.leg for hit in same]),
            )
        )
        for same in zip(*(front.hits for front in fronts), strict=True)
    )
    legs = _concatenate_legs([front.leg for front in fronts])
    return _Released._make((*_concatenate([front[:5] for front in fronts]), legs, hits))


def _concatenate(columns: list[Any]) -> list[Any]:
    return [np.concatenate(same) for same in zip(*columns, strict=True)]


def _concatenate_legs(legs: list[SetpointResponse]) -> SetpointResponse:
    return SetpointResponse(*(np.concatenate(same, axis=-1) for same in zip(*legs, strict=True)))


class UncertaintyDraw(NamedTuple):
    """Random values of the uncertain quantities: coefficients, approach velocity, setpoint delay, walls."""

    factors: dict[tuple[str, Mode], tuple[float, float, float]]  # factors on k, f and mu
    normal_m_s: float
    tangential_m_s: float
    delay_s: float
    walls: dict[str, Wall] = {}  # noqa: RUF012  (never changed): walls that differ from the plan


def draw_wall(wall: Wall, rng: np.random.Generator) -> Wall:
    away, angle = rng.standard_normal(2)
    moved = wall.displaced(float(away) * (wall.position_sd_m or 0.0))
    return moved.rotated(float(angle) * (wall.yaw_sd_rad or 0.0))


def stages_for(task: Task, draws: Sequence[UncertaintyDraw | None]) -> list[Stages]:
    """Return the contact stages by wall and mode, for every draw; None means the nominal values.

    Only walls with gains (`task.alphas`) have stages.
    """
    keys = [(name, mode) for name in task.alphas for mode in task.modes]
    table, alphas, drags, delays = [], [], [], []
    for draw in draws:
        for name, mode in keys:
            wall = task.walls[name] if draw is None else draw.walls.get(name, task.walls[name])
            c = task.vehicle.materials[wall.material].coefficients(mode)
            if draw is not None:
                k, f, mu = draw.factors[name, mode]
                c = c.scaled(k, f, mu)
            table.append(c)
            alphas.append(task.alphas[name])
            drags.append(drag_along(wall, task.vehicle.airframe.drag_per_s)[0])
            delays.append(draw.delay_s if draw is not None else 0.0)
    stages = build_stages(task.vehicle, table, alphas, drags, delays)
    n = len(keys)
    return [dict(zip(keys, stages[i * n : (i + 1) * n], strict=True)) for i in range(len(draws))]


class Rollout:
    """One sequence of walls, in the order of the impacts, for any approach velocities.

    Args:
        flight: precomputed tables of the position loop, shared between rollouts.
        constraints: constraints of the task, or None to fly every candidate to its end (for comparisons).
        keep_hits: whether each returned arrival includes its hits.
    """

    def __init__(
        self,
        task: Task,
        sequence: Sequence[str],
        flight: FreeFlight,
        constraints: Constraints | None,
        keep_hits: bool = False,
    ) -> None:
        self.task, self.flight, self.constraints = task, flight, constraints
        self.walls = [task.walls[name] for name in sequence]
        self.keep_hits = keep_hits
        self.refused = np.zeros(len(REFUSALS) + 1, dtype=np.int64)
        self._goal: Vec2 = task.goal.position_m

    def approach(self, normal: Array, tangential: Array) -> ApproachGrid:
        return approach_grid(self.task, self.walls[0], normal, tangential, self.constraints)

    def fly(
        self,
        stages: Stages,
        normal: Array,
        tangential: Array,
        grid: ApproachGrid,
        draw: UncertaintyDraw | None = None,
    ) -> list[Arrivals]:
        """Compute the flights from the given approaches, for all mode sequences.

        Args:
            stages: contact stages of this draw.
            normal, tangential: planned velocities; arrays that broadcast with each other.
            grid: result of `approach` for these velocities, from this rollout or from one with other wall
                positions. A vehicle plans its approach to the assumed wall and hits the true wall.
            draw: random values, or None for the nominal values. Only the offsets of the approach velocity are
                used here, because stages and walls already contain the other values.
        """
        firsts = [self._first(stages, i, normal, tangential, grid, draw) for i in range(len(self.task.modes))]
        fronts = [front for front in firsts if front is not None]
        for number, wall in enumerate(self.walls[1:], start=2):
            if fronts:
                fronts = self._next(stages, _merge(fronts), wall, number)
        return self._arrive(_merge(fronts)) if fronts else []

    def _weight(self, collision: int) -> int:
        """Return the number of mode sequences that share given modes at the first `collision` walls."""
        return int(len(self.task.modes) ** (len(self.walls) - collision))

    def _refuse(self, codes: NDArray[np.int8], collision: int) -> NDArray[np.bool_]:
        """Count refusals, and return which candidates remain."""
        if codes.any():
            self.refused[1:] += (
                self._weight(collision) * np.bincount(codes.ravel(), minlength=self.refused.size)[1:]
            )
        stays: NDArray[np.bool_] = codes == 0
        return stays

    def _refuse_all(self, reason: Refusal, count: int, collision: int) -> None:
        """Count candidates that are refused even if there are no constraints."""
        self.refused[CODE[reason]] += count * self._weight(collision)

    # -- first collision --

    def _first(
        self,
        stages: Stages,
        mode: int,
        normal: Array,
        tangential: Array,
        grid: ApproachGrid,
        draw: UncertaintyDraw | None,
    ) -> _Released | None:
        wall = self.walls[0]
        stage = stages[wall.name, self.task.modes[mode]]
        shift_n, shift_t = (0.0, 0.0) if draw is None else (draw.normal_m_s, draw.tangential_m_s)
        if grid.wall is not wall:
            grid, normal, tangential, shift_n, shift_t = _actual_approach(
                wall, grid, normal, tangential, (shift_n, shift_t)
            )
        bn, bt = drag_along(wall, self.task.vehicle.airframe.drag_per_s)
        vn = normal if draw is None else np.minimum(normal + shift_n, -1e-3)
        vt = tangential if draw is None else tangential + shift_t
        out = stage.normal(vn, bn * vn, np.zeros_like(vn))
        # The candidates have few different normal speeds, so compute the speed-dependent part once per speed.
        speeds, which = np.unique(vn, return_inverse=True)
        slide = TangentialShape(*(v[which.reshape(vn.shape)] for v in stage.tangential_shape(speeds)))
        along = stage.tangential(slide, vt, bt * vt, np.zeros_like(vt))
        shape = np.broadcast_shapes(normal.shape, tangential.shape)
        flat = _flatten(shape, out), _flatten(shape, along)
        codes = grid.codes
        if self.constraints is not None:
            velocity = tuple(np.broadcast_to(v, shape).ravel() for v in (vn, vt))
            hit = self.constraints.hit(
                (velocity[0], velocity[1]), flat[0].peak_force_n, flat[1].friction_n, flat[0].velocity
            )
            approach = grid.codes.ravel()
            codes = np.where(approach != 0, approach, hit)
            stays = self._refuse(codes, 1)
            rows = np.flatnonzero(stays)
            if rows.size == 0:
                return None
            flat = _select_rows(flat[0], rows), _select_rows(flat[1], rows)
        else:
            rows = np.arange(math.prod(shape))
        n = np.broadcast_to(vn, shape).ravel()[rows]
        t = np.broadcast_to(vt, shape).ravel()[rows]
        (nx, ny), (tx, ty) = wall.normal, wall.tangent
        back = -stage.lead_s * t
        onset = flat[0].onset_m
        x = grid.impact_x.ravel()[rows] + nx * onset + tx * back
        y = grid.impact_y.ravel()[rows] + ny * onset + ty * back
        time = grid.impact_s.ravel()[rows] - stage.lead_s
        modes, force = np.full(rows.size, mode), np.zeros(rows.size)
        return self._release(stage, _AtWall(wall, 1, rows, modes, time, force, (), (x, y), (n, t), *flat))

    def _release(self, stage: ContactStage, impacts: _AtWall) -> _Released | None:
        """Return the candidates released from a contact, without those whose recovery exceeds a limit."""
        wall, number, rows, modes, time, force, hits, position, velocity, n, t = impacts
        (nx, ny), (tx, ty) = wall.normal, wall.tangent

        def mission(normal: Array, tangential: Array) -> tuple[Array, Array]:
            return nx * normal + tx * tangential, ny * normal + ty * tangential

        sx, sy = mission(n.setpoint_m - n.onset_m, t.setpoint_m)
        px, py = mission(n.release_m - n.onset_m, t.release_m)
        vx, vy = mission(n.velocity, t.velocity)
        ax, ay = mission(n.acceleration, t.acceleration)
        ix, iy = mission(n.integral, t.integral)
        leg = SetpointResponse(
            np.stack((px - sx, vx, ax, ix)),
            np.stack((py - sy, vy, ay, iy)),
            position[0] + sx,
            position[1] + sy,
        )
        duration = np.full(rows.size, stage.duration_s)
        hit = PredictedContacts(wall, time, *position, *velocity, n.peak_force_n, t.friction_n, duration, leg)
        front = _Released(
            rows,
            modes,
            time + stage.duration_s,
            duration - stage.engaged_s,
            np.maximum(force, hit.peak_force_n),
            leg,
            (*hits, hit) if self.keep_hits else (),
        )
        if self.constraints is None:
            return front
        stays = self._refuse(self.constraints.command(leg, self.flight.loop), number)
        return front.select(stays) if stays.any() else None

    # -- to the next wall --

    def _next(self, stages: Stages, front: _Released, wall: Wall, number: int) -> list[_Released]:
        """Compute collision `number`; return the released candidates, one group per possible mode."""
        index, order = self._search_wall(front, wall, number - 1)
        if order.size == 0:
            return []
        reached = front.select(order)
        near = self.flight.near(reached.leg, index)
        series = near.along(wall.normal)
        series[0] -= wall.normal[0] * wall.point[0] + wall.normal[1] * wall.point[1]
        fronts = []
        for i, mode in enumerate(self.task.modes):
            stage = stages[wall.name, mode]
            d = first_crossing(series, stage.lead_s, -GRID_S - 2.0 * stage.lead_s, 1e-3)
            leg, after = near.leg_at(d), near.times + d
            here = reached._replace(modes=reached.modes * len(self.task.modes) + i)
            codes = self._reached_codes(reached, wall, i, leg, after)
            if codes is not None:
                stays = np.flatnonzero(self._refuse(codes, number))
                here, leg, after = here.select(stays), leg.select(stays), after[stays]
            if after.size:
                fronts.append(self._collide(stage, wall, number, here, leg, after))
        return [front for front in fronts if front is not None]

    def _reached_codes(
        self, front: _Released, wall: Wall, mode: int, impact: SetpointResponse, after: Array
    ) -> NDArray[np.int8] | None:
        """Check incidence, lock and detector of the candidates that reach a wall.

        Return refusal codes (0: accepted) for the mode with the index `mode`, or None without constraints.
        """
        if self.constraints is None:
            return None
        codes = np.zeros(after.size, dtype=np.int8)
        # A recovery keeps the heading of the approach to the first wall.
        met_incidence_deg = math.degrees(wall.incidence(self.walls[0].parallel_yaw(0.0)))
        if met_incidence_deg > max_incidence_deg(self.task.vehicle, self.task.modes[mode]):
            self.constraints.mark(codes, np.ones(after.size, dtype=bool), Refusal.INCIDENCE)
        switched = front.modes % len(self.task.modes) != mode
        if switched.any():
            ready = self.flight.at(front.leg, self.constraints.lock_s)
            late = self.constraints.lock_too_late(ready, impact, after, wall)
            self.constraints.mark(codes, switched & late, Refusal.SERVO_TRAVEL)
        self.constraints.mark(codes, after < self.constraints.refractory_s, Refusal.TOO_SOON)
        return codes

    def _search_wall(self, front: _Released, wall: Wall, number: int) -> tuple[Rows, Rows]:
        """Return the first grid index behind the wall's plane, and the candidates that reach the plane."""
        (nx, ny), (px, py) = wall.normal, wall.point
        offset = nx * px + ny * py
        live = np.arange(front.leg.size)
        grid = self.flight.grid(front.leg)
        indices, found = [], []
        # A wall is hit from its free side, so a candidate behind the plane at the release is refused.
        side = _along(wall.normal, front.leg.x[0] + front.leg.goal_x, front.leg.y[0] + front.leg.goal_y)
        before = np.flatnonzero(side > offset)
        if before.size < live.size:
            self._refuse_all(Refusal.WALL_NOT_REACHED, live.size - before.size, number)
            live, grid = live[before], grid.select(before)
        for first in range(0, self.flight.count, WINDOW):
            never = grid.stays_before(wall.normal, offset, first)
            if never.any():
                self._refuse_all(Refusal.WALL_NOT_REACHED, int(never.sum()), number)
                live, grid = live[~never], grid.select(~never)
            if live.size == 0:
                break
            w = grid.window(first)
            behind = _along(wall.normal, w.x, w.y) < offset
            index = behind.argmax(axis=1)
            crossed = behind[np.arange(live.size), index]
            codes = np.zeros(live.size, dtype=np.int8)
            if self.constraints is not None:
                until = np.where(crossed, index, w.times.size)
                codes = self.constraints.path(w, until, wall, first == 0)
                rows = np.flatnonzero(crossed & (codes == 0))
                at = index[rows]
                place = (w.x[rows, at], w.y[rows, at])
                passes = wall.end_distance_m(place) < end_margin_m(wall, place)
                codes[rows[passes]] = CODE[Refusal.WALL_NOT_REACHED]
                self._refuse(codes, number)
            fine = codes == 0
            good = np.flatnonzero(crossed & fine)
            indices.append(first + index[good])
            found.append(live[good])
            stays = np.flatnonzero(~crossed & fine)
            if stays.size < live.size:
                live, grid = live[stays], grid.select(stays)
        self._refuse_all(Refusal.WALL_NOT_REACHED, live.size, number)
        return np.concatenate([*indices, _NONE]), np.concatenate([*found, _NONE])

    def _collide(
        self,
        stage: ContactStage,
        wall: Wall,
        number: int,
        front: _Released,
        leg: SetpointResponse,
        after: Array,
    ) -> _Released | None:
        (nx, ny), (tx, ty) = wall.normal, wall.tangent
        x, y = leg.x[0] + leg.goal_x, leg.y[0] + leg.goal_y
        vn, an, jn = (nx * leg.x[i] + ny * leg.y[i] for i in (1, 2, 3))
        vt, at, jt = (tx * leg.x[i] + ty * leg.y[i] for i in (1, 2, 3))
        out = stage.normal(vn, an, jn)
        shape = stage.tangential_shape(vn)
        slide = stage.tangential(shape, vt, at, jt)
        time = front.t_s + after
        if self.constraints is not None:
            codes = self.constraints.hit((vn, vt), out.peak_force_n, slide.friction_n, out.velocity)
            stays = np.flatnonzero(self._refuse(codes, number))
            if stays.size == 0:
                return None
            if stays.size < codes.size:
                front, out, slide = front.select(stays), _select_rows(out, stays), _select_rows(slide, stays)
                x, y, vn, vt, time = (v[stays] for v in (x, y, vn, vt, time))
        before = (front.rows, front.modes, time, front.force_n, front.hits)
        return self._release(stage, _AtWall(wall, number, *before, (x, y), (vn, vt), out, slide))

    # -- to the goal --

    def _arrive(self, front: _Released) -> list[Arrivals]:
        """Return the candidates at their closest approach to the goal, grouped by sequence of modes."""
        index, order = self._search_goal(front)
        arrived = front.select(order)
        near = self.flight.near(arrived.leg, index)
        low = np.where(index == 0, 0.0, -GRID_S)
        high = np.where(index == self.flight.count, 0.0, GRID_S)
        d, miss, state = closest(near.x, near.y, self._goal, low, high)
        passes = np.ones(d.size, dtype=bool)
        if self.constraints is not None:
            codes = self.constraints.last_setpoint(arrived.leg, self.walls[-1])
            on_the_way = self.constraints.to_goal(*state[:2], self._goal)
            passes = self._refuse(np.where(codes > 0, codes, on_the_way), len(self.walls))
        every = (miss, arrived.t_s + near.times + d, arrived.force_n, *state)
        arrivals = []
        for number, modes in enumerate(itertools.product(self.task.modes, repeat=len(self.walls))):
            mine = np.flatnonzero(passes & (arrived.modes == number))
            if mine.size:
                hits = tuple(hit.select(mine) for hit in arrived.hits)
                columns = (arrived.rows[mine], modes, *(v[mine] for v in every), hits)
                arrivals.append(Arrivals._make(columns))
        return arrivals

    def _search_goal(self, front: _Released) -> tuple[Rows, Rows]:
        """Return the grid index of each remaining candidate's closest approach, and the candidate's index.

        The search ends when the vehicle has passed the goal (rule in `core/mission/recovery.py`).
        """
        live = np.arange(front.leg.size)
        grid = self.flight.grid(front.leg)
        best = np.full(live.size, math.inf, dtype=np.float32)
        where = np.zeros(live.size, dtype=np.intp)
        indices, found = [], []
        earliest = (PASSED_AFTER_S - front.since_peak_s)[:, None]
        goal_x, goal_y = np.float32(self._goal[0]), np.float32(self._goal[1])
        for first in range(0, self.flight.count, WINDOW):
            w = grid.window(first)
            dx, dy = w.x - goal_x, w.y - goal_y
            distance = np.sqrt(dx * dx + dy * dy)
            least = np.minimum.accumulate(distance, axis=1)
            np.minimum(least, best[:, None], out=least)
            rising = distance > least + np.float32(PASSED_RISE_M)
            if w.times[0] < PASSED_AFTER_S:
                rising &= w.times >= earliest
            index = rising.argmax(axis=1)
            every = np.arange(live.size)
            passed = rising[every, index]
            until = np.where(passed, index + 1, w.times.size)
            codes = np.zeros(live.size, dtype=np.int8)
            if self.constraints is not None:
                codes = self.constraints.path(w, until, None, first == 0)
                self._refuse(codes, len(self.walls))
            # The closest approach may be in an earlier window than the rise of the distance.
            bottom = least[every, until - 1]
            here = bottom < best
            at = (distance <= bottom[:, None]).argmax(axis=1)
            where = np.where(here, first + at, where)
            fine = codes == 0
            good = np.flatnonzero(passed & fine)
            indices.append(where[good])
            found.append(live[good])
            stays = np.flatnonzero(~passed & fine)
            live, best, where, earliest = live[stays], bottom[stays], where[stays], earliest[stays]
            if live.size == 0:
                break
            grid = grid.select(stays)
        return np.concatenate([*indices, where]), np.concatenate([*found, live])


_NONE = np.zeros(0, dtype=np.intp)


def _actual_approach(
    wall: Wall,
    grid: ApproachGrid,
    normal: Array,
    tangential: Array,
    shift: tuple[float, float],
) -> tuple[ApproachGrid, Array, Array, float, float]:
    """Return the impacts of planned approaches on a wall that differs from the planned wall.

    The results are the approaches, the normal and tangential velocity, and their offsets. The velocities, and
    the velocity offsets `shift`, are converted from the planned wall's frame to the true wall's frame. The
    gains of a recovery setpoint therefore apply to the true wall's axes. If the gains of both axes are equal,
    the frame makes no difference.
    """
    (nx, ny), (tx, ty) = wall.normal, wall.tangent
    (ox, oy), (sx, sy) = grid.wall.normal, grid.wall.tangent
    across = (nx * ox + ny * oy, nx * sx + ny * sy)
    along = (tx * ox + ty * oy, tx * sx + ty * sy)
    vx, vy = ox * normal + sx * tangential, oy * normal + sy * tangential
    into = np.minimum(across[0] * normal + across[1] * tangential, -1e-3)
    before = nx * (grid.impact_x - wall.point[0]) + ny * (grid.impact_y - wall.point[1])
    later_s = before / -into
    x, y = grid.impact_x + vx * later_s, grid.impact_y + vy * later_s
    codes = grid.codes.copy()
    # The wall's position is drawn, so no margin for uncertainty is needed: half the vehicle's width suffices.
    beyond = wall.end_distance_m((x, y)) < wall.half_vehicle_m
    codes[(codes == 0) & beyond] = CODE[Refusal.BEYOND_WALL]
    actual = grid._replace(codes=codes, impact_x=x, impact_y=y, impact_s=grid.impact_s + later_s)
    n, t = shift
    return (
        actual,
        into,
        along[0] * normal + along[1] * tangential,
        across[0] * n + across[1] * t,
        along[0] * n + along[1] * t,
    )


def _along(direction: Vec2, x: NDArray[Any], y: NDArray[Any]) -> NDArray[Any]:
    """Return the component of (x, y) along a direction, by one product if the direction is an axis."""
    nx, ny = x.dtype.type(direction[0]), y.dtype.type(direction[1])
    along: NDArray[Any] = x * nx if ny == 0.0 else y * ny if nx == 0.0 else x * nx + y * ny
    return along


def new_flight(task: Task) -> FreeFlight:
    return FreeFlight(task.vehicle, min(_HORIZON_S, task.limits.collision_timeout_s))


def _flatten(shape: tuple[int, ...], out: Outcome) -> Outcome:
    return type(out)(*(np.broadcast_to(v, shape).ravel() for v in out))


def _select_rows(out: Outcome, rows: Rows) -> Outcome:
    return type(out)(*(v[rows] for v in out))
