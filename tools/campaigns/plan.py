"""Ten generated scenarios: plan each, fly the plan with many seeds, compare prediction and flight.

python -m tools.campaigns.plan     (writes docs/results/planning_campaign.md; part of `make campaign`)
"""

from __future__ import annotations

import math
import random
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from dart_flight.config.document import InputError
from dart_flight.config.mission import load_mission
from dart_flight.config.scenario import Objective, load_scenario
from dart_flight.lab.search.mission_writer import write_mission
from dart_flight.lab.search.search import Plan, search
from dart_flight.lab.search.summary import with_objective
from dart_flight.recording.verdict import Verdict
from dart_flight.run.many_flights import fly_fast_many
from tools.campaigns.results import RESULTS, measured_by

ROOT = Path(__file__).parents[2]
SCENARIOS = 10
FLIGHTS = 20
POINT = ["simulation.contact.body=point"]  # as the planner has it
OBJECTIVES = (Objective.NEAREST, Objective.ROBUST)
_SEED = 20_26


class Flown(NamedTuple):
    """One scenario planned by one objective and flown."""

    name: str
    walls: int
    plan: Plan
    verdicts: list[Verdict]


def generate(rng: random.Random, index: int) -> str:
    """A scenario: a room of 5 m, one to three walls around its middle, start and goal between them."""
    count = 1 + index % 3
    first = rng.uniform(0.0, 2.0 * math.pi)
    lines = ["version: 1", f"name: generated-{index + 1}"]
    lines.append("bounds_m: {x: [-2.5, 2.5], y: [-2.5, 2.5], z: [0.3, 2.0]}")
    lines.append("walls:")
    for k in range(count):
        # Facing inwards, at angles that leave the vehicle a way from one to the next.
        angle = first + k * (0.5 * math.pi + rng.uniform(-0.2, 0.2))
        away = rng.uniform(1.3, 1.6)
        x, y = away * math.cos(angle), away * math.sin(angle)
        material = rng.choice(("acrylic", "wood"))
        lines.append(
            f"  wall{k + 1}: {{point_m: [{x:.3f}, {y:.3f}], normal: [{-math.cos(angle):.6f}, "
            f"{-math.sin(angle):.6f}], length_m: {rng.uniform(2.0, 2.8):.2f}, material: {material}}}"
        )
    for key in ("start", "goal"):
        x, y = rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6)
        more = "altitude_m: 1.0" if key == "start" else "capture_radius_m: 0.15, hold_s: 2.0"
        lines.append(f"{key}: {{position_m: [{x:.3f}, {y:.3f}], {more}}}")
    names = [f"wall{k + 1}" for k in range(count)]
    alphas = ", ".join(f"{n}: [{rng.uniform(0.02, 0.05):.3f}, {rng.uniform(0.03, 0.1):.3f}]" for n in names)
    lines.append(f"sequence: [{', '.join(names)}]" if count < 3 else "sequence: any")
    lines += [
        "search:",
        "  normal_m_s: {min: -1.5, max: -0.3, step: 0.05}",
        "  tangential_m_s: {min: -1.5, max: 1.5, step: 0.05}",
        f"alpha_wall_m_per_n: {{{alphas}}}",
        "limits: {speed_m_s: 3.0, peak_force_n: 150.0}",
    ]
    return "\n".join(lines) + "\n"


def fly_all(folder: Path, objectives: tuple[Objective, ...] = OBJECTIVES) -> tuple[list[Flown], int]:
    """Generate, plan and fly; returns the flights and how many generated scenarios had no feasible plan."""
    rng = random.Random(_SEED)
    flown: list[Flown] = []
    infeasible = made = index = 0
    while made < SCENARIOS:
        path = folder / f"scenario_{index + 1}.yaml"
        path.write_text(generate(rng, index), encoding="utf-8")
        index += 1
        try:
            scenario = load_scenario(path, ROOT / "configs" / "dart.yaml")
            for objective in objectives:
                plan = search(with_objective(scenario, objective), top=1).plans[0]
                mission_path = folder / f"mission_{index}_{objective.value}.yaml"
                write_mission(scenario, plan, mission_path)
                verdicts = fly_fast_many(
                    load_mission(mission_path, settings=POINT),
                    range(1, FLIGHTS + 1),
                    None,
                    lambda verdict: None,
                )
                flown.append(Flown(scenario.name, len(scenario.walls), plan, verdicts))
                print(_row(flown[-1]), file=sys.stderr, flush=True)
        except InputError as error:
            print(error.one_line(), file=sys.stderr, flush=True)
            infeasible += 1
            continue
        made += 1
    return flown, infeasible


