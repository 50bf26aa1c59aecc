"""Benchmark: what an attached `monitor` costs a flight's set-points, in alternating pairs of whole flights.

    python -m tools.bench.watched [--pairs N]

Every flight is a `dry-run` of the single wall in the embedded world, in a process of its own; in every second
one `monitor` attaches as the approach begins. From its log: the intervals between the receipts of the samples
that led to set-points, from the approach to the goal, and the time from a sample to the recovery set-point.
docs/results/observers.md has the figures; they mean something where nothing else runs.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from itertools import pairwise
from pathlib import Path
from statistics import fmean, median, quantiles

import msgspec
from rich.console import Console
from rich.table import Table

from dart_flight.base.records import Phase, PhaseChange, SetPoint, SetPointSent
from dart_flight.config.vehicle import packaged
from dart_flight.recording.reader import read_log

PAIRS = 4
_FLIGHT_S = 120.0


class Timing(msgspec.Struct):
    """One flight: intervals of set-points and the latency of the recovery set-point, milliseconds."""

    mean: float
    median: float
    percentile_99: float
    longest: float
    recovery: float | None


def timing(log: Path) -> Timing:
    """From a flight's log.

    Raises:
        ValueError: it has no two set-points between approach and goal.
    """
    received: dict[int, int] = {}  # number of an input -> when the host received it
    led: dict[int, int] = {}  # the same, of inputs that led to a set-point
    phase: Phase | None = None
    recovery = None
    for entry in read_log(log).entries:
        record = entry.record
        if isinstance(record, PhaseChange):
            phase = record.after
        elif isinstance(record, SetPointSent):
            recovery = record.latency_us * 1e-3
        elif isinstance(record, SetPoint):
            flown = phase in (Phase.APPROACH, Phase.CONTACT, Phase.RECOVERY)
            if flown and entry.number in received:
                led[entry.number] = received[entry.number]
        elif hasattr(record, "received_us"):
            received[entry.number] = record.received_us
    times = sorted(led.values())
    gaps = [(after - before) * 1e-3 for before, after in pairwise(times)]
    if len(gaps) < 2:
        raise ValueError(f"{log}: no set-points between approach and goal")
    return Timing(fmean(gaps), median(gaps), quantiles(gaps, n=100)[98], max(gaps), recovery)


def fly(folder: Path, *, watched: bool) -> Timing:
    """One flight.

    Raises:
        RuntimeError: it does not complete.
    """
    environment = {**os.environ, "DART_FLIGHT_STATE_DIR": str(folder / "state")}
    program = [sys.executable, "-m", "dart_flight"]
    mission = str(packaged("missions", "paper_single_wall.yaml"))
    command = [*program, "dry-run", mission, "--json", "--log-dir", str(folder)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, text=True) as flight:
        assert flight.stderr is not None
        begun = any("approach" in line for line in flight.stderr)
        monitor = None
        if begun and watched:
            watch = [*program, "monitor", "--json"]
            monitor = subprocess.Popen(watch, env=environment, stdout=pipe, stderr=pipe)
        out, error = flight.communicate(timeout=_FLIGHT_S)
        if monitor is not None:
            monitor.communicate(timeout=_FLIGHT_S)
    if flight.returncode != 0:
        raise RuntimeError(f"a flight did not complete: {error.strip().splitlines()[-1]}")
    return timing(Path(json.loads(out)["log"]))


def main() -> int:
    """Fly the pairs and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--pairs", type=int, default=PAIRS)
    pairs = parser.parse_args().pairs
    flown: dict[bool, list[Timing]] = {False: [], True: []}
    for _ in range(pairs):
        for watched in (False, True):
            with tempfile.TemporaryDirectory() as folder:
                flown[watched].append(fly(Path(folder), watched=watched))
    table = Table(title=f"{pairs} pairs, ms: median (least to most); load average {os.getloadavg()[0]:.1f}")
    for name in ("", "without monitor", "attached"):
        table.add_column(name)
    for field in msgspec.structs.fields(Timing):
        values = (
            sorted(v for t in flown[watched] if (v := getattr(t, field.name)) is not None)
            for watched in (False, True)
        )
        shown = (f"{median(v):.2f} ({v[0]:.2f} to {v[-1]:.2f})" if v else "-" for v in values)
        table.add_row(field.name.replace("_", " "), *shown)
    Console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
