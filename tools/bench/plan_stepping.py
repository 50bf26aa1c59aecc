"""The planner's flight model in plain NumPy time stepping over all candidates, as the baseline of the
benchmark.

The equations are those of `contact_stage` and `flight_model`, integrated by semi-implicit Euler in steps of 1
ms. Finished candidates are removed from the arrays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_flight.base.records import Mode
from dart_flight.base.walls import Wall
from dart_flight.core.mission.position_loop import PositionLoop
from dart_flight.core.mission.recovery import PASSED_AFTER_S, PASSED_RISE_M
from dart_flight.lab.search.scenario import Scenario
from dart_flight.planning.approach_grid import ApproachGrid
from dart_flight.planning.contact_stage import ContactStage
from dart_flight.planning.rollout import Stages

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
_HORIZON_S = 6.0


class Flying(NamedTuple):
    """States between contacts; p, v, a, i and the setpoint are (2, n)."""

    rows: Rows
    p: Array
    v: Array
    a: Array
    i: Array
    goal: Array
    t: Array

    def select(self, rows: Rows | NDArray[np.bool_]) -> Flying:
        """Return the selected candidates."""
        return Flying(self.rows[rows], *(value[..., rows] for value in self[1:]))


class Ends(NamedTuple):
    """Closest approaches to the goal with one sequence of modes; arrays (n,)."""

    modes: tuple[Mode, ...]
    rows: Rows
    miss_m: Array
    x: Array
    y: Array


def step_everything(
    scenario: Scenario, stages: Stages, normal: Array, tangential: Array, grid: ApproachGrid, h: float = 1e-3
) -> list[Ends]:
    """Simulate every mode sequence of a scenario's first sequence of walls, without constraints."""
    walls = [scenario.walls[name] for name in scenario.sequences[0]]
    shape = np.broadcast_shapes(normal.shape, tangential.shape)
    vn, vt = (np.broadcast_to(v, shape).ravel() for v in (normal, tangential))
    fronts: list[tuple[tuple[Mode, ...], Flying]] = [
        ((mode,), _fly_to_first_contact(scenario, stages[walls[0].name, mode], walls[0], vn, vt, grid, h))
        for mode in scenario.modes
    ]
    for wall in walls[1:]:
        fronts = [
            ((*modes, mode), _fly_to_next_contact(scenario, stages[wall.name, mode], wall, front, h))
            for modes, front in fronts
            for mode in scenario.modes
        ]
    ends = []
    for modes, front in fronts:
        stage = stages[walls[-1].name, modes[-1]]
        ends.append(_fly_to_goal(scenario, modes, front, stage.duration_s - stage.engaged_s, h))
    return ends


def _axes(wall: Wall) -> tuple[Array, Array]:
    return np.array(wall.normal)[:, None], np.array(wall.tangent)[:, None]


def _fly_to_first_contact(
    scenario: Scenario, stage: ContactStage, wall: Wall, vn: Array, vt: Array, grid: ApproachGrid, h: float
) -> Flying:
    n, t = _axes(wall)
    b = np.array(scenario.vehicle.airframe.drag_per_s[:2])[:, None]
    v = n * vn + t * vt
    impact = np.stack((grid.impact_x.ravel(), grid.impact_y.ravel()))
    onset = Flying(
        np.arange(vn.size),
        impact - stage.lead_s * v,
        v,
        b * v,
        np.zeros_like(v),
        impact - stage.lead_s * v,
        grid.impact_s.ravel() - stage.lead_s,
    )
    return _pass_contact(scenario, stage, wall, onset, h)


