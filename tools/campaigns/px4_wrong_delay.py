"""Campaign: wrong delays of the motion capture on a real PX4 (docs/results/px4_wrong_delay.md)."""

from __future__ import annotations

from collections.abc import Sequence

from dart_flight.base.summary import cause_of
from dart_flight.lab.campaign.flight_job import JudgedRow
from tools.campaigns.results import causes, grouped, markdown, median_and_most

_HEADS = ("`EKF2_EV_DELAY`", "completed", "tilt °: median, most", "estimate off m: median, most", "ended by")


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for every delay."""
    table = []
    for (parameter,), mine in grouped(rows, "parameter").items():
        cells = [
            f"{parameter.split()[3]} ms",
            f"{sum(f.outcome == 'completed' for f in mine)} of {len(mine)}",
            median_and_most(f.tilt_deg for f in mine),
            median_and_most((f.ekf_m for f in mine), 2),
            causes(cause_of(f.reason) for f in mine if f.outcome != "completed"),
        ]
        table.append(cells)
    return markdown(_HEADS, table)
