"""`make bench`: speed and memory as a table and as build/bench.json.

Every ratio refers to a baseline measured in the same run. Each module in `tools/bench/` measures one part and
has `rows() -> list[Row]`.
"""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

Row = dict[str, Any]  # name, value, unit, baseline, ratio: docs/interfaces.md

MODULES = ("contact", "plan", "core", "log", "latency", "poses", "share")
OUTPUT = Path("build/bench.json")


def cli_help() -> list[Row]:
    """Measure the time of `dart-flight --help`, with the start of the bare interpreter as the baseline."""

    def seconds(*arguments: str) -> float:
        times = []
        for _ in range(5):
            start = time.perf_counter()
            subprocess.run([sys.executable, *arguments], stdout=subprocess.DEVNULL, check=True)
            times.append(time.perf_counter() - start)
        return min(times)

    bare = seconds("-c", "pass")
    value = seconds("-m", "dart_flight", "--help")
    return [{"name": "cli help", "value": value, "unit": "s", "baseline": bare, "ratio": bare / value}]


def main() -> int:
    """Run all benchmarks, print the table and write the file."""
    console = Console(stderr=True)
    found: list[Row] = []
    for name in MODULES:
        console.print(f"[dim]{name} ...[/]")
        found += importlib.import_module(f"tools.bench.{name}").rows()
    found += cli_help()
    table = Table(title="bench")
    for column in ("name", "value", "unit", "baseline", "ratio"):
        table.add_column(column, justify="left" if column in ("name", "unit") else "right")
    for row in found:
        figures = ["-" if row[k] is None else f"{row[k]:.4g}" for k in ("value", "baseline", "ratio")]
        table.add_row(row["name"], figures[0], row["unit"], figures[1], figures[2])
    Console().print(table)
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    OUTPUT.write_text(json.dumps(found, indent=2) + "\n")
    console.print(f"written: {OUTPUT}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
