"""Campaign: the height of the guards at which a hit turns a vehicle over (docs/results/guard_height.md)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import msgspec

from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from tests.watched_flight import WatchedFlight
from tools.campaigns.results import grouped, markdown
from tools.campaigns.tumbles import mission_of

_SPEEDS = ("0.8", "1.0", "1.25", "1.5", "2.0", "2.5", "3.0")
_ABOVE_MM = ("0", "10", "20", "30", "40", "50", "60", "80", "100")
_HEIGHTS_MM = {"below": ("-5", *(f"-{height}" for height in _ABOVE_MM[1:])), "above": _ABOVE_MM}
_VEHICLES = (("dart", "rigid"), ("dart", "flexible"), ("rigid_cage", "rigid"), ("ring_guard_250g", "rigid"))
_WALLS = (("acrylic", "0"), ("acrylic", "0.5"), ("wood", "0"))  # with the speed along the wall
_TURNED_DEG = 60.0


class TiltedFlight(msgspec.Struct, frozen=True):
    """The largest true tilt of one flight."""

    tilt_deg: float


def cases() -> list[dict[str, str]]:
    """Return every combination of vehicle, mode, speed, height and wall, at right angles."""
    room = {"room": "0", "angle_deg": "0", "after_impact": "replan"}
    return [
        room | {"vehicle": vehicle, "mode": mode, "side": side, "height_mm": height, "normal_m_s": speed,
                "material": material, "tangential_m_s": along}
        for vehicle, mode in _VEHICLES for side, heights in _HEIGHTS_MM.items() for height in heights
        for speed in _SPEEDS for material, along in _WALLS
    ]  # fmt: skip


def fly(point: Point, seed: int) -> TiltedFlight:
    """Fly with guards at one height; nothing is drawn."""
    height = {"vehicle.simulation.contact.guard_height_m": 1e-3 * float(point.case["height_mm"])}
    watched = WatchedFlight(mission_of(dict(point.case)).replace(height), seed)
    watched.run()
    return TiltedFlight(math.degrees(watched.truth.tilt_rad))


def page(rows: Sequence[JudgedRow]) -> str:
    """Return the largest height below which no flight at three walls reached 60 degrees of tilt."""
    table: dict[tuple[str, ...], list[str]] = {}
    for (vehicle, mode, side, _), mine in _tilts(rows).items():
        stays = itertools.takewhile(lambda pair: pair[1] < _TURNED_DEG, mine.items())
        highest = max((height for height, _ in stays), default=None)
        most = "turns over" if highest is None else f"{highest}"
        table.setdefault((vehicle, mode, side), []).append(most)
    heads = ("vehicle", "mode", "guards", *(f"{speed} m/s" for speed in _SPEEDS))
    return markdown(heads, [[f"`{vehicle}`", *keys, *cells] for (vehicle, *keys), cells in table.items()])


def _tilts(rows: Sequence[JudgedRow]) -> dict[tuple[str, ...], dict[int, float]]:
    """Return the largest tilt by distance of the guards, mm, for each vehicle, mode, side and speed."""
    found: dict[tuple[str, ...], dict[int, float]] = {}
    for (*key, height), mine in grouped(rows, "vehicle", "mode", "side", "normal_m_s", "height_mm").items():
        found.setdefault(tuple(key), {})[abs(int(height))] = max(f.tilt_deg for f in mine)
    return found
