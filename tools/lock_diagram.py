"""Writes the lock's state diagram, from the table of the state machine, into `docs/lock.md`.

python -m tools.lock_diagram
"""

from __future__ import annotations

from pathlib import Path

from dart_flight.lock.state_machine import diagram

PAGE = Path(__file__).resolve().parents[1] / "docs" / "lock.md"
BEGIN, END = "<!-- begin: python -m tools.lock_diagram -->\n", "<!-- end -->"


def with_diagram(page: str) -> str:
    """The page with the diagram of today's table between its marks.

    Raises:
        ValueError: the marks are not there.
    """
    start, end = page.index(BEGIN) + len(BEGIN), page.index(END)
    return f"{page[:start]}```mermaid\n{diagram()}```\n{page[end:]}"


if __name__ == "__main__":
    PAGE.write_text(with_diagram(PAGE.read_text()))
