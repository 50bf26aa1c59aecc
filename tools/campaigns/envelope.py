"""How askew, how fast and how far beside the centre a hit may be: what `planning.envelope` knows.

    python -m tools.campaigns.envelope            # build/envelope.md

One acrylic wall with room for a run-up (wide_room.yaml), turned about where it is met, in both modes; the
body as configured and at its worst corner. Fast world, seeds that nothing was tuned on.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections import Counter
from collections.abc import Iterable, Sequence

import msgspec

from tools.campaigns.body import FIRST_SEED, ROOT, WIDE_ROOM, WORST, Case, Flown, Job, default_case, fly_all

SPEEDS_M_S = (0.5, 1.0, 2.0, 3.0)
INCIDENCES_DEG = (0.0, 10.0, 20.0, 30.0)
HEIGHTS_M = (-0.05, -0.03, -0.015, 0.015, 0.03, 0.05)
_SLIDES = 0.3  # along the wall for each m/s towards it: it is met in its middle, about which it turns
MODES = ("rigid", "flexible")


def jobs(case: Case, seeds: Iterable[int], heights: bool) -> list[Job]:
    """Every incidence to either side at the case's guard height; then heights at 0 and 10 degrees."""
    found = []
    for seed, mode, speed in itertools.product(seeds, MODES, SPEEDS_M_S):
        for incidence in INCIDENCES_DEG:
            sides = (incidence, -incidence) if incidence else (0.0,)
            found += [Job(WIDE_ROOM, seed, case, yaw, -speed, mode, _SLIDES * speed) for yaw in sides]
        for height in HEIGHTS_M if heights else ():
            other = msgspec.structs.replace(case, name=f"guards {height:+.2f} m", guard_height_m=height)
            found += [Job(WIDE_ROOM, seed, other, yaw, -speed, mode, _SLIDES * speed) for yaw in (0.0, 10.0)]
    return found


def table(flights: Sequence[Flown], head: str, of: str) -> list[str]:
    """Rows by mode and speed, columns by what `of` names; cells: completed, worst tilt, what broke off."""
    columns = sorted({_key(f, of) for f in flights})
    lines = [
        f"| {head} | " + " | ".join(f"{c:g}" for c in columns) + " |",
        "|---|" + "---|" * len(columns),
    ]
    for mode, speed in itertools.product(MODES, SPEEDS_M_S):
        cells = []
        for column in columns:
            mine = [
                f for f in flights if (f.job.mode, f.job.normal_m_s, _key(f, of)) == (mode, -speed, column)
            ]
            cells.append(_cell(mine))
        lines.append(f"| {mode}, {speed:g} m/s | " + " | ".join(cells) + " |")
    return lines


def _key(flown: Flown, of: str) -> float:
    return abs(flown.job.yaw_deg) if of == "incidence" else flown.job.case.guard_height_m


def _cell(flights: Sequence[Flown]) -> str:
    done = sum(f.kind == "completed" for f in flights)
    tilt = max((hit.tilt_deg for f in flights for hit in f.hits[:1]), default=0.0)
    rules = Counter(f.rule.split(":")[0] for f in flights if f.kind == "broken off")
    lost = sum(f.kind == "uncontrolled" for f in flights)
    words = [f"{done}/{len(flights)}, {tilt:.0f}°", *(f"`{rule}` {count}" for rule, count in rules.items())]
    return ", ".join([*words, f"**{lost} uncontrolled**"] if lost else words)


def main() -> int:
    """Fly what is missing and write the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--runs", type=int, default=1, help="seeds of each cell")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--fresh", action="store_true")
    options = parser.parse_args()
    seeds = range(FIRST_SEED + 1000, FIRST_SEED + 1000 + options.runs)
    case = default_case()
    flights = fly_all("envelope", jobs(case, seeds, True), options.processes, options.fresh)
    worst = fly_all("envelope-worst", jobs(WORST, seeds, False), options.processes, options.fresh)
    level = [f for f in flights if f.job.case.guard_height_m == case.guard_height_m]
    text = [
        "Completed flights, largest tilt within 0.6 s of the hit, what broke off.",
        "",
        "Configured body:",
        "",
        *table(level, "incidence, degrees", "incidence"),
        "",
        "Worst corner of the plausible ranges:",
        "",
        *table(worst, "incidence, degrees", "incidence"),
        "",
        "Configured body, guards beside the centre of mass's height, at 0 and 10 degrees:",
        "",
        *table(flights, "guards above the centre, m", "height"),
    ]
    path = ROOT / "build" / "envelope.md"
    path.write_text("\n".join(text) + "\n", encoding="utf-8")
    print("\n".join(text))
    return 0


if __name__ == "__main__":
    sys.exit(main())
