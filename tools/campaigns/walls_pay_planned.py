"""Campaign: the optimum of every generated map with and without hits, under each set of limits."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

import msgspec

from dart_flight.config.mission_file import MOTIONS
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from tools.campaigns.results import markdown
from tools.campaigns.walls_pay import flown_cases, plan_map


class PlannedMap(msgspec.Struct, frozen=True):
    """Times of both plans, None without a plan, and the share of the free time that hits save.

    Attributes:
        cruise_ratio: approach speed of the colliding plan over that of the free plan, with limited sight.
    """

    free_s: float | None
    hit_s: float | None
    hits: int
    gain: float | None
    cruise_ratio: float | None


def cases() -> list[dict[str, str]]:
    """Return the cases: every map with every set of limits."""
    return [{**case, "limits": limits} for limits in MOTIONS for case in flown_cases()]


def plan(point: Point, _: int) -> PlannedMap:
    """Plan one map."""
    plans = plan_map(point.case["kind"], int(point.case["map"]), point.case["limits"])
    free, hit = plans.get("free"), plans.get("hit")
    gain = None if free is None or hit is None else 1.0 - hit.plan.time_to_goal_s / free.plan.time_to_goal_s
    cruises = [way and way.plan.cruise_m_s for way in (free, hit)]
    ratio = cruises[1] / cruises[0] if cruises[0] and cruises[1] else None
    hits = len(hit.plan.collisions) if hit else 0
    return PlannedMap(free and free.plan.time_to_goal_s, hit and hit.plan.time_to_goal_s, hits, gain, ratio)


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a table with a row for every kind and set of limits."""
    groups: dict[tuple[str, str], list[PlannedMap]] = {}
    for r in rows:
        groups.setdefault((r.values["kind"], r.values["limits"]), []).append(r.row)
    table = []
    for key, mine in groups.items():
        gains = [planned.gain for planned in mine if planned.gain is not None]
        median = f"{statistics.median(gains):+.1%} ({min(gains):+.1%} to {max(gains):+.1%})" if gains else "-"
        quicker = f"{sum(gain > 0.0 for gain in gains)} of {len(gains)}"
        ratios = [planned.cruise_ratio for planned in mine if planned.cruise_ratio is not None]
        faster = f"{statistics.median(ratios):.2f}" if ratios else "-"
        table.append([*key, str(len(mine)), quicker, median, faster])
    heads = (
        "kind",
        "limits",
        "maps",
        "hit faster",
        "gain of the optimum: median (least to most)",
        "cruise ratio",
    )
    return markdown(heads, table)
