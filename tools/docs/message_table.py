"""The acceptance table of MAVLink messages for `docs/link.md` (`tools/docs/generated.py`)."""

from __future__ import annotations

from dart_flight.vehicle.messages import ENTRIES


def table() -> str:
    """Return the messages as a Markdown table, one row each."""
    rows = [
        "| message | stream | instance | frame | units and scale | no sample |",
        "|---|---|---|---|---|---|",
    ]
    rows += [
        f"| {e.message} | {e.stream.name if e.stream else '-'} | {e.which} | {e.frame} | {e.units} | "
        f"{e.invalid} |"
        for e in ENTRIES
    ]
    return "\n".join(rows) + "\n"
