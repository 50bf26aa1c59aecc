"""Exhaustive search over approach velocities and mode sequences, which ranks plans and counts rejections.

`search` is the planner. Its rollouts are in `planning.rollout`, and its constraints in
`planning.constraints`.
"""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable, Iterator

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.base.geometry import distance2
from dart_flight.config.document import InputError
from dart_flight.lab.search.free_time import least_free_time, rest_at_s
from dart_flight.lab.search.plan import Candidates, FreeTime, Plan, PlannedCollision, SearchResult
from dart_flight.lab.search.scenario import Objective, Scenario
from dart_flight.planning.approach_grid import ApproachGrid
from dart_flight.planning.constraints import REFUSALS, Constraints, Refusal
from dart_flight.planning.flight_model import Array, FreeFlight, Rows
from dart_flight.planning.rollout import (
    MIN_FACTOR,
    Arrivals,
    Rollout,
    UncertaintyDraw,
    draw_wall,
    new_flight,
    stages_for,
)

Progress = Callable[[int, int], None]  # called with (number of finished trajectories, number of all)

_MIN_LOSS_M = 1.0

ADVICE = {
    Refusal.APPROACH_SPEED: "raise limits.speed_m_s, or add slower approaches to `search`",
    Refusal.BEYOND_WALL: "lengthen the wall, move start, or add lower tangential speeds to `search`",
    Refusal.RUN_UP_ROOM: "widen bounds_m, move start back, or add slower approaches to `search`",
    Refusal.RUN_UP_BLOCKED: "move start, or move the wall that blocks the run-up",
    Refusal.NOT_DETECTED: "lower detection.force_threshold_n, or add faster approaches to `search`",
    Refusal.PEAK_FORCE: "raise limits.peak_force_n, or add slower approaches or flexible mode to `search`",
    Refusal.CLOSING: "raise limits.closing_m_s, or add slower approaches to `search`",
    Refusal.SLIDING: "raise limits.sliding_m_s, or add lower tangential speeds to `search`",
    Refusal.FRICTION: "raise limits.friction_ratio, or add lower tangential speeds to `search`",
    Refusal.NO_REBOUND: "add faster approaches or the rigid mode to `search`",
    Refusal.SETPOINT: "lower the wall's gain alpha, widen bounds_m, or add slower approaches to `search`",
    Refusal.ACCELERATION: "lower the wall's gain alpha or raise MPC_TILTMAX_AIR",
    Refusal.SPEED: "raise limits.speed_m_s or lower the wall's gain alpha",
    Refusal.BOUNDS: "widen bounds_m or lower the wall's gain alpha",
    Refusal.OBSTACLE: "move or shorten the wall that blocks the path, or add this wall to `sequence`",
    Refusal.WALL_NOT_REACHED: (
        "raise the previous wall's gain alpha, move the missed wall nearer, or lengthen it"
    ),
    Refusal.INCIDENCE: "turn the wall: the vehicle hits every wall with the heading of the first approach",
    Refusal.TOO_SOON: "move the walls apart or lower detection.refractory_s",
    Refusal.SERVO_TRAVEL: "allow the same mode at both walls, use a faster servo, or move the walls apart",
}


def search(
    scenario: Scenario, top: int = 10, seed: int = 1, progress: Progress | None = None
) -> SearchResult:
    """Evaluate every candidate of a scenario and rank the feasible ones.

    Args:
        top: number of plans to return.
        seed: seed of the random sets of values (draws) of `robust`.
        progress: called with the number of finished trajectories and the number of all trajectories.

    Raises:
        InputError: no candidate is feasible. The message lists the reasons for rejection, the most frequent
            reason first, and states what to relax.
    """
    began = time.perf_counter()
    planner = ScenarioSearch(scenario, seed, progress or (lambda done, of: None))
    maps = planner.run()
    feasible = sum(m.rows.size for m in maps)
    if feasible == 0:
        raise InputError(planner.why_infeasible(), source=scenario.source, key=("search",))
    best = _ranked(maps, scenario, top)
    free = _free(scenario)
    plans = planner.explain(list(_spread(maps, best)), free)
    return SearchResult(
        scenario=scenario,
        plans=plans,
        candidates=planner.candidates,
        feasible=feasible,
        trajectories=planner.flown,
        refused={r: int(n) for r, n in zip(REFUSALS, planner.refused[1:], strict=True) if n},
        elapsed_s=time.perf_counter() - began,
        free_time=free,
        maps=tuple(maps),
    )