def _pass_contact(scenario: Scenario, stage: ContactStage, wall: Wall, onset: Flying, h: float) -> Flying:
    """Return the states after a contact, which has the same duration for all candidates."""
    kp, kv, ki, kd, tau = PositionLoop.from_px4(scenario.vehicle.px4)
    c, m = stage.coefficients, stage.mass_kg
    n, t = _axes(wall)
    bx, by, _ = scenario.vehicle.airframe.drag_per_s
    n2 = wall.normal[0] ** 2
    bn = n2 * bx + (1.0 - n2) * by

    def parts(value: Array) -> tuple[Array, Array]:
        return (n * value).sum(axis=0), (t * value).sum(axis=0)

    point = np.array(wall.point)[:, None]
    x, v = parts(onset.p - point)[0], parts(onset.v)[0]
    u = parts(onset.v)[1]
    (an, at), (jn, jt) = parts(onset.a), parts(onset.i)
    q, push = np.zeros_like(x), np.zeros_like(x)
    law_x, law_v, x0 = x.copy(), v.copy(), x.copy()
    peak = friction = np.zeros_like(x)
    peak_x, peak_q = x, q
    steps = round(stage.duration_s / h)
    engaged = round(stage.engaged_s / h)
    for step in range(steps):
        if step == engaged:
            rn, rt = peak_x + stage.alphas[0] * peak, peak_q + stage.alphas[1] * friction
        force = -(c.k * x + c.f * v)
        law_force = np.maximum(-(c.k * law_x + c.f * law_v), 0.0)
        better = force > peak
        peak = np.where(better, force, peak)
        peak_x, peak_q = np.where(better, x, peak_x), np.where(better, q, peak_q)
        rub = c.mu * law_force * u
        friction = np.where(np.abs(rub) > np.abs(friction), rub, friction)
        slope_n = force / m + an - bn * v
        slope_t = -rub / m
        en = et = np.zeros_like(x)
        if step >= engaged:
            en, et = kp * (rn - x) - v, kp * (rt - q) - u
        fed_n, fed_t = kd * force / m, kd * slope_t  # the contact's share of the D term is fed forward
        an = an + h * (kv * en + jn + fed_n - kd * slope_n - an) / tau
        at = at + h * (kv * et + jt + fed_t - kd * (slope_t + at) - at) / tau
        jn, jt = jn + h * ki * en, jt + h * ki * et
        push = push + h * (at - c.mu / m * law_force * push)
        v, u = v + h * slope_n, u + h * slope_t
        x, q = x + h * v, q + h * u
        law_v = law_v + h * law_force / m
        law_x = law_x + h * law_v
    goal = onset.p + n * (peak_x + stage.alphas[0] * peak - x0) + t * (peak_q + stage.alphas[1] * friction)
    return Flying(
        onset.rows,
        onset.p + n * (x - x0) + t * q,
        n * v + t * (u + push),
        n * an + t * at,
        n * jn + t * jt,
        goal,
        onset.t + stage.duration_s,
    )


def _free_step(loop: PositionLoop, b: Array, f: Flying, h: float) -> Flying:
    kp, kv, ki, kd, tau = loop
    error = kp * (f.goal - f.p) - f.v
    slope = f.a - b * f.v
    v = f.v + h * slope
    a = f.a + h * (kv * error + f.i - kd * slope - f.a) / tau
    return Flying(f.rows, f.p + h * v, v, a, f.i + h * ki * error, f.goal, f.t + h)


def _fly_to_next_contact(
    scenario: Scenario, stage: ContactStage, wall: Wall, flying: Flying, h: float
) -> Flying:
    loop, n = PositionLoop.from_px4(scenario.vehicle.px4), _axes(wall)[0]
    b = np.array(scenario.vehicle.airframe.drag_per_s[:2])[:, None]
    point = np.array(wall.point)[:, None]
    reached: list[Flying] = []
    flying = flying.select((n * (flying.p - point)).sum(axis=0) > 0.0)
    for _ in range(round(_HORIZON_S / h)):
        flying = _free_step(loop, b, flying, h)
        hits = (n * (flying.p - point + stage.lead_s * flying.v)).sum(axis=0) < 0.0
        if hits.any():
            reached.append(flying.select(hits))
            flying = flying.select(~hits)
        if flying.rows.size == 0:
            break
    if not reached:
        return _pass_contact(scenario, stage, wall, flying.select(np.zeros(0, dtype=np.intp)), h)
    joined = Flying(*(np.concatenate(v, axis=-1) for v in zip(*reached, strict=True)))
    return _pass_contact(scenario, stage, wall, joined, h)


def _fly_to_goal(
    scenario: Scenario, modes: tuple[Mode, ...], flying: Flying, elapsed_s: float, h: float
) -> Ends:
    loop = PositionLoop.from_px4(scenario.vehicle.px4)
    b = np.array(scenario.vehicle.airframe.drag_per_s[:2])[:, None]
    goal = np.array(scenario.goal.position_m)[:, None]
    best = np.hypot(*(flying.p - goal))
    place = flying.p.copy()
    ended: list[tuple[Rows, Array, Array]] = []
    for step in range(1, round(_HORIZON_S / h) + 1):
        flying = _free_step(loop, b, flying, h)
        distance = np.hypot(*(flying.p - goal))
        nearer = distance < best
        best = np.where(nearer, distance, best)
        place = np.where(nearer, flying.p, place)
        if step * h + elapsed_s >= PASSED_AFTER_S:
            passed = distance > best + PASSED_RISE_M
            if passed.any():
                ended.append((flying.rows[passed], best[passed], place[:, passed]))
                flying, best, place = flying.select(~passed), best[~passed], place[:, ~passed]
        if flying.rows.size == 0:
            break
    ended.append((flying.rows, best, place))
    rows, misses, places = (np.concatenate(v, axis=-1) for v in zip(*ended, strict=True))
    return Ends(modes, rows, misses, places[0], places[1])
