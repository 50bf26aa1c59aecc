"""Writes the table of the guard's rules into `docs/guard.md`.

python -m tools.guard_table
"""

from __future__ import annotations

from pathlib import Path

from dart_flight.flight.guard_rules import table

PAGE = Path(__file__).resolve().parents[1] / "docs" / "guard.md"
BEGIN, END = "<!-- begin: python -m tools.guard_table -->\n", "<!-- end -->"


def with_table(page: str) -> str:
    """The page with today's table between its marks.

    Raises:
        ValueError: the marks are not there.
    """
    start, end = page.index(BEGIN) + len(BEGIN), page.index(END)
    return f"{page[:start]}{table()}{page[end:]}"


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
