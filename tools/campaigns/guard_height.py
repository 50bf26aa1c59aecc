"""Campaign: the largest tilt by height of the guards, speed and mode (docs/results/tumbles.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec

from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from tests.watched_flight import WatchedFlight
from tools.campaigns.results import grouped, markdown
from tools.campaigns.tumbles import mission_of

_SPEEDS = ("1.0", "1.5", "2.0", "2.5", "3.0")
_HEIGHTS_M = ("0.04", "0", "-0.02", "-0.04", "-0.06")
_WALLS = (("acrylic", "0"), ("acrylic", "0.5"), ("wood", "0"))  # with the speed along the wall


class TiltedFlight(msgspec.Struct, frozen=True):
    """The largest true tilt of one flight."""

    tilt_deg: float


def cases() -> list[dict[str, str]]:
    """Return every combination of mode, speed, height and wall, at right angles."""
    room = {"room": "0", "angle_deg": "0", "after_impact": "replan"}
    return [
        room | {"mode": mode, "normal_m_s": speed, "height_m": height, "material": material,
                "tangential_m_s": along}
        for mode in ("rigid", "flexible") for height in _HEIGHTS_M for speed in _SPEEDS
        for material, along in _WALLS
    ]  # fmt: skip


def fly(point: Point, seed: int) -> TiltedFlight:
    """Fly with guards at one height; nothing is drawn."""
    height = {"vehicle.simulation.contact.guard_height_m": float(point.case["height_m"])}
    watched = WatchedFlight(mission_of(dict(point.case)).replace(height), seed)
    watched.run()
    return TiltedFlight(math.degrees(watched.truth.tilt_rad))


def page(rows: Sequence[JudgedRow]) -> str:
    """Return the largest tilt of three walls; pairs are for rigid and flexible arms."""
    table: dict[str, dict[str, list[str]]] = {}
    for (height, speed, _), mine in grouped(rows, "height_m", "normal_m_s", "mode").items():
        cells = table.setdefault(height, {}).setdefault(speed, [])
        cells.append(f"{max(f.tilt_deg for f in mine):.0f}")
    heads = ("guards, cm", *(f"{speed} m/s" for speed in dict.fromkeys(r.values["normal_m_s"] for r in rows)))
    cm = {height: f"{100.0 * float(height):+.0f}" for height in table}
    return markdown(heads, [[cm[h], *map(", ".join, cells.values())] for h, cells in table.items()])
