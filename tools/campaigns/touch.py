"""Campaign: walls measured by touch: direction from one contact, survey, and rooms (docs/results/touch.md).

The campaigns anchors and px4_touch also fly hits on plain GPS. A row is a flight with everything drawn, or
the flights in one room. Errors refer to the simulation's truth.
"""

from __future__ import annotations

import math
import os
import statistics
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dart_flight.base.records import FrameAnchor, Mode, WallEstimate
from dart_flight.base.summary import cause_of
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.vehicle import packaged
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.planning.room import RoomContact, RoomFit, contacts_from_walls, plan_star
from dart_flight.planning.survey import plan_survey
from dart_flight.recording.reader import read_log
from dart_flight.recording.verdict import Verdict
from dart_flight.run.fast import fly_fast
from dart_flight.run.flight_record import FlightRecord
from dart_flight.run.px4_flight import fly_px4
from dart_flight.sim.px4.installation import ENVIRONMENT
from tools.campaigns.results import causes, grouped, markdown

_RECENT_S = 8.0  # largest age of a recent anchor
_UNCONTROLLED_DEG = 60.0
_MATERIALS = ("wood", "acrylic", "concrete")


class EstimatedWall(msgspec.Struct, frozen=True):
    """One wall of a flight: errors and standard deviations of its estimate; k relative to the drawn k."""

    mode: str
    incidence_deg: float | None
    error_m: float | None
    error_deg: float | None
    sd_deg: float | None
    k_error: float | None
    k_sd: float | None


class HitOnGps(msgspec.Struct, frozen=True):
    """A hit of a wall after an earlier contact with it: actual and expected drift of the frame."""

    age_s: float
    moved_m: float
    expected_sd_m: float


class FoundRoom(msgspec.Struct, frozen=True):
    """A room: numbers of true and found walls, quality of the outline, and effort.

    Attributes:
        share: share of the true outline that is within 5 cm of the found one.
        contacts, flights, flown_s: number of contacts and of flights, and their total time.
    """

    walls: int
    found: int
    closed: bool
    share: float
    contacts: int
    flights: int
    flown_s: float


class Touched(msgspec.Struct, frozen=True):
    """One flight, or the flights in one room."""

    outcome: str
    reason: str
    tilt_deg: float
    walls: list[EstimatedWall] = []
    hits: list[HitOnGps] = []
    room: FoundRoom | None = None


def directions_mission(seed: int) -> Mission:
    """Return a mission with four unknown walls around the start, rotated by up to 15 degrees, and probes."""
    rng = np.random.default_rng(seed)
    walls, probes = {}, []
    for k in range(4):
        angle, yaw = 0.5 * math.pi * k, math.radians(rng.uniform(-15.0, 15.0))
        dx, dy = math.cos(angle), math.sin(angle)
        walls[f"wall {k}"] = {
            "point_m": [1.8 * dx, 1.8 * dy],
            "normal": [-math.cos(angle + yaw), -math.sin(angle + yaw)],
            "length_m": 2.0,
            "material": _MATERIALS[rng.integers(len(_MATERIALS))],
        }
        probes.append(
            {
                "wall": f"felt {k}",
                "mode": ("rigid", "flexible")[rng.integers(2)],
                "probe": {
                    "from_m": [0.4 * dx, 0.4 * dy],
                    "direction": [dx, dy],
                    "length_m": 2.4,
                    "speed_m_s": float(rng.uniform(0.3, 1.0)),
                },
            }
        )
    tree = {
        "version": 1,
        "name": "directions",
        "start": {"position_m": [0.0, 0.0], "altitude_m": 1.2},
        "goal": {"position_m": [0.0, 0.0], "hold_s": 0.1},
        "bounds_m": {"x": [-4.0, 4.0], "y": [-4.0, 4.0], "z": [0.3, 2.5]},
        "simulated_walls": walls,
        "collisions": probes,
    }
    return load_mission(tree, packaged("configs", "dart.yaml"))


