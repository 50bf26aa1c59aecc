"""Campaign: whether recorded flights are replayed bit-equal (docs/results/replay.md)."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import msgspec

from dart_flight.base.records import World
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.recording.reader import read_log
from dart_flight.run.embedded import fly_embedded
from dart_flight.run.fast import fly_fast
from dart_flight.run.px4_flight import fly_px4
from dart_flight.run.replay import replay
from dart_flight.sim.pipe import FULL_SPEED
from dart_flight.sim.px4.installation import ENVIRONMENT
from tools.campaigns.results import grouped, markdown


class Replayed(msgspec.Struct, frozen=True):
    """One flight and its replay; `missing` counts records that the replay lacks."""

    outcome: str
    inputs: int
    outputs: int
    decisions: int
    differences: int
    missing: int


def fly(point: Point, seed: int) -> Replayed:
    """Fly in one world, and replay the log."""
    mission, world = point.mission, World(point.case["world"])
    with tempfile.TemporaryDirectory() as folder:
        fly_here = {
            World.FAST: partial(fly_fast, mission),
            World.EMBEDDED: partial(fly_embedded, mission, speed=FULL_SPEED),
            World.PX4: partial(fly_px4, mission, os.environ.get(ENVIRONMENT)),
        }[world]
        verdict = fly_here(seed, Path(folder))
        assert verdict.log is not None
        result = replay(read_log(verdict.log))
    counts = result.inputs, result.outputs, len(result.recorded), len(result.differences), result.missing
    return Replayed(verdict.outcome.value, *counts)


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a table with the sums over the flights of each world."""
    names = ("inputs", "outputs", "decisions", "differences", "missing")
    return markdown(
        ("world", "flights", *names),
        [
            [world, str(len(mine)), *(str(sum(getattr(one, n) for one in mine)) for n in names)]
            for (world,), mine in grouped(rows, "world").items()
        ],
    )
