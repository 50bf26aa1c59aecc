"""Campaign: plans of shipped scenarios, predicted and flown (docs/results/planning_agreement.md)."""

from __future__ import annotations

import functools
import statistics
from collections.abc import Sequence

import msgspec

from dart_flight.config.vehicle import packaged
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.lab.search.mission_writer import planned_mission
from dart_flight.lab.search.plan import Plan
from dart_flight.lab.search.scenario import Objective, Scenario, load_scenario
from dart_flight.lab.search.search import search
from dart_flight.run.fast import fly_fast
from tools.campaigns.results import grouped, markdown


class FlownPlan(msgspec.Struct, frozen=True):
    """Pairs of a plan and its flight: speed and peak force of the last hit, and goal miss; None: no hit."""

    completed: bool
    speed_m_s: tuple[float, float] | None
    peak_n: tuple[float, float] | None
    miss_m: tuple[float, float] | None


@functools.cache
def best_plan(name: str, objective: str) -> tuple[Scenario, Plan]:
    """Return the best plan of a shipped scenario."""
    scenario = load_scenario(packaged("missions", "scenarios", f"{name}.yaml"))
    scenario = msgspec.structs.replace(scenario, objective=Objective(objective))
    return scenario, search(scenario, top=1).plans[0]


def fly(point: Point, seed: int) -> FlownPlan:
    """Fly a plan; nothing is drawn."""
    scenario, plan = best_plan(point.case["scenario"], point.case["objective"])
    body = {"vehicle.simulation.contact.body": point.case["body"]}
    v = fly_fast(planned_mission(scenario, plan).replace(body), seed, None)
    planned, true = plan.collisions[-1], v.collisions[-1].truth if v.collisions else None
    if (
        true is None
        or true.normal_m_s is None
        or true.peak_force_n is None
        or len(v.collisions) < len(plan.collisions)
    ):
        return FlownPlan(False, None, None, None)
    miss = None if v.goal_miss_m is None else (plan.goal_miss_m, v.goal_miss_m)
    peaks = (planned.peak_force_n, true.peak_force_n)
    return FlownPlan(v.outcome == "completed", (planned.normal_m_s, true.normal_m_s), peaks, miss)


_HEADS = (
    "scenario",
    "objective",
    "body",
    "completed",
    "last hit m/s: planned, flown",
    "peak N",
    "goal miss m",
)


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for every case: planned figures, and flown ones with mean and deviation."""
    table = []
    for key, mine in grouped(rows, "scenario", "objective", "body").items():
        pairs = [
            ([getattr(f, name) for f in mine if getattr(f, name) is not None], digits)
            for name, digits in (("speed_m_s", 2), ("peak_n", 1), ("miss_m", 3))
        ]
        completed = f"{sum(f.completed for f in mine)} of {len(mine)}"
        table.append([*key, completed, *(_pair(found, digits) for found, digits in pairs)])
    return markdown(_HEADS, table)


def _pair(found: Sequence[tuple[float, float]], digits: int) -> str:
    if not found:
        return "-"
    flown = [value for _, value in found]
    mean, sd = statistics.fmean(flown), statistics.pstdev(flown)
    return f"{found[0][0]:.{digits}f}, {mean:.{digits}f} ± {sd:.{digits}f}"
