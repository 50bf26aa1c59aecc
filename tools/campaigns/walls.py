"""Walls that stand elsewhere than the mission says, with and without their standard deviations in it.

    python -m tools.campaigns.walls --runs 20          # build/walls.md, for docs/results/walls.md

Every row is flown on the same seeds, in the fast world: a wall stands so far out along its normal, or is
turned about its middle, and nothing else is drawn.
"""

from __future__ import annotations

import argparse
import collections
import statistics
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

from dart_flight.base.records import Record, World
from dart_flight.config.document import Document
from dart_flight.config.mission import Mission, parse_mission
from dart_flight.config.vehicle import packaged
from dart_flight.recording.verdict import Verdict
from dart_flight.run.fast import FastFlight
from dart_flight.run.flight_record import FlightRecord
from dart_flight.sim.draws import DrawnWorld
from tools.campaigns.body import place_walls
from tools.campaigns.results import ROOT, markdown

HELD_SEED = 16001
# A wall is turned about its middle: the hit is to be 1.3 m beside it, and not near the wall's end.
_BESIDE = (
    "point_m: [1.65, 0.5], normal: [-1.0, 0.0], length_m: 3.0",
    "point_m: [1.65, -0.5], normal: [-1.0, 0.0], length_m: 4.0",
)


class Row(NamedTuple):
    """Where a wall really stands, and what the mission says of how well it is known (empty: nothing)."""

    mission: str
    wall: str
    away_m: float
    yaw_deg: float
    known: str


ROWS = [
    Row(mission, wall, away_m, yaw_deg, known)
    for mission, wall, moved, of_place in (
        ("paper_single_wall", "acrylic", (-0.12, 0.12), "position_sd_m: 0.06"),
        ("paper_single_wall", "acrylic", (-0.27, 0.27), "position_sd_m: 0.1"),
        ("dual_collision_replan", "acrylic", (-0.25, 0.27), "position_sd_m: 0.1"),
    )
    for away_m, yaw_deg in [(m, 0.0) for m in moved]
    for known in ("", of_place)
] + [
    Row("single_wall beside", "acrylic", 0.0, yaw_deg, known)
    for yaw_deg in (-8.0, 8.0, -12.0, 12.0)
    for known in ("", "yaw_sd_deg: 4.0")
]


def mission_of(row: Row) -> Mission:
    """The mission as it believes its walls."""
    name, _, beside = row.mission.partition(" ")
    path = packaged("missions", f"{name}.yaml")
    text = path.read_text("utf-8")
    if beside:
        text = text.replace(*_BESIDE)
    if row.known:
        place = text.index(f"  {row.wall}: {{")
        end = text.index("}", place)
        text = f"{text[:end]}, {row.known}{text[end:]}"
    return parse_mission(Document(text, str(path)))


def fly(row: Row, seed: int, onlooker: Callable[[Record], None] | None = None) -> Verdict:
    """One flight among the walls as they really stand."""
    mission = mission_of(row)
    world = place_walls(DrawnWorld(mission, None, {}), {row.wall: row.away_m}, {row.wall: row.yaw_deg})
    record = FlightRecord(mission, World.FAST, seed, None)
    if onlooker is not None:
        record.onlookers.append(onlooker)
    FastFlight(mission, seed, observe=record, world=world).run()
    record.close()
    return record.build()


def cells(row: Row, verdicts: list[Verdict]) -> tuple[str, ...]:
    """One line of the table."""
    good = [v for v in verdicts if v.outcome == "completed"]
    reasons = collections.Counter((v.reason or "").partition(":")[0] for v in verdicts if v not in good)
    off = [
        abs(c.truth.normal_m_s - c.planned.normal_m_s)
        for v in good
        for c in v.collisions
        if c.wall == row.wall and c.truth and c.truth.normal_m_s and c.planned.normal_m_s
    ]
    miss = [v.goal_miss_m for v in good if v.goal_miss_m is not None]
    return (
        f"`{row.mission}`",
        f"{row.away_m:+.2f} m" if row.away_m else f"{row.yaw_deg:+.0f} deg",
        f"`{row.known}`" if row.known else "-",
        f"{len(good)} of {len(verdicts)}",
        f"{statistics.median(off):.3f}" if off else "-",
        f"{statistics.median(miss):.2f}" if miss else "-",
        ", ".join(f"`{name}` {count}" for name, count in reasons.items()) or "-",
    )


HEADS = (
    "mission", "the wall really stands", "the mission says", "completed", "its impact off by, m/s (median)",
    "goal missed by, m (median)", "broken off by",
)  # fmt: skip


def main() -> int:
    """Fly; print the table and write build/walls.md."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=HELD_SEED)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    rows = []
    seeds = range(options.seed, options.seed + options.runs)
    with ProcessPoolExecutor(options.workers) as pool:
        for row in ROWS:
            rows.append(cells(row, list(pool.map(fly, [row] * options.runs, seeds))))
            print(*rows[-1], sep=" | ", flush=True)
    path = ROOT / "build" / "walls.md"
    path.parent.mkdir(exist_ok=True)
    path.write_text(markdown(HEADS, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
