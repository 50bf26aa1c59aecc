"""Campaign: hits of a body at oblique walls, with tilt, rate and the next hit (docs/results/body.md).

To measure another body than the configured one, edit `settings` in body.yaml; `vary: [all]` draws all
quantities.
"""

from __future__ import annotations

import math
import statistics
import sys
from collections import Counter
from collections.abc import Iterable, Sequence

import msgspec

from dart_flight.base.geometry import norm, tilt_of
from dart_flight.base.records import ImuSample, Record, TruthContact, TruthSample
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.sim.draws import draw_world
from tests.watched_flight import WatchedFlight, place_walls, rule_of
from tools.campaigns.results import markdown

_AFTER_US = 600_000  # interval for the effect of a hit on tilt and rate


class ObliqueHit(msgspec.Struct, frozen=True):
    """One true contact, and the largest tilt and rate from its onset for 0.6 s or until the next contact."""

    wall: str
    normal_m_s: float
    peak_n: float
    incidence_deg: float
    tilt_deg: float
    rate_deg_s: float


class BodyFlight(msgspec.Struct, frozen=True):
    """One flight with its contacts."""

    outcome: str
    rule: str
    problems: list[str]
    hits: list[ObliqueHit]


def fly(point: Point, seed: int) -> BodyFlight:
    """Fly among rotated walls until landing."""
    mission = point.mission
    turned = dict.fromkeys((w.name for w in mission.walls), float(point.case["yaw_deg"]))
    watched = WatchedFlight(mission, seed, place_walls(draw_world(mission, seed, point.spreads), {}, turned))
    contacts: list[TruthContact] = []
    tilts: list[tuple[int, float]] = []
    rates: list[tuple[int, float]] = []

    def observe(record: Record, number: int) -> None:
        if isinstance(record, TruthContact):
            contacts.append(record)
        elif isinstance(record, TruthSample):
            tilts.append((record.t_us, math.degrees(tilt_of(record.q_frd_to_ned))))
        elif isinstance(record, ImuSample):
            rates.append((record.t_us, math.degrees(norm(record.rate_frd))))

    watched.onlookers.append(observe)
    verdict = watched.run()
    begins = [c.t_us for c in contacts] + [sys.maxsize]
    hits = []
    for contact, following in zip(contacts, begins[1:], strict=True):
        end_us = min(following, contact.t_us + _AFTER_US)
        tilt, rate = (
            max((v for t, v in series if contact.t_us <= t < end_us), default=0.0)
            for series in (tilts, rates)
        )
        hits.append(
            ObliqueHit(
                contact.wall,
                contact.normal_in_m_s,
                contact.peak_normal_force_n,
                math.degrees(contact.incidence_rad),
                tilt,
                rate,
            )
        )
    return BodyFlight(verdict.outcome.value, rule_of(verdict), watched.problems, hits)


_HEADS = ("mission", "wall yaw", "completed", "aborted by", "uncontrolled", "tilt after first hit, deg",
          "rate after it, deg/s", "second hit, m/s", "its force, N", "tilt after it, deg")  # fmt: skip


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a table with a row for every mission and yaw, with median and worst figures."""
    groups: dict[tuple[str, str], list[BodyFlight]] = {}
    for r in rows:
        groups.setdefault((r.mission, r.values["yaw_deg"]), []).append(r.row)
    return markdown(_HEADS, [[*key, *_cells(mine)] for key, mine in groups.items()])


def _cells(mine: Sequence[BodyFlight]) -> list[str]:
    first = [f.hits[0] for f in mine if f.hits]
    second = [hit for f in mine if (hit := next((h for h in f.hits if h.wall != f.hits[0].wall), None))]
    aborted = Counter(f.rule for f in mine if f.outcome != "completed" and not f.problems)
    return [
        f"{sum(f.outcome == 'completed' for f in mine)} of {len(mine)}",
        ", ".join(f"`{rule}` {count}" for rule, count in aborted.most_common()) or "-",
        str(sum(bool(f.problems) for f in mine)),
        _median_and_worst(h.tilt_deg for h in first),
        _median_and_worst(h.rate_deg_s for h in first),
        _median_and_worst((h.normal_m_s for h in second), 2),
        _median_and_worst(h.peak_n for h in second),
        _median_and_worst(h.tilt_deg for h in second),
    ]


def _median_and_worst(values: Iterable[float], digits: int = 0) -> str:
    known = list(values)
    if not known:
        return "-"
    return f"{statistics.median(known):.{digits}f}, {max(known, key=abs):.{digits}f}"
