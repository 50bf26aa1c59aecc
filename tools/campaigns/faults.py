"""Campaign: the fault matrix: what ends a flight with each fault, and after what time."""

from __future__ import annotations

from collections.abc import Sequence

from dart_flight.lab.campaign.flight_job import JudgedRow
from tests.faults.fault_flights import ON_GROUND, FaultFlight
from tools.campaigns.results import grouped, markdown


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for all faults that end flights in the same ways, and the uncontrolled flights."""
    alike: dict[str, list[str]] = {}
    flights: dict[str, list[FaultFlight]] = {}
    flown = [r for r in rows if r.row.began and r.values["phase"] != ON_GROUND]
    for (fault,), mine in grouped(flown, "fault").items():
        ends = ", ".join(sorted({flight.came_of for flight in mine}))
        alike.setdefault(ends, []).append(fault)
        flights.setdefault(ends, []).extend(mine)
    table = [[", ".join(alike[ends]), ends, _range_ms(flights[ends])] for ends in alike]
    wrong = [f"- {r.values['fault']} @ {r.values['phase']}: {r.row.problems}" for r in rows if r.row.problems]
    heads = ("faults in the air", "what ended the flights", "first decision, ms")
    return "\n".join([markdown(heads, table), f"{len(rows)} cells, {len(wrong)} uncontrolled.", *wrong])


def _range_ms(flights: Sequence[FaultFlight]) -> str:
    times = [flight.decision_ms for flight in flights if flight.decision_ms is not None]
    return f"{min(times):.0f} to {max(times):.0f}" if times else "-"