def survey_mission(case: str) -> Mission:
    """Return the survey of a shipped mission whose walls are known to 0.1 m and 1.7 degrees."""
    name, _, source = case.partition(" on ")
    mission = load_mission(packaged("missions", f"{name}.yaml"))
    changes: dict[str, Any] = {f"walls.{w.name}.position_sd_m": 0.1 for w in mission.flat_walls}
    if source:
        changes["vehicle.simulation.position_from"] = source.lower()
    changes |= {f"walls.{w.name}.yaw_sd_deg": 1.7 for w in mission.flat_walls}
    return plan_survey(mission.replace(changes)).mission


def gps_mission(case: str) -> Mission:
    """Return the dual collision on GPS, either with touches as anchors or without anchors."""
    mission = load_mission(packaged("missions", "dual_collision_gps.yaml"))
    changes: dict[str, Any] = {"vehicle.simulation.position_from": "plain"}
    if case == "no anchors":  # PX4's own uncertainty would prevent the flight
        changes |= {"frame.anchored_by": "none", "vehicle.guard.position_sd_m": 100.0}
    return mission.replace(changes)


def room_of(seed: int) -> tuple[Mission, np.ndarray]:
    """Return a convex room of 4 to 6 walls, each at least 1 m long, 2.5 to 5 m across, and its corners."""
    rng = np.random.default_rng([seed, 32])
    while True:
        n = int(rng.integers(4, 7))
        angles = np.linspace(0.0, 2.0 * math.pi, n, endpoint=False) + rng.uniform(-0.35, 0.35, n)
        angles = np.sort(angles) + rng.uniform(0.0, 2.0 * math.pi)
        out, away = np.stack([np.cos(angles), np.sin(angles)], axis=1), rng.uniform(1.3, 2.4, n)
        sides = [(k, (k + 1) % n) for k in range(n)]
        corners = np.array([np.linalg.solve(out[[a, b]], away[[a, b]]) for a, b in sides])
        lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        turned = np.linspace(0.0, math.pi, 36)
        across = np.ptp(corners @ np.stack([np.cos(turned), np.sin(turned)]), axis=0)
        if (corners @ out.T > away + 1e-6).any() or lengths.min() < 1.0:
            continue
        if across.min() >= 2.5 and across.max() <= 5.0:
            break
    walls = {
        f"wall {k + 1}": {
            "point_m": (0.5 * (corners[k] + corners[k - 1])).tolist(),
            "normal": (-out[k]).tolist(),
            "length_m": float(lengths[k]),
            "material": _MATERIALS[rng.integers(len(_MATERIALS))],
            "given_at": "surface",
        }
        for k in range(n)
    }
    tree = {
        "version": 1,
        "name": f"room-{seed}",
        "start": {"position_m": [0.0, 0.0], "altitude_m": 1.2},
        "goal": {"position_m": [0.0, 0.0], "hold_s": 0.1},
        "bounds_m": {"x": [-6.0, 6.0], "y": [-6.0, 6.0], "z": [0.3, 2.5]},
        "limits": {"speed_m_s": 2.0, "acceleration_m_s2": 3.0, "jerk_m_s3": 10.0},
        "simulated_walls": walls,
    }
    return load_mission(tree, packaged("configs", "dart.yaml")), corners


def find_room(seed: int, spreads: Mapping[str, float]) -> Touched:
    """Fly up to four times in one room, until its outline is closed."""
    mission, corners = room_of(seed)
    # The walls are those of the room; everything else is drawn.
    spreads = {name: sd for name, sd in spreads.items() if not name.startswith("wall_")}
    directions = [2.0 * math.pi * k / 16 for k in range(16)]
    airframe, touches, flights = mission.vehicle.airframe, list[RoomContact](), list[Verdict]()
    while True:
        flown = plan_star(mission, directions)
        flights.append(fly_fast(flown, 10 * seed + len(flights), None, spreads=spreads))
        touches += contacts_from_walls(flights[-1].walls, directions)
        room = RoomFit(mission.start, touches, airframe.guard_along_m, airframe.contact_distance_m).fit()
        if room.is_closed or len(flights) == 4:
            break
        directions = sorted(room.gaps_rad)[:16]
    found = FoundRoom(
        len(corners),
        len(room.walls),
        room.is_closed,
        share_of_outline(corners, [c for c in room.corners if c is not None]),
        len(touches),
        len(flights),
        sum(v.flight_time_s or 0.0 for v in flights),
    )
    tilt = max(v.max_tilt_deg or 0.0 for v in flights)
    return Touched(flights[-1].outcome.value, flights[-1].reason or "", tilt, room=found)


