"""Where campaigns leave their pages, the line that every page begins with, and tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import date
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"


def measured_by(module: str, where: str = "in simulation") -> str:
    """The line below the title of a page of docs/results; the day is today."""
    return f"Measured on {date.today().isoformat()} by `python -m {module}`, {where}."


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = (heads, ["---"] * len(heads), *rows)
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)
