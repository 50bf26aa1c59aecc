"""The result of a search as tables and sentences, and as the object of `plan --json`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import msgspec
from rich.table import Table

from dart_flight.config.packages import install_command
from dart_flight.lab.search.plan import FreeTime, MotionLimits, Plan, SearchResult
from dart_flight.lab.search.scenario import Objective, Scenario
from dart_flight.lab.search.search import ADVICE

_FORCE = "peak (normal,\nalong) N"  # the force that limits.peak_force_n limits, and its components
_SHOWN_S = 0.005  # minimum gap that is shown
_UNITS = {
    Objective.NEAREST: "m",
    Objective.FASTEST: "s",
    Objective.GENTLEST: "N",
    Objective.ROBUST: "m",
    Objective.QUICKEST: "s",
}


def with_objective(scenario: Scenario, objective: Objective) -> Scenario:
    return msgspec.structs.replace(scenario, objective=objective)


def plan_summary(result: SearchResult, refused: Mapping[int, str] | None = None) -> dict[str, Any]:
    """Return the object of `plan --json`: ranking, rejected candidates by reason, and time used.

    `refused` gives the reason for each plan whose mission is refused, by rank.
    """
    missions = {"mission": {"count": len(refused), "advice": "; ".join(refused.values())}} if refused else {}
    free: FreeTime | dict[str, Any] | None = result.free_time
    if result.free is not None:
        limits = MotionLimits.from_scenario(result.scenario)
        free = {"time_s": result.free.time_to_goal_s, "limits": limits, "cruise_m_s": result.free.cruise_m_s}
    shown = [name for name in Plan.__struct_fields__ if name != "legs"]  # `-o` writes the trajectories (legs)
    return {
        "scenario": result.scenario.name,
        "objective": result.scenario.objective.value,
        "score_unit": _UNITS[result.scenario.objective],
        "candidates": result.candidates,
        "feasible": result.feasible,
        "trajectories": result.trajectories,
        "refused": {
            reason.value: {"count": count, "advice": ADVICE[reason]}
            for reason, count in result.refused.items()
        }
        | missions,
        "elapsed_s": result.elapsed_s,
        "gap_s": result.gap_s,
        "most_hits": result.most_hits,
        "free": free,
        "plans": [{name: getattr(plan, name) for name in shown} for plan in result.plans],
        "vehicle": result.scenario.vehicle_source,
    }


def plan_table(result: SearchResult) -> Table:
    """Return a table of the best plans, with one row per collision."""
    objective = result.scenario.objective
    table = Table(
        title=f"{result.scenario.name}: best by {objective.value}",
        title_justify="left",
        box=None,  # the table of the objective robust must fit into eighty columns
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    for column in ("", "wall", "mode"):
        table.add_column(column, overflow="fold")
    columns = ["normal\nm/s", "along\nm/s", _FORCE, "goal\nmiss m", "goal\nat s"]
    if objective is Objective.ROBUST:
        columns += ["mean\nmiss m", "worst\nmiss m", "draws\nfailed"]
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    for plan in result.plans:
        for i, c in enumerate(plan.collisions):
            head = [str(plan.rank) if i == 0 else ""]
            row = [
                *head,
                c.wall,
                c.mode.value,
                f"{c.normal_m_s:.3f}",
                f"{c.tangential_m_s:.3f}",
                _force(c.peak_force_n, c.peak_friction_n),
            ]
            table.add_row(*row, *(_tail(plan) if i == 0 else []))
    table.caption = (
        f"{result.feasible} of {result.candidates} candidates feasible, {result.trajectories} trajectories "
        f"in {result.elapsed_s:.3f} s"
    )
    edge = _at_edge(result.scenario, result.best)
    if edge:
        table.caption += f"\nplan 1 is at the edge of the search grid ({edge}): "
        table.caption += "widen `search` to look for a better plan"
    table.caption += "\n" + describe_free(result.free_time, result.best)
    table.caption_justify = "left"
    return table


def _at_edge(scenario: Scenario, best: Plan) -> str:
    """Name the components of a plan's approach velocity that are the first or last value of their grid."""
    spec = scenario.spec.search
    if spec is None:
        return ""
    chosen = {name: getattr(best.collisions[0], name) for name in ("normal_m_s", "tangential_m_s")}
    grids = {name: getattr(spec, name) for name in chosen}
    return ", ".join(
        f"{name} {value:g}"
        for name, value in chosen.items()
        if grids[name].min < grids[name].max and value in (grids[name].min, grids[name].max)
    )


