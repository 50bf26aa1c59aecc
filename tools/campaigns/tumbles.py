"""Campaign: generated rooms with one oblique wall, and which of their flights turn over.

Each room (docs/results/tumbles.md) has a wall at 0 to 25 degrees, hit at 0.5 to 3 m/s in either mode. The
page counts the tumbles among the rooms that `check` accepts, and the tumbles among the rooms that it refuses.
"""

from __future__ import annotations

import functools
import math
import random
from collections.abc import Sequence
from typing import Any

import msgspec

from dart_flight.base.records import Outcome
from dart_flight.base.summary import cause_of
from dart_flight.check.checks import FlightContext, Stage, run_checks
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import load_vehicle, packaged
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.sim.draws import draw_world
from tests.watched_flight import WatchedFlight
from tools.campaigns.results import markdown, rate

_ROOMS = 50
_TUMBLED_DEG = 80.0
_REST_M = 1.6  # distance from the wall to the goal
_STIFFNESS_N_S_M = {"flexible": 25.0, "rigid": 35.0}  # rough peak force per speed, for the gain


class RoomFlight(msgspec.Struct, frozen=True):
    """One flight: the no-go findings of the room's check, and the true tilt."""

    refused: list[str]
    completed: bool
    reason: str
    tilt_deg: float


def cases() -> list[dict[str, str]]:
    """Return the rooms."""
    found = []
    for number in range(1, _ROOMS + 1):
        rng = random.Random(f"room {number}")
        found.append(
            {
                "room": str(number),
                "angle_deg": f"{rng.uniform(0.0, 25.0):.1f}",
                "normal_m_s": f"{rng.uniform(0.5, 3.0):.2f}",
                "tangential_m_s": f"{rng.uniform(-0.5, 0.5):.2f}",
                "mode": ("rigid", "flexible")[number % 2],
                "material": rng.choice(("acrylic", "wood")),
                "after_impact": rng.choice(("replan", "setpoint")),
            }
        )
    return found


def mission_of(case: dict[str, str]) -> Mission:
    """Return the mission of a room: a run-up to the wall, and a goal in front of it."""
    angle, speed = math.radians(float(case["angle_deg"])), float(case["normal_m_s"])
    normal, (x, y) = (-math.cos(angle), -math.sin(angle)), (2.2, 0.3)
    run_m = 1.0 + 0.6 * speed + 0.25 * speed**2
    tree: dict[str, Any] = {
        "version": 1,
        "name": f"room {case['room']}",
        "start": {"position_m": [x + run_m * normal[0], y + run_m * normal[1]], "altitude_m": 1.4},
        "goal": {
            "position_m": [x + _REST_M * normal[0], y + _REST_M * normal[1]],
            "capture_radius_m": 0.3,
            "hold_s": 1.0,
        },
        "bounds_m": {"x": [-8.5, 4.5], "y": [-6.5, 6.5], "z": [0.3, 2.6]},
        "walls": {
            "slab": {"point_m": [x, y], "normal": list(normal), "length_m": 5.0, "material": case["material"]}
        },
        "collisions": [
            {
                "wall": "slab",
                "mode": case["mode"],
                "approach": {"normal_m_s": -speed, "tangential_m_s": float(case["tangential_m_s"])},
                "alpha_wall_m_per_n": [_REST_M / (_STIFFNESS_N_S_M[case["mode"]] * speed), 0.02],
            }
        ],
        "limits": {"speed_m_s": speed + 1.0, "peak_force_n": 250.0},
        "after_impact": case["after_impact"],
    }
    return load_mission(tree, load_vehicle(packaged("configs", f"{case.get('vehicle', 'dart')}.yaml")))


@functools.cache
def refusals(room: str) -> tuple[str, ...]:
    """Return the items of the check's no-go findings, or the loader's error."""
    try:
        mission = mission_of(cases()[int(room) - 1])
    except InputError as error:
        return (f"not loaded: {error}",)
    findings = run_checks(FlightContext(mission), Stage.FILE)
    return tuple(finding.item for finding in findings if not finding.go)


def fly(point: Point, seed: int) -> RoomFlight:
    """Fly a room in the fast world, whether `check` accepts the room or not."""
    refused, mission = list(refusals(point.case["room"])), mission_of(dict(point.case))
    watched = WatchedFlight(mission, seed, draw_world(mission, seed, point.spreads))
    verdict = watched.run()
    return RoomFlight(
        refused,
        verdict.outcome is Outcome.COMPLETED,
        cause_of(verdict.reason or ""),
        math.degrees(watched.truth.tilt_rad),
    )


_HEADS = (
    "`check`", "rooms", "flights", "completed", "tumbled (95 %)"
)  # fmt: skip


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a table with a row for the accepted rooms, and one for each reason to refuse a room."""
    groups: dict[str, list[JudgedRow]] = {}
    for r in rows:
        groups.setdefault(", ".join(f"`{item}`" for item in r.row.refused) or "go", []).append(r)
    order = sorted(groups, key=lambda name: name != "go")
    return markdown(_HEADS, [[name, *_cells(groups[name])] for name in order])


def _cells(mine: Sequence[JudgedRow]) -> list[str]:
    flown = [r.row for r in mine]
    tumbled = sum(f.tilt_deg > _TUMBLED_DEG for f in flown)
    return [
        str(len({r.values["room"] for r in mine})),
        str(len(flown)),
        str(sum(f.completed for f in flown)),
        rate(tumbled, len(flown), 1),
    ]
