"""Campaign: simulated flights on an idle and on a busy computer (docs/results/busy_computer.md)."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec

from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.run.embedded import fly_embedded
from dart_flight.run.px4_flight import fly_px4
from dart_flight.sim.pipe import FULL_SPEED
from dart_flight.sim.px4.installation import ENVIRONMENT
from tools.campaigns.results import grouped, markdown

_SEED = 1  # of every flight, so that only the computer differs


class TimedFlight(msgspec.Struct, frozen=True):
    """The true speeds and peak forces of a flight's hits, the goal miss, and the flight's duration here."""

    outcome: str
    speeds_m_s: list[float]
    peaks_n: list[float]
    miss_m: float | None
    spent_s: float


def fly(point: Point, _: int) -> TimedFlight:
    """Fly seed 1 at full speed, beside as many endless loops as the case states."""
    loops = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(int(point.case["loops"]))
    ]
    began_s = time.monotonic()
    try:
        with tempfile.TemporaryDirectory() as folder:
            if point.case["world"] == "px4":
                v = fly_px4(point.mission, os.environ[ENVIRONMENT], _SEED, Path(folder), speed=FULL_SPEED)
            else:
                v = fly_embedded(point.mission, _SEED, Path(folder), speed=FULL_SPEED)
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()
    true = [c.truth for c in v.collisions if c.truth is not None]
    speeds = [-t.normal_m_s for t in true if t.normal_m_s is not None]
    peaks = [t.peak_force_n for t in true if t.peak_force_n is not None]
    return TimedFlight(v.outcome.value, speeds, peaks, v.goal_miss_m, time.monotonic() - began_s)


_HEADS = ("world", "endless loops", "completed", "first hit m/s", "second hit m/s", "second peak N",
          "goal miss mm", "s per flight")  # fmt: skip


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for every world and load, with the range of every figure."""
    table = []
    for key, mine in grouped(rows, "world", "loops").items():
        both = [f for f in mine if len(f.peaks_n) == 2]
        columns = (
            ([f.speeds_m_s[0] for f in both], 4),
            ([f.speeds_m_s[1] for f in both], 4),
            ([f.peaks_n[1] for f in both], 2),
            ([1e3 * f.miss_m for f in both if f.miss_m is not None], 1),
            ([f.spent_s for f in mine], 1),
        )
        completed = f"{sum(f.outcome == 'completed' for f in mine)} of {len(mine)}"
        ranges = (f"{min(c):.{d}f} to {max(c):.{d}f}" if c else "-" for c, d in columns)
        table.append([*key, completed, *ranges])
    return markdown(_HEADS, table)
