"""The result of a search as tables and sentences, and as the object of `plan --json`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import msgspec
from rich.table import Table

from dart_flight.config.packages import install_command
from dart_flight.lab.search.free_plan import FreePlan, limits_of
from dart_flight.lab.search.quickest import QuickestPlan, QuickestResult
from dart_flight.lab.search.scenario import Objective, Scenario
from dart_flight.lab.search.search import ADVICE, Plan, SearchResult

_FORCE = "peak (normal,\nalong) N"  # the force that limits.peak_force_n limits, and its parts
_SHOWN_S = 0.005  # a smaller gap is not shown
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
        "free": result.free,
        "plans": result.plans,
        "vehicle": result.scenario.vehicle_source,
    }


def plan_table(result: SearchResult) -> Table:
    """Return a table of the best plans, with one row per collision."""
    objective = result.scenario.objective
    table = Table(
        title=f"{result.scenario.name}: best by {objective.value}",
        title_justify="left",
        box=None,  # to fit into eighty columns with the objective robust
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
    edge = _at_edge(result.scenario, result.plans[0])
    if edge:
        table.caption += f"\nplan 1 is at the edge of `search` ({edge}): a wider grid may have a better one"
    table.caption += "\n" + describe_free(result.free, result.plans[0])
    table.caption_justify = "left"
    return table


def _at_edge(scenario: Scenario, best: Plan) -> str:
    """Return the approach velocities of a plan that are the first or last of their grid, as text."""
    spec = scenario.spec.search
    if spec is None:
        return ""
    chosen = {"normal_m_s": best.normal_m_s, "tangential_m_s": best.tangential_m_s}
    grids = {name: getattr(spec, name) for name in chosen}
    return ", ".join(
        f"{name} {value:g}"
        for name, value in chosen.items()
        if grids[name].min < grids[name].max and value in (grids[name].min, grids[name].max)
    )


def describe_free(free: FreePlan | None, best: Plan) -> str:
    if free is None:
        return (
            "without any collision: the time is unknown, because ruckig is not installed: "
            f"{install_command('plan')}"
        )
    if free.time_s is None:
        return "without any collision: no path reaches the goal"
    limits, gap = free.limits, ""
    if free.gap_s > _SHOWN_S:
        gap = f", {free.time_s - free.gap_s:.2f} s at best"
    jerk = "" if limits.jerk_m_s3 is None else f", {limits.jerk_m_s3:g} m/s3"
    text = (
        f"without any collision: {free.time_s:.2f} s{gap} "
        f"({limits.speed_m_s:g} m/s, {limits.acceleration_m_s2:g} m/s2{jerk})"
    )
    if best.saving_s is None or best.time_to_rest_s is None:
        return text
    verb = "would save" if best.saving_s > 0.0 else "would lose"
    return (
        f"{text}; plan 1 rests after {best.time_to_rest_s:.2f} s: the hit {verb} {abs(best.saving_s):.2f} s"
    )


def quickest_summary(result: QuickestResult) -> dict[str, Any]:
    """Return the object of `plan --json` for the objective quickest."""
    limits = limits_of(result.scenario)
    return {
        "scenario": result.scenario.name,
        "objective": result.scenario.objective.value,
        "elapsed_s": result.elapsed_s,
        "computed": result.computed,
        "pruned": result.pruned,
        "gap_s": result.gap_s,
        "most_hits": result.most_hits,
        "free": result.free
        and {"time_s": result.free.time_s, "limits": limits, "cruise_m_s": result.free.cruise_m_s},
        "plans": [
            {
                "time_to_goal_s": plan.time_s,
                "saving_s": result.free and result.free.time_s - plan.time_s,
                "collisions": plan.trajectory.hits,
                "visits_s": plan.trajectory.visits_s,
                "cruise_m_s": plan.cruise_m_s,
            }
            for plan in _in_order(result)
        ],
        "vehicle": result.scenario.vehicle_source,
    }


def _in_order(result: QuickestResult) -> list[QuickestPlan]:
    others = (plan for plan in (result.free, result.colliding) if plan is not None and plan != result.best)
    return [result.best, *others]


def quickest_table(result: QuickestResult) -> Table:
    """Return a table of the hits of the best plan and of the other plan, if there is another plan."""
    table = Table(title=f"{result.scenario.name}: quickest", title_justify="left", box=None, pad_edge=False)
    for column in ("", "wall", "mode"):
        table.add_column(column, overflow="fold")
    for column in ("at\ns", "normal\nm/s", "along\nm/s", _FORCE, "goal\ns"):
        table.add_column(column, justify="right", no_wrap=True)
    for rank, plan in enumerate(_in_order(result), start=1):
        if not plan.trajectory.hits:
            table.add_row(str(rank), "no collision", "", "", "", "", "", f"{plan.time_s:.2f}")
        for i, hit in enumerate(plan.trajectory.hits):
            figures = (hit.t_s, hit.normal_m_s, hit.tangential_m_s)
            row = [str(rank) if i == 0 else "", hit.wall, hit.mode.value, *(f"{v:.2f}" for v in figures)]
            row.append(_force(hit.peak_force_n, hit.peak_friction_n))
            table.add_row(*row, f"{plan.time_s:.2f}" if i == 0 else "")
    return table


def describe_quickest(result: QuickestResult) -> str:
    """Return a sentence that compares the colliding plan with the free plan."""
    limits, gap = limits_of(result.scenario), ""
    jerk = "" if limits.jerk_m_s3 is None else f", {limits.jerk_m_s3:g} m/s3"
    text = f"planned, at {limits.speed_m_s:g} m/s, {limits.acceleration_m_s2:g} m/s2{jerk}: "
    if result.free is None:
        text += "the goal cannot be reached without a collision"
    elif result.saving_s is None:
        text += f"{result.free.time_s:.2f} s without a collision; no flight with collisions can be faster"
    else:
        verb = "would save" if result.saving_s > 0.0 else "would lose"
        share = abs(result.saving_s) / result.free.time_s
        text += (
            f"{result.free.time_s:.2f} s without a collision; colliding {verb} {abs(result.saving_s):.2f} s"
        )
        text += f" ({share:.0%})"
        if result.saving_s < 0.0 and result.best is result.colliding:
            text += "; the scenario requires the collisions"
    if result.free and result.free.cruise_m_s is not None:
        cruises = [f"{plan.cruise_m_s:.2f}" for plan in (result.free, result.colliding) if plan is not None]
        text += f"; the cruise speed until the wall comes into sight is {' and '.join(cruises)} m/s"
    if result.gap_s > _SHOWN_S:
        gap = f"; sequences that were not computed could be faster by at most {result.gap_s:.2f} s"
    if result.most_hits is not None:
        gap += f"; sequences of more than {result.most_hits} hits were not computed"
    return f"{text}; {result.computed} sequences computed, {result.pruned} ruled out{gap}"


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