def share_of_outline(corners: np.ndarray, found: Sequence[tuple[float, float]]) -> float:
    """Return the share of the true outline that lies within 5 cm of the found one."""
    if len(found) < 3:
        return 0.0
    steps = np.linspace(0.0, 1.0, 400)[:, None]
    points = np.vstack(
        [a + steps * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    )
    lengths = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).repeat(len(steps))
    nearest = np.full(len(points), np.inf)
    polygon = np.array(found)
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        edge = b - a
        along = np.clip(((points - a) @ edge) / max(float(edge @ edge), 1e-12), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(points - a - along[:, None] * edge, axis=1))
    return float(lengths[nearest <= 0.05].sum() / lengths.sum())


def estimated_walls(mission: Mission, verdict: Verdict, records: Iterable[Any]) -> list[EstimatedWall]:
    """Return each wall's last estimate from a contact."""
    last = {record.wall: record for record in records if isinstance(record, WallEstimate)}
    found = []
    for wall in verdict.walls:
        hits = [c for c in verdict.collisions if c.wall == wall.name]
        truth = hits[-1].truth if hits else None
        estimate = last[wall.name]
        sd_rad = estimate.plane_normal_sigma_rad
        mode = (estimate.mode_felt or estimate.mode_reported or hits[-1].mode) if hits else ""
        drawn = verdict.drawn.get(f"contact.{wall.name}.{mode}.k")
        k_error = None
        if drawn is not None:
            planned = next(c.wall for c in mission.collisions if c.wall.name == wall.name)
            true_k = float(drawn) * mission.vehicle.materials[planned.material].coefficients(Mode(mode)).k
            k_error = estimate.k_n_per_m / true_k - 1.0
        found.append(
            EstimatedWall(
                str(mode),
                None if truth is None else truth.incidence_deg,
                wall.truth_error_m,
                wall.truth_error_deg,
                None if sd_rad is None else math.degrees(sd_rad),
                k_error,
                estimate.k_sd,
            )
        )
    return found


def mission_of(case: Mapping[str, str], seed: int) -> Mission:
    """Return the mission of a case that is not a room."""
    if case["part"] == "directions":
        return directions_mission(seed)
    return survey_mission(case["flown"]) if case["part"] == "survey" else gps_mission(case["flown"])


def fly(point: Point, seed: int) -> Touched:
    """Fly one case in the fast world."""
    if point.case["part"] == "rooms":
        return find_room(seed, point.spreads)
    mission = mission_of(point.case, seed)
    kept: list[FlightRecord] = []
    verdict = fly_fast(mission, seed, None, spreads=point.spreads, keep_record=kept.append)
    return _touched(mission, verdict, [entry.record for entry in kept[0].log.entries])


def fly_on_px4(point: Point, seed: int) -> Touched:
    """Fly one case on a real PX4."""
    mission = mission_of(point.case, seed)
    source = PositionSource.MOCAP
    if point.case["part"] == "anchors":
        source = PositionSource.ANCHORED if mission.is_anchored else PositionSource.PLAIN
    with tempfile.TemporaryDirectory() as folder:
        px4 = os.environ[ENVIRONMENT]
        verdict = fly_px4(mission, px4, seed, Path(folder), position_from=source, spreads=point.spreads)
        records = [] if verdict.log is None else [entry.record for entry in read_log(verdict.log).entries]
    return _touched(mission, verdict, records)


def _touched(mission: Mission, verdict: Verdict, records: Sequence[Any]) -> Touched:
    hits = [
        HitOnGps(r.age_s, math.hypot(*r.moved_mission), r.expected_sd_m)
        for r in records
        if isinstance(r, FrameAnchor) and r.age_s is not None
    ]
    walls = estimated_walls(mission, verdict, records)
    tilt = verdict.max_tilt_deg or 0.0
    return Touched(verdict.outcome.value, verdict.reason or "", tilt, walls, hits)


