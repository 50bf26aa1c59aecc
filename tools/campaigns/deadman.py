"""Campaign: the last setpoint on the wire after a fault of the program (docs/results/deadman.md)."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import msgspec

from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from tests.faults.deadman_flights import last_setpoint_s
from tools.campaigns.results import grouped, markdown, median_and_most


class LastSetpoint(msgspec.Struct, frozen=True):
    """Time from the fault to the last setpoint; negative if the setpoint came just before the fault."""

    after_ms: float


def fly(point: Point, _: int) -> LastSetpoint:
    """Fly in real time through MAVSDK and a recording proxy."""
    with tempfile.TemporaryDirectory() as folder:
        return LastSetpoint(1e3 * last_setpoint_s(point.case["fault"], Path(folder)))


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for every fault."""
    table = [
        [f"`{fault}`", str(len(mine)), median_and_most(f.after_ms for f in mine)]
        for (fault,), mine in grouped(rows, "fault").items()
    ]
    return markdown(("fault", "flights", "last setpoint after it, ms: median, latest"), table)
