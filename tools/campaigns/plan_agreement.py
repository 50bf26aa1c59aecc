"""How well the planner's flight model predicts the plant: plans of the dual collision, predicted and flown.

python -m tools.campaigns.plan_agreement  (writes docs/results/planning_agreement.md; part of `make campaign`)
"""

from __future__ import annotations

import math
import statistics
import sys
import tempfile
from pathlib import Path

import msgspec

from dart_flight.base.records import Mode, TruthContact
from dart_flight.config.mission import load_mission
from dart_flight.config.scenario import load_scenario
from dart_flight.lab.search.mission_writer import write_mission
from dart_flight.lab.search.search import Plan, search
from dart_flight.recording.verdict import Verdict
from dart_flight.run.fast import fly_fast
from tools.campaigns.results import RESULTS, measured_by

ROOT = Path(__file__).parents[2]
FLIGHTS = 10
POINT = ["simulation.contact.body=point"]  # as planner and flight model have it
PAPER = ((Mode.FLEXIBLE, Mode.RIGID), (-0.6, 0.5))


class Flight(msgspec.Struct):
    """A flight's verdict with the contacts as they were."""

    verdict: Verdict
    contacts: list[TruthContact]


def fly(mission_path: Path, seed: int) -> Flight:
    """One fast flight; truth contacts that are not the planned ones (landing gear has none) stay out."""
    mission = load_mission(mission_path, settings=POINT)
    contacts: list[TruthContact] = []

    def observe(record: object) -> None:
        if isinstance(record, TruthContact):
            contacts.append(record)

    return Flight(fly_fast(mission, seed, None, observe), contacts)


def chosen(plans: tuple[Plan, ...]) -> list[tuple[str, Plan]]:
    """The paper's plan and the best of every mode sequence."""
    found = [("the paper's", plans[_rank(plans) - 1])]
    seen: set[tuple[Mode, ...]] = set()
    for plan in plans:
        if plan.modes not in seen:
            seen.add(plan.modes)
            found.append((f"rank {plan.rank}", plan))
    return found


def _spread(values: list[float], digits: int) -> str:
    deviation = statistics.stdev(values) if len(values) > 1 else 0.0
    return f"{statistics.mean(values):.{digits}f} ± {deviation:.{digits}f}"


def rows_of(name: str, plan: Plan, flights: list[Flight]) -> list[str]:
    """Table rows of one plan."""
    modes = " → ".join(m.value for m in plan.modes)
    done = [
        f for f in flights if f.verdict.outcome == "completed" and len(f.contacts) == len(plan.collisions)
    ]
    head = f"{name}: {modes}, approach ({plan.normal_m_s:g}, {plan.tangential_m_s:g})"
    rows = []
    for k, c in enumerate(plan.collisions):
        truth = [f.contacts[k] for f in done]
        after = [1e-6 * (f.contacts[k].t_us - f.contacts[0].t_us) for f in done]
        away = [math.dist(t.position_mission[:2], c.position_m) for t in truth]
        rows.append(
            f"| {head if k == 0 else ''} | {k + 1} {c.wall} "
            f"| {c.t_s - plan.collisions[0].t_s:.3f} | {_spread(after, 3)} | {_spread(away, 3)} "
            f"| {c.normal_m_s:.3f} | {_spread([t.normal_in_m_s for t in truth], 3)} "
            f"| {c.tangential_m_s:.3f} | {_spread([t.tangential_in_m_s for t in truth], 3)} "
            f"| {c.peak_force_n:.1f} | {_spread([t.peak_normal_force_n for t in truth], 1)} | | |"
            if done
            else f"| {head} | {k + 1} {c.wall} | no flight completed | | | | | | | | | | |"
        )
    misses = [f.verdict.goal_miss_m for f in done if f.verdict.goal_miss_m is not None]
    if misses:
        rows.append(
            f"| | goal, {len(done)} of {len(flights)} completed | | | | | | | | | | {plan.goal_miss_m:.3f} "
            f"| {_spread(misses, 3)} |"
        )
    return rows


def run(report_dir: Path) -> None:
    """Fly and write `planning_agreement.md` into a folder."""
    scenario = load_scenario(ROOT / "missions" / "scenarios" / "dual_collision.yaml")
    result = search(scenario, top=3000)
    lines = [
        "# The flight model against the plant",
        "",
        measured_by("tools.campaigns.plan_agreement"),
        "",
        "Plans of `missions/scenarios/dual_collision.yaml`, predicted and flown in the fast world, "
        f"seeds 1 to {FLIGHTS}, mean ± standard deviation, truth of the plant. Time counts from the first",
        "impact; `away` is the distance between predicted and flown place of the onset.",
        f"{result.feasible} of {result.candidates} candidates are feasible; the paper's plan has rank "
        f"{_rank(result.plans)} of them by `nearest`.",
        "",
        "| plan | at | t s | flown | away m | normal m/s | flown | tangential m/s | flown | peak N | flown "
        "| miss m | flown |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    with tempfile.TemporaryDirectory() as folder:
        for name, plan in chosen(result.plans):
            path = Path(folder) / "mission.yaml"
            write_mission(scenario, plan, path)
            flights = [fly(path, seed) for seed in range(1, FLIGHTS + 1)]
            lines += rows_of(name, plan, flights)
            reasons = {f.verdict.reason for f in flights if f.verdict.reason}
            print(name, plan.rank, reasons, file=sys.stderr)
    (report_dir / "planning_agreement.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _rank(plans: tuple[Plan, ...]) -> int:
    return next(p.rank for p in plans if (p.modes, (p.normal_m_s, p.tangential_m_s)) == PAPER)


if __name__ == "__main__":
    run(RESULTS)