def describe_free(free: FreeTime | None, best: Plan) -> str:
    if free is None:
        return (
            "without any collision: the time is unknown, because ruckig is not installed: "
            f"{install_command('plan')}"
        )
    if free.time_s is None:
        return "without any collision: no path reaches the goal"
    gap = f", {free.time_s - free.gap_s:.2f} s at best" if free.gap_s > _SHOWN_S else ""
    text = f"without any collision: {free.time_s:.2f} s{gap} ({_limits(free.limits)})"
    if best.saving_s is None or best.time_to_rest_s is None:
        return text
    verb = "would save" if best.saving_s > 0.0 else "would lose"
    return (
        f"{text}; plan 1 rests after {best.time_to_rest_s:.2f} s: the hit {verb} {abs(best.saving_s):.2f} s"
    )


def _limits(limits: MotionLimits) -> str:
    jerk = "" if limits.jerk_m_s3 is None else f", {limits.jerk_m_s3:g} m/s3"
    return f"{limits.speed_m_s:g} m/s, {limits.acceleration_m_s2:g} m/s2{jerk}"


def quickest_table(result: SearchResult) -> Table:
    """Return a table of the hits of the best plan and, if there is a second plan, of the second plan."""
    table = Table(title=f"{result.scenario.name}: quickest", title_justify="left", box=None, pad_edge=False)
    for column in ("", "wall", "mode"):
        table.add_column(column, overflow="fold")
    for column in ("at\ns", "normal\nm/s", "along\nm/s", _FORCE, "goal\ns"):
        table.add_column(column, justify="right", no_wrap=True)
    for plan in result.plans:
        goal_s = f"{plan.time_to_goal_s:.2f}"
        if not plan.collisions:
            table.add_row(str(plan.rank), "no collision", "", "", "", "", "", goal_s)
        for i, c in enumerate(plan.collisions):
            figures = (c.t_s, c.normal_m_s, c.tangential_m_s)
            row = [str(plan.rank) if i == 0 else "", c.wall, c.mode.value, *(f"{v:.2f}" for v in figures)]
            table.add_row(*row, _force(c.peak_force_n, c.peak_friction_n), goal_s if i == 0 else "")
    return table


def describe_quickest(result: SearchResult) -> str:
    """Return a sentence that compares the colliding plan with the free plan."""
    free, hits, saving_s, gap = result.free, result.colliding, result.saving_s, ""
    text = f"planned, at {_limits(MotionLimits.from_scenario(result.scenario))}: "
    if free is None:
        text += "the goal cannot be reached without a collision"
    elif hits is None or saving_s is None:
        text += f"{free.time_to_goal_s:.2f} s without a collision; no flight with collisions can be faster"
    else:
        verb = "would save" if saving_s > 0.0 else "would lose"
        text += f"{free.time_to_goal_s:.2f} s without a collision; colliding {verb} {abs(saving_s):.2f} s"
        text += f" ({abs(saving_s) / free.time_to_goal_s:.0%})"
        if saving_s < 0.0 and result.best is hits:
            text += "; the scenario requires the collisions"
    if free and free.cruise_m_s is not None:
        cruises = [f"{plan.cruise_m_s:.2f}" for plan in (free, hits) if plan is not None]
        text += f"; the cruise speed until the wall comes into sight is {' and '.join(cruises)} m/s"
    if result.gap_s > _SHOWN_S:
        gap = f"; sequences that were not computed could be faster by at most {result.gap_s:.2f} s"
    if result.most_hits is not None:
        gap += f"; sequences of more than {result.most_hits} hits were not computed"
    ruled_out = result.candidates - result.trajectories
    return f"{text}; {result.trajectories} sequences computed, {ruled_out} ruled out{gap}"


def _force(normal_n: float, friction_n: float) -> str:
    return f"{math.hypot(normal_n, friction_n):.1f} ({normal_n:.0f}, {friction_n:.0f})"


def _tail(plan: Plan) -> list[str]:
    tail = [f"{plan.goal_miss_m:.3f}", f"{plan.time_to_goal_s:.2f}"]
    if plan.expected_miss_m is not None:
        tail += [f"{plan.expected_miss_m:.3f}", f"{plan.worst_miss_m:.3f}", f"{plan.failed_draws or 0.0:.0%}"]
    return tail


def refusal_table(result: SearchResult) -> Table:
    """Return a table of rejected candidates by reason, with advice."""
    table = Table(title="refused", title_justify="left")
    for column in ("reason", "candidates", "to relax"):
        table.add_column(column, justify="right" if column == "candidates" else "left")
    for reason, count in sorted(result.refused.items(), key=lambda item: -item[1]):
        table.add_row(reason.value, str(count), ADVICE[reason])
    return table
