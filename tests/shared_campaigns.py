"""Samples of the campaigns in `tools/campaigns`, run as commands because tests must not import tools."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec

ROOT = Path(__file__).parents[1]


def campaign_rows(out: Path, name: str, *options: str) -> list[dict[str, Any]]:
    """Run a campaign in a new folder and return the rows of its table, with decoded numbers and lists."""
    command = [sys.executable, "-m", "tools.campaigns", name, "--jobs", "1", "--out", str(out), *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    with open(out / "flights.csv", encoding="utf-8", newline="") as file:
        rows = [{key: _decoded(cell) for key, cell in row.items()} for row in csv.DictReader(file)]
    assert done.returncode == 0, (done.stdout, done.stderr, [row["error"] for row in rows])
    return rows


def _decoded(cell: str) -> Any:
    try:
        return msgspec.json.decode(cell) if cell else None
    except msgspec.DecodeError:
        return cell
