"""Campaign: true second impact and goal, with and without replanning (docs/results/replanning.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from dart_flight.base.geometry import distance2
from dart_flight.base.records import AfterImpact, Record, TruthContact, TruthSample
from dart_flight.config.mission import Mission
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.planning.predicted_flight import predict_mission
from dart_flight.sim.draws import draw_world, parse_vary
from tests.watched_flight import WatchedFlight, rule_of
from tools.campaigns.results import causes, grouped, markdown, rate

_RISE_M = 0.03  # increase of the distance to the goal that confirms a closest approach


class Replanned(msgspec.Struct, frozen=True):
    """One flight; the second impact's error is infinite if the second wall was not hit.

    Attributes:
        off_m_s: error of the true normal velocity at the second wall against the planned one.
        miss_m: distance to the goal at the first closest approach after the last contact.
        capture_s: time from the end of the last contact until the goal is held.
    """

    outcome: str
    rule: str
    problems: list[str]
    off_m_s: float | None
    miss_m: float | None
    capture_s: float | None


def fly(point: Point, seed: int) -> Replanned:
    """Fly the mission with one setting of `after_impact` until landing."""
    mission = msgspec.structs.replace(point.mission, after_impact=AfterImpact(point.case["after_impact"]))
    spreads = parse_vary((point.case["drawn"],), mission.vehicle)
    watched = WatchedFlight(mission, seed, draw_world(mission, seed, spreads))
    contacts: list[TruthContact] = []
    track: list[tuple[int, float]] = []

    def observe(record: Record, number: int) -> None:
        if isinstance(record, TruthContact):
            contacts.append(record)
        elif isinstance(record, TruthSample):
            track.append((record.t_us, distance2(record.position_mission, mission.goal.position_m)))

    watched.onlookers.append(observe)
    verdict = watched.run()
    last = mission.collisions[-1]
    second = next((c for c in contacts if c.wall == last.wall.name), None)
    planned = predict_mission(mission).hits[last.index].normal_m_s
    miss, capture = (None, None) if second is None else _goal_figures(mission, second.end_us, track)
    off = None if second is None else abs(second.normal_in_m_s - planned)
    return Replanned(verdict.outcome.value, rule_of(verdict), watched.problems, off, miss, capture)


def _goal_figures(
    mission: Mission, end_us: int, track: Sequence[tuple[int, float]]
) -> tuple[float, float | None]:
    """Return the first closest approach to the goal after a time, m, and the time until goal hold, s."""
    after = [(t, d) for t, d in track if t >= end_us]
    least = math.inf
    for _, distance in after:
        if distance > least + _RISE_M:
            break
        least = min(least, distance)
    since: int | None = None
    for t_us, distance in after:
        since = (since or t_us) if distance <= mission.goal.capture_radius_m else None
        if since is not None and t_us - since >= 0.9e6 * mission.goal.hold_s:
            return least, (since - end_us) * 1e-6
    return least, None


_HEADS = ("drawn", "after an impact", "completed (95 %)", "uncontrolled",
          "second impact off m/s: median, 95th",
          "goal missed m: median, 95th", "goal held after s", "ended by")  # fmt: skip


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a table with a row for each kind of draws and setting of `after_impact`."""
    groups = grouped(rows, "drawn", "after_impact")
    return markdown(_HEADS, [[*key, *_cells(mine)] for key, mine in groups.items()])


def _cells(mine: Sequence[Replanned]) -> list[str]:
    errors = [math.inf if flight.off_m_s is None else flight.off_m_s for flight in mine]
    misses = [math.inf if flight.miss_m is None else flight.miss_m for flight in mine]
    captures = [flight.capture_s for flight in mine if flight.capture_s is not None]
    return [
        rate(sum(flight.outcome == "completed" for flight in mine), len(mine)),
        str(sum(bool(flight.problems) for flight in mine)),
        f"{np.median(errors):.3f}, {np.quantile(errors, 0.95, method='lower'):.3f}",
        f"{np.median(misses):.3f}, {np.quantile(misses, 0.95, method='lower'):.3f}",
        f"{np.median(captures):.1f}" if captures else "-",
        causes(flight.rule for flight in mine if flight.outcome != "completed"),
    ]