def report(flown: list[Flown], infeasible: int, elapsed_s: float, objectives: tuple[Objective, ...]) -> str:
    """The page `docs/results/planning_campaign.md`."""
    lines = [
        "# Plans flown: generated scenarios",
        "",
        measured_by("tools.campaigns.plan"),
        "",
        f"{SCENARIOS} scenarios with random start, goal, walls (one to three, any direction), materials and "
        f"gains, seed {_SEED}; {infeasible} more had no feasible plan and were passed over. Each was "
        f"planned by {' and by '.join(objectives)} and each plan flown with `dry-run --fast`, "
        f"seeds 1 to {FLIGHTS}. "
        f"The miss is the verdict's `goal_miss_m`. {elapsed_s:.0f} s in all.",
        "",
        "| scenario | walls hit, modes | objective | approach m/s | predicted miss m | expected / worst m "
        "| completed | flown miss m: median, 5 % .. 95 % | broken off by |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [_row(f) for f in flown]
    lines += ["", *_summary(flown), ""]
    return "\n".join(lines)


def _row(f: Flown) -> str:
    p = f.plan
    hits = ", ".join(f"{c.wall} {c.mode.value}" for c in p.collisions)
    objective = "nearest" if p.expected_miss_m is None else "robust"
    expected = "" if p.expected_miss_m is None else f"{p.expected_miss_m:.3f} / {p.worst_miss_m:.3f}"
    done = [v for v in f.verdicts if v.outcome == "completed"]
    misses = sorted(v.goal_miss_m for v in done if v.goal_miss_m is not None)
    spread = "-"
    if misses:
        low, high = misses[len(misses) // 20], misses[-1 - len(misses) // 20]
        spread = f"{statistics.median(misses):.3f}, {low:.3f} .. {high:.3f}"
    reasons = sorted({(v.reason or "").split(":")[0] for v in f.verdicts if v.outcome != "completed"})
    return (
        f"| {f.name} | {hits} | {objective} | {p.normal_m_s:.3f}, {p.tangential_m_s:.3f} "
        f"| {p.goal_miss_m:.3f} | {expected} | {len(done)} of {len(f.verdicts)} | {spread} "
        f"| {', '.join(reasons)} |"
    )


def _summary(flown: list[Flown]) -> list[str]:
    lines = []
    for objective, wanted in (("nearest", False), ("robust", True)):
        chosen = [f for f in flown if (f.plan.expected_miss_m is not None) is wanted]
        if not chosen:
            continue
        errors, misses, speeds = [], [], []
        for f in chosen:
            for v in f.verdicts:
                if v.outcome == "completed" and v.goal_miss_m is not None:
                    misses.append(v.goal_miss_m)
                    errors.append(abs(v.goal_miss_m - f.plan.goal_miss_m))
                    for c, planned in zip(v.collisions, f.plan.collisions, strict=True):
                        if c.truth is not None and c.truth.normal_m_s is not None:
                            speeds.append(c.truth.normal_m_s / planned.normal_m_s - 1.0)
        count = sum(len(f.verdicts) for f in chosen)
        lines.append(
            f"- `{objective}`: {len(misses)} of {count} flights completed; median flown miss "
            f"{statistics.median(misses):.3f} m, median |flown − predicted| "
            f"{statistics.median(errors):.3f} m; "
            f"normal impact speed {100 * statistics.mean(speeds):+.1f} % of the predicted on average, "
            f"standard deviation {100 * statistics.stdev(speeds):.1f} %."
        )
    return lines


def run(report_dir: Path, objectives: tuple[Objective, ...] = OBJECTIVES) -> None:
    """Fly the campaign and write `planning_campaign.md` into a folder."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        flown, infeasible = fly_all(Path(folder), objectives)
    page = report(flown, infeasible, time.monotonic() - began, objectives)
    (report_dir / "planning_campaign.md").write_text(page, encoding="utf-8")


if __name__ == "__main__":
    run(RESULTS, tuple(Objective(name) for name in sys.argv[1:]) or OBJECTIVES)
