"""Campaign: flights with random faults, their outcomes by kind of fault, and the uncontrolled flights."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Sequence

from dart_flight.lab.campaign.flight_job import JudgedRow
from tests.faults.fault_flights import FaultFlight
from tools.campaigns.results import markdown

_HEADS = (
    "fault",
    "flights",
    "completed",
    "other outcomes",
    "median decision",
    "largest excursion m",
    "uncontrolled",
)


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a table with a row for each kind of fault."""
    by_kind: dict[str, list[FaultFlight]] = {}
    for r in rows:
        by_kind.setdefault(r.row.fault, []).append(r.row)
    lines = [markdown(_HEADS, [_row(kind, mine) for kind, mine in sorted(by_kind.items())])]
    lines += [f"- flight {r.seed}: {r.row.fault}: {r.row.problems}" for r in rows if r.row.problems]
    return "\n".join(lines)


def _row(kind: str, mine: Sequence[FaultFlight]) -> list[str]:
    ends = Counter(flight.came_of for flight in mine)
    done = ends.pop("completed", 0)
    times = [flight.decision_ms for flight in mine if flight.decision_ms is not None]
    return [
        kind,
        str(len(mine)),
        str(done),
        ", ".join(f"{name} {count}" for name, count in ends.most_common()) or "-",
        f"{statistics.median(times):.0f} ms" if times else "-",
        f"{max(flight.excursion_m for flight in mine):.2f}",
        str(sum(bool(flight.problems) for flight in mine)),
    ]
