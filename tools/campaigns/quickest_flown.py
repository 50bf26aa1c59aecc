"""Campaign: results of `plan` with the objective `quickest`, checked in other drawn worlds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import msgspec

from dart_flight.config.mission_file import FlownRecord
from dart_flight.config.vehicle import packaged
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.lab.search import flown_plan
from dart_flight.lab.search.mission_writer import planned_mission
from dart_flight.lab.search.quickest import plan_quickest
from dart_flight.lab.search.scenario import load_scenario
from tools.campaigns.results import markdown, rate

PLACES = {"e": (1, 0), "w": (-1, 0), "n": (0, 1), "E": (1, 0.2), "W": (-1, 0.2), "c": (0, 0)}
NORMALS = {"e": (-1, 0), "w": (1, 0), "n": (0, -1)}
OTHER_SEED = 800_001


class Room(NamedTuple):
    """A room: letters of the places to visit and of the walls, half the width, tolerance, and options."""

    vehicle: str
    visits: str
    walls: str
    half_m: float
    within_m: float
    touch_m_s: float | None = None
    motion: str = "position"


ROOMS = [
    Room("dart", "ewEWew", "ew", 1.25, 0.05), Room("dart", "ec", "e", 1.5, 0.1),
    Room("dart", "ew", "ew", 1.5, 0.05, 0.6), Room("dart", "ewe", "ew", 2.0, 0.1),
    Room("dart", "ewew", "ew", 1.5, 0.5), Room("dart", "ewew", "ew", 1.5, 0.1, None, "automatic"),
    Room("dart", "enw", "enw", 1.5, 0.2), Room("dart", "ewEWe", "enw", 1.5, 0.3, 0.6),
    Room("dart", "en", "enw", 1.5, 0.1), Room("rigid_cage", "ew", "ew", 1.5, 0.1),
    Room("rigid_cage", "ewew", "ew", 1.5, 0.2), Room("rigid_cage", "enw", "enw", 1.5, 0.3),
]  # fmt: skip


def scenario_of(room: Room) -> dict[str, Any]:
    """Return the scenario of a room."""
    half, cage = (
        room.half_m,
        {"speed_m_s": 2.0, "peak_force_n": 100.0} if room.vehicle == "rigid_cage" else {},
    )
    wall = {"length_m": 2 * half, "material": "acrylic"}
    walls = {w: wall | {"point_m": [-half * n for n in NORMALS[w]], "normal": NORMALS[w]} for w in room.walls}
    visits = [{"position_m": [half * p for p in PLACES[v]], "within_m": room.within_m} for v in room.visits]
    at = {"position_m": [0.0, 0.0]}
    return {
        "version": 1, "name": "room", "vehicle": str(packaged("configs", f"{room.vehicle}.yaml")),
        "start": at | {"altitude_m": 1.2}, "goal": at, "sequence": "any", "objective": "quickest",
        "walls": walls, "visits": visits,
        "bounds_m": {"x": [-4.0, 4.0], "y": [-4.0, 4.0], "z": [0.3, 2.5]},
        "limits": {"motion": room.motion} | cage, "touch_m_s": room.touch_m_s,
    }  # fmt: skip


class RoomFlown(msgspec.Struct, frozen=True):
    """The planned saving, the offered plan, and its flights by `plan` and in other worlds; None: no offer."""

    planned_saving_s: float | None
    offered: str
    by_plan: FlownRecord | None
    other: FlownRecord | None


def cases() -> list[dict[str, str]]:
    """Return the cases: the number of every room."""
    return [{"room": str(number)} for number in range(1, len(ROOMS) + 1)]


def fly(point: Point, _: int) -> RoomFlown:
    """Plan a room, fly the plan in the worlds that `plan` draws, and fly it in twenty other worlds."""
    room, fly_here = ROOMS[int(point.case["room"]) - 1], flown_plan.fly_in_process
    result = plan_quickest(load_scenario(scenario_of(room)), 60.0)
    offered = flown_plan.PlanChoice(result, False).run(fly_here)
    if offered.plan is None:
        return RoomFlown(result.saving_s, "none", None, None)
    name = next(name for name, flown in offered.flown.items() if flown == offered.record)
    first_seed, flown_plan.FIRST_SEED = flown_plan.FIRST_SEED, OTHER_SEED
    other = flown_plan.fly_mission(planned_mission(offered.scenario, offered.plan), fly=fly_here)
    record = other.record
    if result.free is not None and name != "free":
        free = flown_plan.fly_mission(planned_mission(result.scenario, result.free), fly=fly_here)
        record = flown_plan.compare(other, free)
    flown_plan.FIRST_SEED = first_seed
    return RoomFlown(result.saving_s, name, offered.record, record)


_HEADS = ("vehicle", "visits", "walls", "planned s", "offered", "completed", "uncontrolled",
          "saving s", "tilt °")  # fmt: skip


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a table with a row for every room; a pair of figures is for `plan` and for the other worlds."""
    table, off_s, others = [], [], []
    for r in rows:
        room, found = ROOMS[int(r.values["room"]) - 1], r.row
        planned = "-" if found.planned_saving_s is None else f"{found.planned_saving_s:+.2f}"
        cells = [room.vehicle, str(len(room.visits)), str(len(room.walls)), planned]
        records = [record for record in (found.by_plan, found.other) if record is not None]
        drawn = [record.drawn for record in records if record.drawn is not None]
        savings = [record.saving_s for record in records if record.saving_s is not None]
        off_s += [abs(savings[0] - savings[1])] if len(savings) == 2 else []
        others += drawn[1:]
        columns = (
            [str(flights.completed) for flights in drawn],
            [str(flights.uncontrolled) for flights in drawn],
            [f"{saving_s:+.2f}" for saving_s in savings],
            [f"{flights.max_tilt_deg or 0.0:.0f}" for flights in drawn],
        )
        table.append([*cells, found.offered, *("/".join(column) or "-" for column in columns)])
    uncontrolled = rate(sum(f.uncontrolled for f in others), sum(f.flights for f in others), 1)
    summary = f"In other worlds {uncontrolled} were uncontrolled"
    if off_s:
        summary += f"; savings differed by at most {max(off_s):.2f} s"
    return f"{markdown(_HEADS, table)}\n{summary}."
