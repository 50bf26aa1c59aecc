"""Campaign: the fault matrix as a table, with each flight's outcome and the time of its first decision."""

from __future__ import annotations

from collections.abc import Sequence

from dart_flight.lab.campaign.flight_job import JudgedRow
from tests.faults.fault_flights import FaultFlight
from tools.campaigns.results import markdown


def page(rows: Sequence[JudgedRow]) -> str:
    """Return the matrix, one row per fault, followed by the uncontrolled flights."""
    cells = {(r.values["fault"], r.values["phase"]): _cell(r.row) for r in rows}
    faults = dict.fromkeys(fault for fault, _ in cells)
    phases = tuple(dict.fromkeys(phase for _, phase in cells))
    table = markdown(
        ("fault", *phases), [[fault, *(cells.get((fault, p), "") for p in phases)] for fault in faults]
    )
    wrong = [f"- {r.values['fault']} @ {r.values['phase']}: {r.row.problems}" for r in rows if r.row.problems]
    return "\n".join([table, f"{len(rows)} cells, {len(wrong)} uncontrolled.", *wrong])


def _cell(flight: FaultFlight) -> str:
    if not flight.began:
        return "-"
    return flight.came_of + ("" if flight.decision_ms is None else f" {flight.decision_ms:.0f} ms")
