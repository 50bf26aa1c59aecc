"""Campaign: walls that differ from the mission's, hit or aborted (docs/results/walls.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec

from dart_flight.config.document import Document
from dart_flight.config.mission import Mission, parse_mission
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.sim.draws import DrawnWorld
from tests.watched_flight import WatchedFlight, place_walls
from tools.campaigns.results import causes, grouped, markdown, median_and_most

_WALL = "acrylic"
# A wall is rotated about its centre. On `_BESIDE` the hit is 1.3 m from the centre, but not near the end.
_SHIPPED = "point_m: [1.65, 0.5], normal: [-1.0, 0.0], length_m: 3.0"
_BESIDE = "point_m: [1.65, -0.5], normal: [-1.0, 0.0], length_m: 4.0"


class MovedWall(msgspec.Struct, frozen=True):
    """One flight: its end, and the error of the impact with the moved wall."""

    outcome: str
    rule: str
    off_m_s: float | None
    miss_m: float | None


def mission_of(case: Mapping[str, str]) -> Mission:
    """Return the mission with its assumed walls."""
    name, _, beside = case["flown"].partition(" ")
    path = f"missions/{name}.yaml"
    with open(path, encoding="utf-8") as file:
        text = file.read()
    if beside:
        text = text.replace(_SHIPPED, _BESIDE)
    if case["known"]:
        end = text.index("}", text.index(f"  {_WALL}: {{"))
        text = f"{text[:end]}, {case['known']}{text[end:]}"
    return parse_mission(Document(text, path))


def fly(point: Point, seed: int) -> MovedWall:
    """Fly among the true walls."""
    mission, case = mission_of(point.case), point.case
    world = DrawnWorld(mission, None, {})
    world = place_walls(world, {_WALL: float(case["away_m"])}, {_WALL: float(case["turned_deg"])})
    verdict = WatchedFlight(mission, seed, world).run()
    off = [
        abs(c.truth.normal_m_s - c.planned.normal_m_s)
        for c in verdict.collisions
        if c.wall == _WALL and c.truth and c.truth.normal_m_s and c.planned.normal_m_s
    ]
    rule = (verdict.reason or "").partition(":")[0]
    return MovedWall(verdict.outcome.value, rule, off[-1] if off else None, verdict.goal_miss_m)


_HEADS = ("mission", "true wall offset", "completed without a deviation", "with it", "deviation",
          "impact off m/s: median, most")  # fmt: skip


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for every mission and offset: without and with a stated uncertainty of the wall."""
    keys, table = ("flown", "away_m", "turned_deg"), []
    without = grouped((r for r in rows if not r.values["known"]), *keys)
    known = grouped((r for r in rows if r.values["known"]), *keys, "known")
    for (flown, away, turned, stated), mine in known.items():
        good = [flight for flight in mine if flight.outcome == "completed"]
        cells = [
            flown,
            f"{away} m" if turned == "0" else f"{turned}°",
            _completed(without.get((flown, away, turned), [])),
            _completed(mine),
            stated.partition(" ")[2] + (" m" if turned == "0" else "°"),
            median_and_most((flight.off_m_s for flight in good), 3),
        ]
        table.append(cells)
    return markdown(_HEADS, table)


def _completed(mine: Sequence[MovedWall]) -> str:
    ended = causes(flight.rule for flight in mine if flight.outcome != "completed")
    return f"{sum(f.outcome == 'completed' for f in mine)} of {len(mine)}" + (
        "" if ended == "-" else f", {ended}"
    )
