"""False impacts in the air, on flight recordings that are no ULogs (docs/results/real_data.md).

    python -m tools.campaigns.hours FILE_OR_FOLDER... [--json FILE]

The recordings of `tools.other_logs` go through `dart_flight.lab.inspect` at the shipped operating
point, as those of `tools.campaigns.real` do. What is felt in the air counts, a second and more from take-off
and landing.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from dart_flight.config.vehicle import load_vehicle
from tools.campaigns.real import events_of, judge
from tools.other_logs import open_other

_AWAY_S = 1.0  # from take-off and landing
_SHIPPED = "learnt 5"
_SUFFIXES = (".csv", ".parquet")


def judge_one(task: tuple[Path, int]) -> dict[str, Any]:
    """Everything about one recording; see `judge`."""
    path, seed = task
    rng = random.Random(f"{seed} {path.name}")
    return judge(path, load_vehicle(), rng, open_other, only_shipped=True)


def in_the_air(row: dict[str, Any]) -> tuple[float, list[float]]:
    """Seconds in the air a second and more from take-off and landing, and the onsets of impacts in them."""
    stretches = [(a + _AWAY_S, b - _AWAY_S) for a, b in row["flights"] if b - a > 2.0 * _AWAY_S]
    hits = [i["t_s"] for i in row["impacts"] if any(a <= i["t_s"] <= b for a, b in stretches)]
    return sum(b - a for a, b in stretches), hits


def summary(rows: list[dict[str, Any]]) -> str:
    """The figures over all recordings, as text."""
    judged = [r for r in rows if "refused" not in r]
    air = [in_the_air(r) for r in judged]
    minutes = sum(s for s, _ in air) / 60.0
    hits, events = sum(len(h) for _, h in air), sum(events_of(h) for _, h in air)
    lines = [f"{len(rows)} recordings, {len(rows) - len(judged)} refused, {minutes:.1f} min in the air"]
    lines += [f"  {r['log']}: {r['refused']}" for r in rows if "refused" in r]
    lines.append(f"{hits} hits in the air, {events} events, {60.0 * events / max(minutes, 1e-9):.1f} an hour")
    lines.append(f"{sum(r['untold'] for r in judged)} more that `feel` cannot tell from manoeuvres")
    fitted = sorted(r["thrust"]["held_out_percent"] for r in judged if r["thrust"])
    if fitted:
        lines.append(
            f"thrust fitted in {len(fitted)}, held-out residual median {fitted[len(fitted) // 2]:.1f} %, "
            f"worst {fitted[-1]:.1f} %"
        )
    for name in ("noise_m_s2", "noise_short_m_s2", "noise_long_m_s2", "threshold_m_s2"):
        values = sorted(r[name] for r in judged if math.isfinite(r[name]))
        if values:
            lines.append(f"{name}: {values[0]:.2f}, {values[len(values) // 2]:.2f}, {values[-1]:.2f}")
    for k, kind in enumerate(("rigid", "flexible")):
        values = sorted(r["floors_m_s2"][k] for r in judged if math.isfinite(r["floors_m_s2"][k]))
        if values:
            lines.append(
                f"floor, {kind}: {values[0]:.2f}, {values[len(values) // 2]:.2f}, {values[-1]:.2f} m/s2"
            )
    pulses = [p for r in judged for p in r.get("pulses", [])]
    for over in sorted({p["over_floor"] for p in pulses}):
        of = [p for p in pulses if p["over_floor"] == over]
        lines.append(
            f"pulses {over:g} times the floor: {sum(p['found_s'] is not None for p in of)} of {len(of)}"
        )
    found = [sum(r["runs"][_SHIPPED]["found_of_15.4_n"][k] for r in judged if "runs" in r) for k in (0, 1)]
    lines.append(f"15.4 N found: {found[0]} of {found[1]}")
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Judge all recordings; prints a summary, writes all of it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", nargs="+", type=Path, help="recordings, or folders of them")
    parser.add_argument("--json", type=Path, default=Path("build/hours.json"))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(arguments)
    paths = sorted(
        p
        for at in options.recordings
        for p in ([at] if at.is_file() else at.rglob("*"))
        if p.suffix in _SUFFIXES
    )
    with ProcessPoolExecutor(options.workers) as pool:
        rows = list(pool.map(judge_one, [(p, options.seed) for p in paths]))
    options.json.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_text(json.dumps(rows, indent=1))
    sys.stdout.write(summary(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
