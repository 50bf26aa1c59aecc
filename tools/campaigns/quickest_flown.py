"""Twelve scenarios of the objective `quickest`: does what `plan` says hold in twenty other drawn worlds?

python -m tools.campaigns.quickest_flown

Results go to `build/quickest_flown.jsonl` as they come, and the table to docs/results.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec

from dart_flight.config.mission_file import FlownRecord
from dart_flight.config.vehicle import packaged
from dart_flight.lab.search import flown_plan
from dart_flight.lab.search.mission_writer import planned_mission
from dart_flight.lab.search.quickest import plan_quickest
from dart_flight.lab.search.scenario import load_scenario
from tools.campaigns.kept import fly_missing
from tools.campaigns.results import RESULTS, ROOT, markdown, measured_by

PLACES = {"e": (1, 0), "w": (-1, 0), "n": (0, 1), "E": (1, 0.2), "W": (-1, 0.2), "c": (0, 0)}
NORMALS = {"e": (-1, 0), "w": (1, 0), "n": (0, -1)}
OTHER_SEED = 800_001
NOT_BLIND = "A flight of row 8 has shown a fault that was mended.\n"
_WHERE = "in simulation, on two shared cores, the package compiled"
HEADS = ("vehicle", "visits", "walls", "within m", "planned s", "offered", "completed", "uncontrolled",
         "saving s", "tilt °")  # fmt: skip
ABOUT = """Each scenario is planned and flown in 20 drawn worlds by `plan`, the offered plan in 20 others.
Two figures are those of `plan` and of the other worlds. `planned` is the saving that the search promises,
`saving` the median from take-off to landing with touches, negative where the hits lose. `–`: the flight
without a hit is offered.
"""


class Room(NamedTuple):
    """Places to visit and walls by their letters, half the room's width, tolerance, and what differs."""

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
    """The scenario of a room."""
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


def fly(room: Room) -> dict[str, Any]:
    """Plan a room, fly the plan as `plan` does, and twenty times more."""
    result, alone = plan_quickest(load_scenario(scenario_of(room)), 60.0), flown_plan.fly_in_process
    offered = flown_plan.choose_flown(result, False, fly=alone)
    found: dict[str, Any] = {"planned_s": result.saving_s, "says": offered.says, "offered": "none"}
    if offered.plan is None:
        return found
    found["offered"] = next(name for name, one in offered.flown.items() if one == offered.record)
    flown_plan.FIRST_SEED = OTHER_SEED
    other = flown_plan.fly_mission(planned_mission(offered.scenario, offered.plan), fly=alone)
    record = other.record
    if result.free is not None and found["offered"] != "free":
        record = flown_plan.compare(
            other, flown_plan.fly_mission(planned_mission(result.scenario, result.free), fly=alone)
        )
    flown_plan.FIRST_SEED = 700_001
    return found | {"said": offered.record, "other": record}


def row(room: Room, found: dict[str, Any]) -> list[str]:
    """Return one line of the table; two figures are those of `plan` and those of the other worlds."""
    where = [room.vehicle, str(len(room.visits)), str(len(room.walls)), str(room.within_m)]
    planned = "–" if found["planned_s"] is None else f"{found['planned_s']:+.2f}"
    records = [msgspec.convert(found[k], FlownRecord) for k in ("said", "other") if k in found]
    drawn = [one.drawn for one in records if one.drawn is not None]
    savings = ["–" if one.saving_s is None else f"{one.saving_s:+.2f}" for one in records]
    columns = (
        [str(one.completed) for one in drawn],
        [str(one.uncontrolled) for one in drawn],
        savings,
        [f"{one.max_tilt_deg or 0.0:.0f}" for one in drawn],
    )
    return [*where, planned, found["offered"], *(" / ".join(column) or "–" for column in columns)]


def meaning(kept: list[dict[str, Any]]) -> str:
    """Return what the flights mean and what they cannot say."""
    pairs = [
        [msgspec.convert(one[k], FlownRecord) for k in ("said", "other")] for one in kept if "other" in one
    ]
    others = [other.drawn for _, other in pairs if other.drawn is not None]
    flights, lost = sum(one.flights for one in others), sum(one.uncontrolled for one in others)
    off_s = max(abs((other.saving_s or 0.0) - (said.saving_s or 0.0)) for said, other in pairs)
    says = f"Of {flights} flights in other worlds {lost} are uncontrolled; "
    says += f"the saving differs by {off_s:.2f} s at most."
    if not lost:  # a share p leaves none with the probability (1 - p)^n
        most, of_one = (100.0 * (1.0 - 0.05 ** (1.0 / n)) for n in (flights, flown_plan.DRAWN))
        says += f"\nUp to {most:.1f} % of all such flights may still be (95 %), of one room's {of_one:.0f} %."
    return f"{says} {NOT_BLIND}"


if __name__ == "__main__":
    flown = fly_missing(ROOT / "build" / "quickest_flown.jsonl", ROOMS, fly, tuple[Room, dict[str, Any]])
    kept = [msgspec.json.decode(msgspec.json.encode(one)) for one in flown]
    table = markdown(HEADS, [row(room, one) for room, one in zip(ROOMS, kept, strict=True)])
    measured = measured_by("tools.campaigns.quickest_flown", _WHERE)
    head = f"# What `plan` says of its flights, and other worlds\n\n{measured}\n\n"
    (RESULTS / "quickest_flown.md").write_text(f"{head}{ABOUT}\n{table}\n{meaning(kept)}")
