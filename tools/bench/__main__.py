"""`make bench`: speed and memory as a table and as build/bench.json.

    python -m tools.bench [NAME]

Every ratio refers to a baseline measured in the same run. Each module in `tools/bench/` measures one part and
has `rows() -> list[Row]`. With a NAME, the table is written into the pages of docs/results that have a block
`bench NAME`.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from dart_flight.config.document import InputError
from tools.campaigns import results

Row = dict[str, Any]  # name, value, unit, baseline, ratio: docs/interfaces.md

MODULES = ("contact", "plan", "core", "log", "latency", "poses", "share")
NAMES = (*MODULES, "stepwise", "studio")  # the last two need other software: rotorpy, Chromium
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


def measure(name: str) -> None:
    """Run one benchmark, print its table and write its block.

    Raises:
        InputError: a file of the program differs from the commit.
    """
    pages = results.pages_with(f"bench {name}")
    commit = results.current_commit() if pages else ""
    began_s = time.monotonic()
    found = importlib.import_module(f"tools.bench.{name}").rows()
    cells = [
        [
            row["name"],
            f"{_shown(row['value'])} {row['unit']}",
            *(_shown(row[key]) for key in ("baseline", "ratio")),
        ]
        for row in found
    ]
    table = results.markdown(("", "measured", "baseline", "ratio"), cells)
    print(table)
    machine = f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}"
    for page in pages:
        command = f"python -m tools.bench {name}"
        head = results.measured_line(command, commit, machine, time.monotonic() - began_s)
        results.write_block(page, f"bench {name}", f"{head}\n\n{table}")


def _shown(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:.4g}"


def main() -> int:
    """Run one benchmark, or all of them; then print the table and write the file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("name", nargs="?", choices=NAMES)
    if name := parser.parse_args().name:
        try:
            measure(name)
        except InputError as error:
            sys.stderr.write(f"{error.one_line()}\n")
            return 2
        return 0
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
        figures = [_shown(row[k]) for k in ("value", "baseline", "ratio")]
        table.add_row(row["name"], figures[0], row["unit"], figures[1], figures[2])
    Console().print(table)
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    OUTPUT.write_text(json.dumps(found, indent=2) + "\n")
    console.print(f"written: {OUTPUT}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
