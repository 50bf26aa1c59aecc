"""Pictures of a search: the map of candidates, and the miss over the grid of approach velocities.

matplotlib is in the extra `report`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dart_flight.base.records import Mode
from dart_flight.lab.figure_panels import blank, save
from dart_flight.lab.search.search import Candidates, Plan, Planner, Search
from dart_flight.planning.flight_model import FreeFlight, Leg
from dart_flight.planning.rollout import Arrivals

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

_COLUMNS = 4
_FAN = 40  # trajectories drawn per mode sequence
_COLOURS = ("#1f77b4", "#d95f02", "#2ca02c", "#9467bd", "#8c564b", "#e377c2", "#17becf", "#7f7f7f")
_SHORT = {Mode.RIGID: "rigid", Mode.FLEXIBLE: "flexible"}


def plot_search(result: Search, plan: Plan, path: Path) -> None:
    """Write the picture of a search.

    Args:
        result: from `search`.
        plan: the one that is drawn heavily.
        path: .png, .svg or .pdf.

    Raises:
        InputError: matplotlib is missing, or the file cannot be written or has an unknown ending.
    """
    sequence = [m for m in result.maps if m.sequence == plan.sequence]
    columns = min(len(sequence), _COLUMNS)
    rows = -(-len(sequence) // columns)
    figure = blank(11.0, 6.2 + 3.0 * rows)
    top, bottom = figure.subfigures(2, 1, height_ratios=[6.2, 3.0 * rows])
    _draw_map(top.subplots(), result, sequence, plan)
    axes = bottom.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    image = None
    for k, axis in enumerate(axes.ravel()):
        if k < len(sequence):
            image = _draw_grid(axis, result, sequence[k], plan, k)
        else:
            axis.set_visible(False)
    if image is not None:
        bottom.colorbar(image, ax=axes, label="goal miss m", shrink=0.9)
    save(figure, path)


# --- the map ----------------------------------------------------------------------------------------------


def _draw_map(axis: Axes, result: Search, maps: list[Candidates], plan: Plan) -> None:
    scenario = result.scenario
    for wall in scenario.walls.values():
        half = 0.5 * wall.length_m
        (x, y), (tx, ty) = wall.point, wall.tangent
        hit = wall.name in plan.sequence
        ends = ([x - half * tx, x + half * tx], [y - half * ty, y + half * ty])
        axis.plot(*ends, color="black" if hit else "0.6", lw=3.0, solid_capstyle="butt")
        behind = (x - 0.13 * wall.normal[0] + 0.35 * half * tx, y - 0.13 * wall.normal[1] + 0.35 * half * ty)
        slope = (np.degrees(np.arctan2(ty, tx)) + 90.0) % 180.0 - 90.0
        axis.text(*behind, wall.name, ha="center", va="center", fontsize=9, rotation=slope)
    planner = Planner(scenario)
    rng = np.random.default_rng(1)
    for k, m in enumerate(maps):
        chosen = np.sort(rng.choice(m.rows.size, min(_FAN, m.rows.size), replace=False))
        colour = _COLOURS[k % len(_COLOURS)]
        label = " → ".join(_SHORT[mode] for mode in m.modes) + f" ({m.rows.size} feasible)"
        for j, line in enumerate(_lines(planner, m, chosen)):
            axis.plot(*line, color=colour, lw=0.6, alpha=0.35, label=label if j == 0 else None)
    own = next(m for m in maps if m.modes == plan.modes)
    index = np.flatnonzero((own.normal_m_s == plan.normal_m_s) & (own.tangential_m_s == plan.tangential_m_s))
    colour = _COLOURS[maps.index(own) % len(_COLOURS)]
    for line in _lines(planner, own, index):
        axis.plot(*line, color="white", lw=4.5)
        axis.plot(*line, color=colour, lw=2.5, label=f"plan {plan.rank}: miss {plan.goal_miss_m:.3f} m")
    for i, c in enumerate(plan.collisions, start=1):
        axis.plot(*c.position_m, "o", color=colour, mec="black", ms=7)
        axis.annotate(str(i), c.position_m, (5, 6), textcoords="offset points", fontsize=9)
    axis.plot(*scenario.start, "s", color="black", ms=8, label="start")
    axis.plot(*scenario.goal.position_m, "*", color="gold", mec="black", ms=15, label="goal")
    b = scenario.bounds
    axis.set(xlim=(b.x[0] - 0.1, b.x[1] + 0.1), ylim=(b.y[0] - 0.1, b.y[1] + 0.1), aspect="equal")
    axis.plot(
        [b.x[0], b.x[1], b.x[1], b.x[0], b.x[0]],
        [b.y[0], b.y[0], b.y[1], b.y[1], b.y[0]],
        ":",
        color="0.5",
        lw=1.0,
    )
    axis.set(xlabel="x m", ylabel="y m")
    axis.set_title(
        f"{scenario.name}: {' → '.join(plan.sequence)}, objective {scenario.objective.value}", fontsize=11
    )
    legend = axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=9, frameon=False)
    for sample in legend.get_lines():
        sample.set_alpha(1.0)


def _lines(planner: Planner, m: Candidates, chosen: NDArray[np.intp]) -> list[tuple[Array, Array]]:
    """Paths of some candidates from the start to the closest approach."""
    arrivals = planner.trace(m, chosen)
    start = planner.scenario.start
    lines = []
    for i in range(arrivals.rows.size):
        xs, ys = [np.array([start[0]])], [np.array([start[1]])]
        for x, y in _parts(planner.flight, arrivals, i):
            xs.append(x)
            ys.append(y)
        lines.append((np.concatenate(xs), np.concatenate(ys)))
    return lines


def _parts(flight: FreeFlight, arrivals: Arrivals, i: int) -> list[tuple[Array, Array]]:
    parts = []
    for k, hit in enumerate(arrivals.hits):
        last = k + 1 == len(arrivals.hits)
        until = arrivals.t_s[i] if last else arrivals.hits[k + 1].t_s[i]
        release = hit.t_s[i] + hit.duration_s[i]
        parts.append((hit.x[i : i + 1], hit.y[i : i + 1]))
        parts.append(_path(flight, hit.leg.take(np.array([i])), float(until - release)))
    return parts


def _path(flight: FreeFlight, leg: Leg, duration_s: float) -> tuple[Array, Array]:
    """A flight on a fine grid."""
    times = np.linspace(0.0, max(duration_s, 0.0), 60)
    index = np.minimum((times / flight.times[1]).astype(np.intp), flight.count)
    many = leg.take(np.zeros(times.size, dtype=np.intp))
    at = flight.near(many, index).leg_at(times - flight.times[index])
    return at.x[0] + at.goal_x, at.y[0] + at.goal_y


# --- the grid ---------------------------------------------------------------------------------------------


def _draw_grid(axis: Axes, result: Search, m: Candidates, plan: Plan, k: int) -> Any:
    scenario = result.scenario
    normal, tangential = np.array(scenario.normal_m_s), np.array(scenario.tangential_m_s)
    miss = np.full((normal.size, tangential.size), np.nan)
    miss.ravel()[m.rows] = m.miss_m if m.expected_m is None else m.expected_m
    axis.set_facecolor("0.92")
    image = axis.pcolormesh(
        tangential, normal, miss, cmap="viridis", vmin=0.0, vmax=_scale(result), shading="nearest"
    )
    if m.modes == plan.modes:
        axis.plot(plan.tangential_m_s, plan.normal_m_s, "*", color="red", mec="white", ms=13)
    title = " → ".join(_SHORT[mode] for mode in m.modes)
    axis.set_title(title, fontsize=10, color=_COLOURS[k % len(_COLOURS)])
    axis.set_xlabel("tangential m/s")
    if k % _COLUMNS == 0:
        axis.set_ylabel("normal m/s")
    return image


def _scale(result: Search) -> float:
    values = [m.miss_m for m in result.maps if m.rows.size]
    return float(np.quantile(np.concatenate(values), 0.9))
