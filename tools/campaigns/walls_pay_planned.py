"""Campaign: the optimum of every generated map with and without hits, under each set of limits."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence

import msgspec

from dart_flight.config.mission_file import MOTIONS
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from tools.campaigns.results import grouped, markdown, median_and_most
from tools.campaigns.walls_pay import flown_cases, plan_map


class PlannedMap(msgspec.Struct, frozen=True):
    """The time that hits save on one map, and the effort of the search.

    Attributes:
        gain: saved share of the duration of the collision-free flight; None if a plan is missing.
        cruise_ratio: approach speed of the colliding plan over that of the collision-free plan, or None.
    """

    gain: float | None
    cruise_ratio: float | None
    searched_s: float


def cases() -> list[dict[str, str]]:
    """Return the cases: every map with every set of limits."""
    return [{**case, "limits": limits} for limits in MOTIONS for case in flown_cases()]


def plan(point: Point, _: int) -> PlannedMap:
    """Plan one map."""
    began_s = time.process_time()
    plans = plan_map(point.case["kind"], int(point.case["map"]), point.case["limits"])
    searched_s = time.process_time() - began_s
    free, hit = plans.get("free"), plans.get("hit")
    gain = None if free is None or hit is None else 1.0 - hit.plan.time_to_goal_s / free.plan.time_to_goal_s
    cruises = [way and way.plan.cruise_m_s for way in (free, hit)]
    ratio = cruises[1] / cruises[0] if cruises[0] and cruises[1] else None
    return PlannedMap(gain, ratio, searched_s)


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for every kind with the gain under each set of limits, and the effort of the search."""
    table = []
    for (kind,) in grouped(rows, "kind"):
        by_limits = grouped((r for r in rows if r.values["kind"] == kind), "limits")
        cells = [_gains(by_limits.get((limits,), [])) for limits in MOTIONS]
        table.append([kind, *cells])
    effort = median_and_most((r.row.searched_s for r in rows), 1)
    heads = ("kind", *(f"limits `{limits}`" for limits in MOTIONS))
    return f"{markdown(heads, table)}\nA search took {effort} s (median, most)."


def _gains(planned: Sequence[PlannedMap]) -> str:
    """Return the median gain; with limited sight, the median ratio of the cruise speeds."""
    ratios = [p.cruise_ratio for p in planned if p.cruise_ratio is not None]
    gains = [100.0 * p.gain for p in planned if p.gain is not None]
    if ratios:
        return f"cruise × {statistics.median(ratios):.2f}"
    return f"{statistics.median(gains):+.1f} %" if gains else "-"