class ScenarioSearch:
    """The search of one scenario."""

    def __init__(self, scenario: Scenario, seed: int = 1, progress: Progress = lambda done, of: None) -> None:
        self.scenario, self._seed, self._progress = scenario, seed, progress
        self.flight: FreeFlight = new_flight(scenario)
        self.nominal = stages_for(scenario, [None])[0]
        self.normal = np.array(scenario.normal_m_s)[:, None]
        self.tangential = np.array(scenario.tangential_m_s)[None, :]
        self.approaches = self.normal.size * self.tangential.size
        self.candidates = sum(self.approaches * len(scenario.modes) ** len(s) for s in scenario.sequences)
        self.refused = np.zeros(len(REFUSALS) + 1, dtype=np.int64)
        self.flown = 0

    def run(self) -> list[Candidates]:
        found: list[Candidates] = []
        for sequence, arrivals, grid in self._nominal(frozenset()):
            found.extend(self._candidates(sequence, a, grid) for a in arrivals)
        if self.scenario.objective is Objective.ROBUST:
            found = self._robust(found)
        return [self._scored(c, found) for c in found]

    def _nominal(
        self, ignored: frozenset[Refusal]
    ) -> Iterator[tuple[tuple[str, ...], list[Arrivals], ApproachGrid]]:
        for sequence in self.scenario.sequences:
            rollout = Rollout(self.scenario, sequence, self.flight, Constraints(self.scenario, ignored))
            grid = rollout.approach(self.normal, self.tangential)
            arrivals = rollout.fly(self.nominal, self.normal, self.tangential, grid)
            if not ignored:
                self.refused += rollout.refused
                self.flown += self.approaches * len(self.scenario.modes) ** len(sequence)
                self._progress(self.flown, self.candidates)
            yield sequence, arrivals, grid

    def _candidates(self, sequence: tuple[str, ...], a: Arrivals, grid: ApproachGrid) -> Candidates:
        normal, tangential = np.divmod(a.rows, self.tangential.size)
        speed = self.scenario.vehicle.flying.transit_speed_m_s
        return Candidates(
            sequence,
            a.modes,
            a.rows,
            self.normal[normal, 0],
            self.tangential[0, tangential],
            a.miss_m,
            grid.transit_s.ravel()[a.rows] + a.t_s + a.miss_m / speed,
            a.force_n,
            a.x,
            a.y,
            a.miss_m,
            None,
            None,
            None,
        )

    def _scored(self, c: Candidates, all_found: list[Candidates]) -> Candidates:
        objective = self.scenario.objective
        if objective is Objective.FASTEST:
            return c._replace(score=c.time_s)
        if objective is Objective.GENTLEST:
            # Only candidates within the goal's capture radius count. If there are none, the limit is the
            # smallest miss plus this radius.
            radius = self.scenario.goal.capture_radius_m
            least = min(float(m.miss_m.min()) for m in all_found if m.rows.size)
            allowed = radius if least <= radius else least + radius
            return c._replace(score=np.where(c.miss_m <= allowed, c.force_n, math.inf))
        if objective is Objective.ROBUST:
            assert c.expected_m is not None
            assert c.worst_m is not None
            return c._replace(score=0.5 * (c.expected_m + c.worst_m))
        return c

    # -- robust --

    def _robust(self, found: list[Candidates]) -> list[Candidates]:
        """Return the feasible candidates with their expected and worst miss over the draws."""
        draws = draws_of(self.scenario, self._seed)
        stages = stages_for(self.scenario, draws)
        by_sequence: dict[tuple[str, ...], list[Candidates]] = {}
        for c in found:
            by_sequence.setdefault(c.sequence, []).append(c)
        total = self.candidates + len(draws) * sum(c.rows.size for c in found)
        out: list[Candidates] = []
        for sequence, group in by_sequence.items():
            rows = np.unique(np.concatenate([c.rows for c in group]))
            normal, tangential = np.divmod(rows, self.tangential.size)
            vn, vt = self.normal[normal, 0], self.tangential[0, tangential]
            rollout = Rollout(self.scenario, sequence, self.flight, Constraints(self.scenario))
            grid = rollout.approach(vn, vt)
            misses = {c.modes: np.full((len(draws), rows.size), math.nan) for c in group}
            for i, (draw, of_draw) in enumerate(zip(draws, stages, strict=True)):
                drawn = self._rollout_of_draw(rollout, sequence, draw)
                for a in drawn.fly(of_draw, vn, vt, grid, draw):
                    if a.modes in misses:
                        misses[a.modes][i, a.rows] = a.miss_m
                self.flown += sum(c.rows.size for c in group)
                self._progress(self.flown, total)
            out.extend(self._with_misses(c, misses[c.modes][:, np.searchsorted(rows, c.rows)]) for c in group)
        return out

    def _rollout_of_draw(self, planned: Rollout, sequence: tuple[str, ...], draw: UncertaintyDraw) -> Rollout:
        """Return the rollout with the walls of a draw. If the draw moves no wall, return `planned`."""
        if not draw.walls:
            return planned
        there = msgspec.structs.replace(self.scenario, walls=self.scenario.walls | draw.walls)
        return Rollout(there, sequence, self.flight, Constraints(there))

    def _with_misses(self, c: Candidates, misses: Array) -> Candidates:
        loss = max(_MIN_LOSS_M, distance2(self.scenario.start, self.scenario.goal.position_m))
        failed = np.isnan(misses)
        filled = np.where(failed, loss, misses)
        return c._replace(
            expected_m=filled.mean(axis=0), worst_m=filled.max(axis=0), failed=failed.mean(axis=0)
        )

    # -- plans and explanations --

    def explain(self, chosen: list[tuple[Candidates, int]], free: FreeTime | None = None) -> tuple[Plan, ...]:
        """Return a plan with its collisions for each chosen candidate, in the order given."""
        plans: dict[int, Plan] = {}
        groups: dict[int, list[tuple[int, Candidates, int]]] = {}
        for rank, (c, i) in enumerate(chosen, start=1):
            groups.setdefault(id(c), []).append((rank, c, i))
        for group in groups.values():
            c = group[0][1]
            arrivals = self.trace(c, np.array([i for _, _, i in group]))
            place = {int(row): k for k, row in enumerate(arrivals.rows)}
            for j, (rank, _, i) in enumerate(group):
                plan = _plan(c, i, rank, arrivals, place[j])
                plans[rank] = self._compared(plan, arrivals, place[j], free)
        return tuple(plans[rank] for rank in sorted(plans))

    def _compared(self, plan: Plan, arrivals: Arrivals, k: int, free: FreeTime | None) -> Plan:
        """Return the plan with its time to rest at the goal and its saving over the collision-free flight."""
        if free is None or free.time_s is None:
            return plan
        velocity, goal = (float(arrivals.vx[k]), float(arrivals.vy[k])), self.scenario.goal.position_m
        passed_s = plan.time_to_goal_s - plan.goal_miss_m / self.scenario.vehicle.flying.transit_speed_m_s
        at_rest_s = passed_s + rest_at_s(plan.closest_m, velocity, goal, free.limits)
        return msgspec.structs.replace(plan, time_to_rest_s=at_rest_s, saving_s=free.time_s - at_rest_s)

    def trace(self, c: Candidates, chosen: NDArray[np.intp]) -> Arrivals:
        """Roll out the candidates `chosen` (indices into `c`) again, and keep their collisions and legs."""
        rollout = Rollout(self.scenario, c.sequence, self.flight, Constraints(self.scenario), keep_hits=True)
        vn, vt = c.normal_m_s[chosen], c.tangential_m_s[chosen]
        arrivals = rollout.fly(self.nominal, vn, vt, rollout.approach(vn, vt))
        return next(a for a in arrivals if a.modes == c.modes)

    def why_infeasible(self) -> str:
        """List the reasons for rejection in a sentence, the most frequent first, and state what to relax."""
        counts = sorted(
            ((int(n), r) for r, n in zip(REFUSALS, self.refused[1:], strict=True) if n), reverse=True
        )
        text = f"none of {self.candidates} candidates is feasible: " + ", ".join(
            f"{n} {r.value}" for n, r in counts
        )
        freed = sorted(((self._freed(r), r) for _, r in counts), reverse=True)
        if freed and freed[0][0]:
            count, reason = freed[0]
            return (
                f"{text}; without the constraint {reason.value}, {count} would be feasible: {ADVICE[reason]}"
            )
        return f"{text}; several constraints must be relaxed; first {ADVICE[counts[0][1]]}"

    def _freed(self, reason: Refusal) -> int:
        return sum(a.rows.size for _, found, _ in self._nominal(frozenset({reason})) for a in found)