# -- page --------------------------------------------------------------------------------------------------


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a table for each part, and a line about the rooms."""
    cases = grouped(rows, "part", "flown")
    anchored = [f for (part, _), mine in cases.items() if part == "anchors" for f in mine]
    tables = [
        _directions([w for f in cases.get(("directions", ""), []) for w in f.walls]),
        markdown(
            _FLIGHT_HEADS,
            [[flown, *_flight_figures(mine)] for (_, flown), mine in cases.items() if flown],
        ),
        _hits([h for f in anchored for h in f.hits]),
        _rooms([r.row.room for r in rows if r.row.room is not None]),
    ]
    return "\n".join(table for table in tables if table)


_FLIGHT_HEADS = ("flown", "completed", "uncontrolled", "place rms m", "direction rms °, largest",
                 "both walls within 8 s", "ended by")  # fmt: skip


def _flight_figures(mine: Sequence[Touched]) -> list[str]:
    walls = [w for f in mine for w in f.walls]
    places = [w.error_m for w in walls if w.error_m is not None]
    turned = [abs(w.error_deg) for w in walls if w.error_deg is not None]
    recent = [f for f in mine if len(f.hits) > 1 and all(h.age_s <= _RECENT_S for h in f.hits)]
    return [
        f"{sum(f.outcome == 'completed' for f in mine)} of {len(mine)}",
        str(sum(f.tilt_deg > _UNCONTROLLED_DEG for f in mine)),
        f"{rms(places):.4f}" if places else "-",
        f"{rms(turned):.2f}, {max(turned):.2f}" if turned else "-",
        f"{sum(f.outcome == 'completed' for f in recent)} of {len(recent)}" if recent else "-",
        causes(cause_of(f.reason) for f in mine if f.outcome != "completed"),
    ]


def _directions(walls: Sequence[EstimatedWall]) -> str:
    rows = []
    for low, high in ((0.0, 6.0), (6.0, 15.0), (15.0, 30.0)):
        here = [w for w in walls if low <= abs(w.incidence_deg or 0.0) < high and w.error_deg is not None]
        errors = [w.error_deg for w in here if w.error_deg is not None]
        ratios = [w.error_deg / w.sd_deg for w in here if w.error_deg is not None and w.sd_deg]
        places = [w.error_m for w in here if w.error_m is not None]
        if errors:
            figures = [f"{rms(errors):.2f}, {max(map(abs, errors)):.1f}", f"{rms(ratios):.2f}"]
            rows.append([f"{low:.0f} to {high:.0f}", str(len(here)), *figures, f"{rms(places):.4f}"])
    heads = ("incidence °", "contacts", "direction rms °, largest", "rms error/deviation", "place rms m")
    return markdown(heads, rows) if rows else ""


def _hits(hits: Sequence[HitOnGps]) -> str:
    rows = []
    for low, high in ((0.0, _RECENT_S), (_RECENT_S, 30.0)):
        here = [h for h in hits if low <= h.age_s < high]
        if here:
            off, expected = rms([h.moved_m for h in here]), rms([h.expected_sd_m for h in here])
            rows.append([f"{low:.0f} to {high:.0f} s", str(len(here)), f"{off:.3f}", f"{expected:.3f}"])
    heads = ("age of the anchor", "hits", "off rms m", "predicted m")
    return markdown(heads, rows) if rows else ""


def _rooms(rooms: Sequence[FoundRoom]) -> str:
    if not rooms:
        return ""
    shares = [100.0 * room.share for room in rooms]
    return (
        f"Rooms: {len(rooms)}; outline closed in {sum(room.closed for room in rooms)}; within 5 cm of it "
        f"lies {statistics.fmean(shares):.1f} % of the true outline on average, at least {min(shares):.1f} %."
    )


def rms(values: Sequence[float]) -> float:
    """Return the root mean square, or NaN without values."""
    return math.sqrt(sum(v * v for v in values) / len(values)) if values else math.nan
