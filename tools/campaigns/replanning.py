"""Three ways to go on after a hit, on the same seeds: the setpoint, then straight to the goal, replan.

    python -m tools.campaigns.replanning             # 200 flights each, contact 0.3; build/replanning.md
    python -m tools.campaigns.replanning --vary all --runs 200 --ways setpoint replan
    python -m tools.campaigns.replanning --body point

What is judged is the truth of the simulated vehicle. A flight that is broken off counts in every row.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from unittest.mock import patch

import msgspec
import numpy as np
from rich.console import Console
from rich.progress import track

from dart_flight.base.geometry import distance2
from dart_flight.base.records import (
    AfterImpact,
    GoalPassed,
    Outcome,
    Override,
    PlanTaken,
    Record,
    TruthContact,
    TruthSample,
    World,
)
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import LockDriver
from dart_flight.core import flight_core
from dart_flight.core.mission.executive import Executive
from dart_flight.core.mission.phases import PhaseTrigger
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.sense.state import FlightState
from dart_flight.lab.statistics import wilson
from dart_flight.planning.predicted_flight import predict_mission
from dart_flight.recording.verdict import VerdictBuilder
from dart_flight.run.fast import FastFlight
from dart_flight.sim.draws import draw_world, parse_vary
from tools.campaigns.faults import Watch, judge, run_out
from tools.campaigns.results import ROOT, markdown

_RISE_M = 0.03  # by which the distance to the goal has risen after a closest approach
HELD_SEED, TUNING_SEED = 12001, 1  # rules were tuned on the seeds from the second one on only


class _Straight(Executive):
    """The paper's setpoint until the last contact is over, then straight to the goal."""

    def _watch_goal(self, state: FlightState, p: Proposal, timed_out: bool) -> None:
        if self.progress.lock.contact_end_us is None and not timed_out:
            return
        miss = distance2(state.position, self.mission.goal.position_m)
        p.outputs.append(GoalPassed(state.now_us, miss))
        self._head_for_goal(state, miss)
        self.progress.captured_us = None
        self._go(PhaseTrigger.PASSED, state, p)


WAYS = {
    "setpoint": "the paper's setpoint",
    "straight": "the paper's, then straight to the goal",
    "replan": "replan",
}


class Flown(msgspec.Struct):
    """One flight.

    Attributes:
        way, seed: what was flown.
        outcome: of the verdict.
        rule: that broke it off.
        problems: why it counts as uncontrolled.
        second_m_s: true (normal, tangential) velocity at the second wall; None: not met.
        miss_m: distance to the goal at the first closest approach after the last contact.
        capture_s: from the last contact's end until the goal is held.
        taken: plans that were flown, and why others were not.
    """

    way: str
    seed: int
    outcome: str
    rule: str
    problems: list[str]
    second_m_s: tuple[float, float] | None
    miss_m: float | None
    capture_s: float | None
    taken: list[str]


def _goal_figures(
    mission: Mission, end_us: int | None, track_m: Sequence[tuple[int, float]]
) -> tuple[float | None, float | None]:
    """First closest approach to the goal after a moment, m, and from when on it is held, s."""
    if end_us is None:
        return None, None
    after = [(t, d) for t, d in track_m if t >= end_us]
    least = math.inf
    for _, distance in after:
        if distance > least + _RISE_M:
            break
        least = min(least, distance)
    held_us = None
    hold_us, radius = mission.goal.hold_s * 1e6, mission.goal.capture_radius_m
    since: int | None = None
    for t_us, distance in after:
        since = (since or t_us) if distance <= radius else None
        if since is not None and t_us - since >= 0.9 * hold_us:
            held_us = since
            break
    return least, None if held_us is None else (held_us - end_us) * 1e-6