def _plan(c: Candidates, i: int, rank: int, arrivals: Arrivals, k: int) -> Plan:
    """Return candidate `i` of `c` as a plan. The plan's collisions come from row `k` of the arrivals."""
    collisions = tuple(
        PlannedCollision(
            wall=h.wall.name,
            mode=mode,
            t_s=float(h.t_s[k]),
            position_m=(float(h.x[k]), float(h.y[k])),
            normal_m_s=float(h.normal_m_s[k]),
            tangential_m_s=float(h.tangential_m_s[k]),
            peak_force_n=float(h.normal_n[k]),
            peak_friction_n=abs(float(h.tangential_n[k])),
            contact_time_s=float(h.duration_s[k]),
            setpoint_m=(float(h.leg.goal_x[k]), float(h.leg.goal_y[k])),
        )
        for h, mode in zip(arrivals.hits, arrivals.modes, strict=True)
    )
    return Plan(
        rank=rank,
        score=float(c.score[i]),
        goal_miss_m=float(c.miss_m[i]),
        time_to_goal_s=float(c.time_s[i]),
        peak_force_n=float(c.force_n[i]),
        closest_m=(float(c.x[i]), float(c.y[i])),
        collisions=collisions,
        expected_miss_m=_at(c.expected_m, i),
        worst_miss_m=_at(c.worst_m, i),
        failed_draws=_at(c.failed, i),
    )


