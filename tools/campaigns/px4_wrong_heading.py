"""Campaign: hits after a wrong heading on a real PX4 (docs/results/px4_wrong_heading.md)."""

from __future__ import annotations

from collections.abc import Sequence

from dart_flight.lab.campaign.flight_job import JudgedRow
from tools.campaigns.results import grouped, markdown, median_and_most

_HEADS = ("disturbance", "phase", "mission", "flights", "with hits", "m/s: median, most", "N: median, most",
          "largest tilt °", "uncontrolled")  # fmt: skip


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for every disturbance."""
    table = []
    for key, mine in grouped(rows, "disturbance", "phase", "mission").items():
        hits = [hit for flown in mine for hit in flown.hits]
        cells = [
            str(len(mine)),
            str(sum(bool(flown.hits) for flown in mine)),
            median_and_most((speed for speed, _ in hits), 2),
            median_and_most(force for _, force in hits),
            f"{max(flown.tilt_deg for flown in mine):.0f}",
            str(sum(bool(flown.problems) for flown in mine)),
        ]
        table.append([*key, *cells])
    return markdown(_HEADS, table)
