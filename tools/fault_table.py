"""Writes the table of faults into `docs/faults.md`.

python -m tools.fault_table
"""

from __future__ import annotations

from pathlib import Path

from dart_flight.sim.faults import KINDS

PAGE = Path(__file__).resolve().parents[1] / "docs" / "faults.md"
BEGIN, END = "<!-- begin: python -m tools.fault_table -->\n", "<!-- end -->"


def table() -> str:
    """The faults as a Markdown table, one row each."""
    rows = ["| fault | what goes wrong | where | value | default |", "|---|---|---|---|---|"]
    for kind in KINDS:
        value = f"{kind.low:g} to {kind.high:g} {kind.unit}" if kind.unit else "-"
        default = f"{kind.value:g}" if kind.unit else "-"
        rows.append(f"| `{kind.name}` | {kind.what} | {kind.place.value} | {value} | {default} |")
    return "\n".join(rows) + "\n"


def with_table(page: str) -> str:
    """The page with today's table between its marks.

    Raises:
        ValueError: the marks are not there.
    """
    start, end = page.index(BEGIN) + len(BEGIN), page.index(END)
    return f"{page[:start]}{table()}{page[end:]}"


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
