"""The planner's flight model, solved by an ODE solver to 1e-10.

`tests/planning` compares the planner with this solution. The docstrings of `contact_stage` and `flight_model`
define the model; the durations of a contact come from `contact`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from dart_flight.base.records import Mode
from dart_flight.base.walls import Wall
from dart_flight.config.vehicle import Coefficients
from dart_flight.core.mission.position_loop import PositionLoop
from dart_flight.core.mission.recovery import PASSED_AFTER_S, PASSED_RISE_M
from dart_flight.lab.search.scenario import Scenario
from dart_flight.planning.approach_grid import ApproachGrid
from dart_flight.planning.contact_stage import ContactStage
from dart_flight.planning.rollout import Stages

Array = NDArray[np.float64]
_PRECISE: dict[str, Any] = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-12}


class Terminal(NamedTuple):
    """The end of a candidate: time of closest approach since the run-up, position, velocity, distance."""

    t_s: float
    x: float
    y: float
    vx: float
    vy: float
    miss_m: float


# --- ODE solver -------------------------------------------------------------------------------------------


def _friction_peak(c: Coefficients, mass: float, lead: float, vn: float) -> float:
    """Return the largest mu lx u per unit of u at the onset, from the contact law alone."""

    def law(_: float, z: Array) -> list[float]:
        x, v, u = z
        force = max(0.0, -(c.k * x + c.f * v))
        return [v, force / mass, -c.mu / mass * force * u]

    end = math.pi / math.sqrt(c.k / mass)
    solution = solve_ivp(
        law, (0.0, end), [-lead * vn, vn, 1.0], dense_output=True, max_step=end / 50, **_PRECISE
    )
    times = np.linspace(0.0, end, 4001)

    def rub(t: float) -> float:
        x, v, u = solution.sol(t)
        return float(c.mu * max(0.0, -(c.k * x + c.f * v)) * u)

    values = [rub(t) for t in times]
    best = int(np.argmax(values))
    low, high = times[max(best - 1, 0)], times[min(best + 1, times.size - 1)]
    for _ in range(45):  # the function is unimodal: thirds leave 1e-8 of the interval
        a, b = low + (high - low) / 3.0, high - (high - low) / 3.0
        if rub(a) < rub(b):
            low = a
        else:
            high = b
    return rub(0.5 * (low + high))


def _contact_ode(
    stage: ContactStage,
    loop: PositionLoop,
    drag: float,
    normal: list[float],
    slide: list[float],
) -> tuple[list[float], list[float], float, float]:
    """Solve a contact from its onset, where `normal` and `slide` are (v, a, i).

    Until the setpoint, the vehicle commands its own motion and feeds forward the D term's response to the
    push of the contact.

    Returns:
        (x, v, a, i) and (q, v, a, i) at the release, and both setpoints.
    """
    c, m = stage.coefficients, stage.mass_kg
    kp, kv, ki, kd, tau = loop
    vn, an, jn = normal
    vt, at, jt = slide

    def control(r: float | None, z: list[float], acceleration: float, push: float) -> tuple[float, float]:
        p, v, a, i = z
        error = 0.0 if r is None else kp * (r - p) - v
        return (kv * error + i + kd * push - kd * acceleration - a) / tau, ki * error

    def rates(late: tuple[float, float] | None) -> Any:
        def function(t: float, z: Array) -> list[float]:
            x, v, a, i, q, u, d, ta, ti, lx, lv = z
            r, s = (None, None) if late is None else late
            push = -(c.k * x + c.f * v) / m
            acceleration = push + a - drag * v
            da, di = control(r, [x, v, a, i], acceleration, push)
            force = -(c.k * lx + c.f * lv)
            rub = -c.mu / m * force
            dta, dti = control(s, [q, u, ta, ti], rub * u + ta, rub * u)
            return [v, acceleration, da, di, u, rub * u, rub * d + ta, dta, dti, lv, force / m]

        return function

    x0 = -stage.lead_s * vn
    z = np.array([x0, vn, an, jn, 0.0, vt, 0.0, at, jt, x0, vn])
    limit = stage.duration_s / 60
    to_peak = solve_ivp(rates(None), (0.0, stage.peak_s), z, max_step=limit, **_PRECISE).y[:, -1]
    force = -(c.k * to_peak[0] + c.f * to_peak[1])
    friction = -_friction_peak(c, m, stage.lead_s, vn) * vt
    set_n = to_peak[0] + stage.alphas[0] * force
    set_t = to_peak[4] - stage.alphas[1] * friction
    z = solve_ivp(rates(None), (stage.peak_s, stage.engaged_s), to_peak, max_step=limit, **_PRECISE).y[:, -1]
    if stage.duration_s > stage.engaged_s:
        span = (stage.engaged_s, stage.duration_s)
        z = solve_ivp(rates((set_n, set_t)), span, z, max_step=limit, **_PRECISE).y[:, -1]
    return list(z[:4]), [z[4], z[5] + z[6], z[7], z[8]], float(set_n), float(set_t)


def solve_candidate(
    scenario: Scenario,
    sequence: tuple[str, ...],
    modes: tuple[Mode, ...],
    stages: Stages,
    velocity: tuple[float, float],
    grid: ApproachGrid,
) -> Terminal:
    """Solve one candidate with the ODE solver; `grid` holds only its approach."""
    loop = PositionLoop.from_px4(scenario.vehicle.px4)
    b = scenario.vehicle.airframe.drag_per_s
    walls = [scenario.walls[name] for name in sequence]
    vn, vt = velocity
    wall, stage = walls[0], stages[sequence[0], modes[0]]
    bn, bt = _drags(wall, b)
    n, t = np.array(wall.normal), np.array(wall.tangent)
    onset = np.array([float(grid.impact_x), float(grid.impact_y)]) - stage.lead_s * (vn * n + vt * t)
    time = float(grid.impact_s) - stage.lead_s
    normal = [vn, bn * vn, 0.0]
    slide = [vt, bt * vt, 0.0]
    for k in range(len(walls)):
        out_n, out_t, set_n, set_t = _contact_ode(stage, loop, bn, normal, slide)
        x0 = -stage.lead_s * normal[0]
        goal = onset + (set_n - x0) * n + set_t * t
        start = onset + (out_n[0] - x0) * n + out_t[0] * t
        z = np.concatenate([start, *(out_n[i] * n + out_t[i] * t for i in (1, 2, 3))])
        time += stage.duration_s
        if k + 1 == len(walls):
            break
        wall, next_stage = walls[k + 1], stages[sequence[k + 1], modes[k + 1]]
        n, t = np.array(wall.normal), np.array(wall.tangent)
        bn, bt = _drags(wall, b)
        after, z = _to_wall(z, goal, loop, b, wall, next_stage.lead_s)
        time += after
        stage, onset = next_stage, z[:2]
        parts = [np.array([z[2 * i : 2 * i + 2] @ n, z[2 * i : 2 * i + 2] @ t]) for i in (1, 2, 3)]
        normal, slide = [part[0] for part in parts], [part[1] for part in parts]
    since = stage.duration_s - stage.engaged_s
    return _to_goal(z, goal, loop, b, np.array(scenario.goal.position_m), (time, since))


def _drags(wall: Wall, b: tuple[float, float, float]) -> tuple[float, float]:
    n2 = wall.normal[0] ** 2
    return n2 * b[0] + (1.0 - n2) * b[1], n2 * b[1] + (1.0 - n2) * b[0]


def _free(goal: Array, loop: PositionLoop, b: tuple[float, float, float]) -> Any:
    kp, kv, ki, kd, tau = loop
    drag = np.array(b[:2])

    def rates(_: float, z: Array) -> Array:
        p, v, a, i = z[0:2], z[2:4], z[4:6], z[6:8]
        error = kp * (goal - p) - v
        slope = a - drag * v
        return np.concatenate([v, slope, (kv * error + i - kd * slope - a) / tau, ki * error])

    return rates


def _to_wall(
    z: Array, goal: Array, loop: PositionLoop, b: tuple[float, float, float], wall: Wall, lead: float
) -> tuple[float, Array]:
    n, point = np.array(wall.normal), np.array(wall.point)

    def onset(_: float, z: Array) -> float:
        return float((z[:2] - point) @ n + lead * (z[2:4] @ n))

    onset.terminal, onset.direction = True, -1.0  # type: ignore[attr-defined]
    solution = solve_ivp(_free(goal, loop, b), (0.0, 10.0), z, events=onset, **_PRECISE)
    return float(solution.t[-1]), solution.y[:, -1]


def _to_goal(
    z: Array,
    goal: Array,
    loop: PositionLoop,
    b: tuple[float, float, float],
    target: Array,
    times: tuple[float, float],
) -> Terminal:
    release, since = times
    solution = solve_ivp(_free(goal, loop, b), (0.0, 6.0), z, dense_output=True, **_PRECISE)
    t = np.linspace(0.0, 6.0, 6001)
    states = solution.sol(t)
    distance = np.hypot(states[0] - target[0], states[1] - target[1])
    least = np.minimum.accumulate(distance)
    rising = (distance > least + PASSED_RISE_M) & (t + since >= PASSED_AFTER_S)
    last = int(rising.argmax()) if rising.any() else t.size
    i = int(np.argmin(distance[:last]))

    def slope(s: float) -> float:
        y = solution.sol(s)
        return float((y[:2] - target) @ y[2:4])

    low, high = t[max(i - 1, 0)], t[min(i + 1, t.size - 1)]
    best = brentq(slope, low, high, xtol=1e-13) if slope(low) * slope(high) < 0.0 else t[i]
    x, y, vx, vy = (float(v) for v in solution.sol(best)[:4])
    return Terminal(release + best, x, y, vx, vy, math.hypot(x - target[0], y - target[1]))
