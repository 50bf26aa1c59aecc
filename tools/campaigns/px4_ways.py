"""Campaign: missions that use collisions on a real PX4, and the free flights of their scenarios."""

from __future__ import annotations

import functools
import itertools
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

import msgspec

from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.recording.reader import read_log
from dart_flight.run.px4_flight import fly_px4
from dart_flight.sim.px4.installation import ENVIRONMENT
from tests.arrival import arrival_of
from tools.campaigns.arrivals import COLLIDING, FREE, USING_COLLISIONS, both_ways
from tools.campaigns.px4 import hit_of, spread
from tools.campaigns.results import grouped, markdown


class FlownVariant(msgspec.Struct, frozen=True):
    """One flight of a mission that uses collisions, or of its free flight, with the speeds of its hits."""

    outcome: str
    followed: bool | None
    places: str
    planned_s: float
    flown_s: float | None
    hits_m_s: list[float | None]
    tilt_deg: float | None
    final_m: float | None


_both_ways = functools.cache(both_ways)


def cases() -> list[dict[str, str]]:
    """Return the cases: every mission with and without collisions."""
    return [
        {"flown": name, "way": way} for name, way in itertools.product(USING_COLLISIONS, (COLLIDING, FREE))
    ]


def fly(point: Point, seed: int) -> FlownVariant:
    """Fly one variant on the PX4 of `--px4`."""
    both, way = _both_ways(point.case["flown"]), point.case["way"]
    mission = both.missions[way]
    with tempfile.TemporaryDirectory() as folder:
        v = fly_px4(mission, os.environ[ENVIRONMENT], seed, Path(folder))
        arrival = None if v.log is None else arrival_of(read_log(v.log), mission, both.visits)
    there = arrival.there_s if arrival is not None and v.outcome == "completed" else None
    passed = 0 if arrival is None else len(arrival.visits_us)
    return FlownVariant(
        v.outcome.value,
        v.plan_followed,
        f"{passed} of {len(both.visits)}",
        both.planned_s(way),
        there,
        [hit_of(c).normal_m_s for c in v.collisions],
        v.max_tilt_deg,
        v.final_error_m,
    )


_HEADS = ("mission", "completed", "plans followed", "colliding: planned, flown s", "free: planned, flown s")


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for every mission, with medians."""
    table = []
    for (name,), mine in grouped(rows, "flown").items():
        by_way = grouped((r for r in rows if r.values["flown"] == name), "way")
        times = [_times(by_way[way,]) for way in (COLLIDING, FREE)]
        completed = sum(f.outcome == "completed" for f in mine)
        colliding = by_way[COLLIDING,]  # a flight without hits has no plan to follow
        followed = sum(bool(f.followed) for f in colliding)
        table.append([f"`{name}`", f"{completed} of {len(mine)}", f"{followed} of {len(colliding)}", *times])
    return markdown(_HEADS, table)


def _times(mine: Sequence[FlownVariant]) -> str:
    return f"{mine[0].planned_s:.2f}, {spread([f.flown_s for f in mine], 2).partition(' ')[0]}"
