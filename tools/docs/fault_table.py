"""The table of faults for `docs/faults.md` (`tools/docs/generated.py`)."""

from __future__ import annotations

from dart_flight.sim.faults.fault_table import KINDS


def table() -> str:
    """Return the faults as a Markdown table, one row each."""
    rows = ["| fault | what goes wrong | where | value | default |", "|---|---|---|---|---|"]
    for kind in KINDS:
        value = f"{kind.low:g} to {kind.high:g} {kind.unit}" if kind.unit else "-"
        default = f"{kind.value:g}" if kind.unit else "-"
        rows.append(f"| `{kind.name}` | {kind.description} | {kind.site.value} | {value} | {default} |")
    return "\n".join(rows) + "\n"