def fly(way: str, seed: int, vary: Sequence[str], settings: Sequence[str], path: str) -> Flown:
    """One flight, on to the ground."""
    mission = load_mission(path, settings=settings)
    after = AfterImpact.REPLAN if way == "replan" else AfterImpact.SETPOINT
    mission = msgspec.structs.replace(mission, after_impact=after)
    world = draw_world(mission, seed, parse_vary(vary, mission.vehicle))
    watch, builder = Watch(mission), VerdictBuilder(mission)
    contacts: list[TruthContact] = []
    way_to_goal: list[tuple[int, float]] = []
    taken: list[str] = []

    def observe(record: Record, number: int) -> None:
        builder.take(record)
        watch.take(record)
        if isinstance(record, TruthContact):
            contacts.append(record)
        elif isinstance(record, TruthSample):
            way_to_goal.append((record.t_us, distance2(record.position_mission, mission.goal.position_m)))
        elif isinstance(record, PlanTaken):
            taken.append("" if record.taken else record.reason)

    with patch.object(flight_core, "Executive", _Straight if way == "straight" else Executive):
        flight = FastFlight(
            mission, seed, LockDriver.MOCK, faults=world.lock_faults, observe=observe, world=world
        )
        flight.run()
        run_out(flight)
    verdict = builder.build(World.FAST, seed)
    fired = [one.rule for one in verdict.guard if one.action is not Override.NONE]
    rule = fired[0] if fired and verdict.outcome != Outcome.COMPLETED else ""
    second = next((c for c in contacts if c.wall == mission.collisions[-1].wall.name), None)
    end_us = None if second is None else second.end_us
    miss, capture = _goal_figures(mission, end_us, way_to_goal)
    return Flown(
        way,
        seed,
        verdict.outcome.value,
        rule,
        list(judge(flight, watch, None, verdict.outcome, rule)),
        None if second is None else (second.normal_in_m_s, second.tangential_in_m_s),
        miss,
        capture,
        taken,
    )


def summary(name: str, flights: list[Flown], planned: tuple[float, float]) -> list[str]:
    """One row."""
    completed = sum(f.outcome == Outcome.COMPLETED for f in flights)
    low, high = wilson(completed, len(flights))
    errors = [math.inf if f.second_m_s is None else abs(f.second_m_s[0] - planned[0]) for f in flights]
    misses = sorted(math.inf if f.miss_m is None else f.miss_m for f in flights)
    captures = [f.capture_s for f in flights if f.capture_s is not None]
    broken = Counter(f.rule for f in flights if f.outcome != Outcome.COMPLETED)
    return [
        name,
        f"{completed} of {len(flights)} ({100 * low:.0f} to {100 * high:.0f} %)",
        str(sum(bool(f.problems) for f in flights)),
        f"{np.median(errors):.3f}, {np.quantile(errors, 0.95, method='lower'):.3f}",
        f"{100 * np.mean([e <= 0.1 for e in errors]):.0f} %",
        f"{np.median(misses):.3f}, {np.quantile(misses, 0.95, method='lower'):.3f}",
        f"{np.median(captures):.1f}" if captures else "-",
        ", ".join(f"`{rule}` {count}" for rule, count in broken.most_common()) or "-",
    ]


HEADS = (
    "after an impact", "completed (95 %)", "uncontrolled", "second impact off by, m/s (median, 95th)",
    "within 0.1", "goal missed by, m (median, 95th)", "held after, s", "broken off by",
)  # fmt: skip


def main() -> int:
    """Fly what the command line asks for; print the table and write build/replanning.md."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=HELD_SEED)
    parser.add_argument("--vary", nargs="*", default=["contact=0.3"])
    parser.add_argument("--ways", nargs="*", default=list(WAYS))
    parser.add_argument("--body", default="guards")
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--mission", default=str(ROOT / "missions" / "paper_dual_collision.yaml"))
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    settings = [f"simulation.contact.body={options.body}", *options.set]
    mission = load_mission(options.mission, settings=settings)
    hit = predict_mission(mission).hits[mission.collisions[-1].index]
    planned = (hit.normal_m_s, hit.tangential_m_s)
    rows: list[list[str]] = []
    console = Console(stderr=True)
    seeds = range(options.seed, options.seed + options.runs)
    for way in options.ways:
        count = len(seeds)
        arguments = (
            [way] * count,
            seeds,
            [options.vary] * count,
            [settings] * count,
            [options.mission] * count,
        )
        with ProcessPoolExecutor(options.workers) as pool:
            flights = list(track(pool.map(fly, *arguments), way, total=count, console=console))
        rows.append(summary(WAYS[way], flights, planned))
        print(*rows[-1], sep=" | ", flush=True)
        reasons = Counter(reason for f in flights for reason in f.taken)
        print("plans:", dict(reasons), flush=True)
    path = ROOT / "build" / "replanning.md"
    path.parent.mkdir(exist_ok=True)
    path.write_text(markdown(HEADS, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
