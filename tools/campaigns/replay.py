"""Campaign: whether recorded flights are replayed bit-equal (docs/results/replay.md)."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from dart_flight.lab.campaign.flight_job import FlownFlight, JudgedRow
from dart_flight.run.replay import replay
from tools.campaigns.results import markdown


class Replayed(msgspec.Struct, frozen=True):
    """One flight and its replay; `missing` counts records that the replay lacks."""

    outcome: str
    inputs: int
    outputs: int
    decisions: int
    differences: int
    missing: int


def judge(flown: FlownFlight) -> Replayed:
    """Replay the log of a flight."""
    result = replay(flown.log)
    counts = result.inputs, result.outputs, len(result.recorded), len(result.differences), result.missing
    return Replayed(flown.verdict.outcome.value, *counts)


def page(rows: Sequence[JudgedRow]) -> str:
    """Return the sums over every mission."""
    missions: dict[str, list[Replayed]] = {}
    for r in rows:
        missions.setdefault(r.mission, []).append(r.row)
    names = ("inputs", "outputs", "decisions", "differences", "missing")
    return markdown(
        ("mission", "flights", *names),
        [
            [name, str(len(mine)), *(str(sum(getattr(one, n) for one in mine)) for n in names)]
            for name, mine in missions.items()
        ],
    )
