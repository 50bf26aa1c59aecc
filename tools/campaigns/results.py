"""Where campaigns leave their pages, and the line that every page begins with: when, by what, and where."""

from __future__ import annotations

from datetime import date
from pathlib import Path

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"


def measured_by(module: str, where: str = "in simulation") -> str:
    """The line below the title of a page of docs/results; the day is today."""
    return f"Measured on {date.today().isoformat()} by `python -m {module}`, {where}."