def draws_of(scenario: Scenario, seed: int) -> list[UncertaintyDraw]:
    """Return the draws of `robust`, which all candidates share. Each wall and mode has its own factors."""
    u = scenario.uncertainty
    rng = np.random.default_rng(seed)
    draws = []
    for _ in range(u.samples):
        factors = {}
        for name in scenario.alphas:
            for mode in scenario.modes:
                k, f, mu = np.maximum(1.0 + np.array([u.k, u.f, u.mu]) * rng.standard_normal(3), MIN_FACTOR)
                factors[name, mode] = (float(k), float(f), float(mu))
        shift = rng.standard_normal(3)
        walls = {name: draw_wall(wall, rng) for name, wall in scenario.walls.items() if wall.is_uncertain}
        draws.append(
            UncertaintyDraw(
                factors,
                u.approach_m_s * float(shift[0]),
                u.approach_m_s * float(shift[1]),
                u.detection_delay_s * float(shift[2]),
                walls,
            )
        )
    return draws


def _free(scenario: Scenario) -> FreeTime | None:
    there = all(importlib.util.find_spec(name) is not None for name in ("ruckig", "casadi"))
    return least_free_time(scenario) if there else None


def _at(values: Array | None, i: int) -> float | None:
    return None if values is None else float(values[i])


def _ranked(maps: list[Candidates], scenario: Scenario, top: int) -> Rows:
    """Return indices into all candidates, best first; ties are ordered by miss, then by force."""
    score = np.concatenate([m.score for m in maps])
    miss = np.concatenate([m.miss_m for m in maps])
    force = np.concatenate([m.force_n for m in maps])
    usable = np.flatnonzero(np.isfinite(score))
    order = np.lexsort((force[usable], miss[usable], score[usable]))
    return usable[order[:top]]


def _spread(maps: list[Candidates], indices: Rows) -> Iterator[tuple[Candidates, int]]:
    ends = np.cumsum([m.rows.size for m in maps])
    for index in indices:
        which = int(np.searchsorted(ends, index, side="right"))
        yield maps[which], int(index - (ends[which] - maps[which].rows.size))
