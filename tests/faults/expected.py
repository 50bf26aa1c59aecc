"""Expected outcomes of the cells of the fault matrix, read from `expected.csv`."""

from __future__ import annotations

import csv
from pathlib import Path


def expected_outcomes() -> dict[tuple[str, str], frozenset[str]]:
    """Return the allowed outcomes of every cell: rules of the guard, `completed`, or `app gone`."""
    with open(Path(__file__).with_name("expected.csv"), newline="") as file:
        rows = list(csv.reader(file))
    return {
        (row[0], phase): frozenset(cell.split("|"))
        for row in rows[1:]
        for phase, cell in zip(rows[0][1:], row[1:], strict=True)
        if cell
    }
