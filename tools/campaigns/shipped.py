"""Campaign: shipped missions of each vehicle with everything drawn (docs/results/campaigns.md)."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from dart_flight.base.summary import cause_of
from dart_flight.lab.campaign.flight_job import FlownFlight, JudgedRow
from tools.campaigns.results import causes, markdown, median_and_most, rate


class ShippedFlight(msgspec.Struct, frozen=True):
    """One flight; `force_error` is the largest relative error of a measured peak."""

    outcome: str
    reason: str
    followed: bool | None
    uncontrolled: list[str]
    tilt_deg: float | None
    miss_m: float | None
    force_error: float | None


def judge(flown: FlownFlight) -> ShippedFlight:
    """Return the figures of a flight."""
    v = flown.verdict
    errors = [abs(c.force_error) for c in v.collisions if c.force_error is not None]
    return ShippedFlight(
        v.outcome.value, v.reason or "", v.plan_followed, v.uncontrolled, v.max_tilt_deg, v.goal_miss_m,
        max(errors, default=None),
    )  # fmt: skip


_HEADS = ("mission", "completed (95 %)", "uncontrolled", "plan followed", "tilt °: median, most",
          "goal missed m: median, most", "peak off %: median, most", "ended by")  # fmt: skip


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for every mission."""
    missions: dict[str, list[ShippedFlight]] = {}
    for r in rows:
        missions.setdefault(r.mission.removeprefix("missions/").removesuffix(".yaml"), []).append(r.row)
    return markdown(_HEADS, [[f"`{name}`", *_cells(mine)] for name, mine in missions.items()])


def _cells(mine: Sequence[ShippedFlight]) -> list[str]:
    return [
        rate(sum(f.outcome == "completed" for f in mine), len(mine), 1),
        str(sum(bool(f.uncontrolled) for f in mine)),
        str(sum(bool(f.followed) for f in mine)),
        median_and_most(f.tilt_deg for f in mine),
        median_and_most((f.miss_m for f in mine), 2),
        median_and_most((100.0 * f.force_error for f in mine if f.force_error is not None), 1),
        causes(cause_of(f.reason) for f in mine if f.outcome != "completed"),
    ]
