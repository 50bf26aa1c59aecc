"""Campaign: hits of a body at oblique walls, with tilt, rate and the next hit (docs/results/body.md)."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence

import msgspec

from dart_flight.base.geometry import norm, tilt_of
from dart_flight.base.records import ImuSample, Record, TruthContact, TruthSample
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.sim.draws import draw_world, parse_vary
from tests.watched_flight import WatchedFlight, place_walls, rule_of
from tools.campaigns.results import causes, grouped, markdown, median_and_most

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
    spreads = parse_vary(("all",), mission.vehicle) if point.case["drawn"] == "all" else {}
    turned = dict.fromkeys((w.name for w in mission.walls), float(point.case["yaw_deg"]))
    watched = WatchedFlight(mission, seed, place_walls(draw_world(mission, seed, spreads), {}, turned))
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


_GUARDS = "simulation.contact.guard_height_m"
_HEADS = ("guards", "drawn", "wall yaw", "completed", "uncontrolled", "tilt °", "rate °/s",
          "second hit m/s: median, least", "ended by")  # fmt: skip


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for every body and size of the yaw, with median and worst figures after a first hit."""
    groups: dict[tuple[str, ...], list[BodyFlight]] = {}
    for (guards, drawn, yaw), mine in grouped(rows, _GUARDS, "drawn", "yaw_deg").items():
        groups.setdefault((guards, drawn, f"{abs(float(yaw)):g}°"), []).extend(mine)
    return markdown(
        _HEADS, [[f"{float(g) * 100:g} cm", drawn, yaw, *_cells(mine)]
                 for (g, drawn, yaw), mine in groups.items()],
    )  # fmt: skip


def _cells(mine: Sequence[BodyFlight]) -> list[str]:
    first = [f.hits[0] for f in mine if f.hits]
    second = [hit for f in mine if (hit := next((h for h in f.hits if h.wall != f.hits[0].wall), None))]
    return [
        f"{sum(f.outcome == 'completed' for f in mine)} of {len(mine)}",
        str(sum(bool(f.problems) for f in mine)),
        median_and_most(h.tilt_deg for h in first),
        median_and_most(h.rate_deg_s for h in first),
        median_and_most((-h.normal_m_s for h in second), 2, min),
        causes(f.rule for f in mine if f.outcome != "completed" and not f.problems),
    ]
