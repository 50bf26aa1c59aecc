"""Hits of a body: the shipped missions against walls that stand obliquely, over what the body may be like.

    python -m tools.campaigns.body                 # everything, build/body.md
    python -m tools.campaigns.body vary            # only this part
    python -m tools.campaigns.body yaw --runs 5 --case default --mission dual_collision --fresh

Fast world, guards. What the paper does not tell of the body are the ranges of `RANGES`; a `Case` is a point
in them. `yaw` flies both missions over seeds with every wall turned by the same angle; `vary` draws
everything (`--vary all`). A flight is kept under build/body/ as soon as it has landed: an interrupted
campaign goes on where it was; `--fresh` forgets what was flown (after a change of the software).

No decision of the software may be tuned on the seeds from `FIRST_SEED` on.
"""

from __future__ import annotations

import argparse
import itertools
import math
import statistics
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import msgspec

from dart_flight.base.geometry import norm, tilt_of
from dart_flight.base.records import (
    ActuatorSample,
    ImuSample,
    Outcome,
    Override,
    Record,
    TruthContact,
    TruthSample,
    World,
)
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import LockDriver, load_vehicle
from dart_flight.lab.statistics import wilson
from dart_flight.recording.verdict import VerdictBuilder
from dart_flight.run.fast import FastFlight
from dart_flight.sim.draws import DrawnWorld, draw_world, parse_vary, with_walls
from tools.campaigns.faults import Watch, judge, run_out
from tools.campaigns.kept import fly_missing
from tools.campaigns.results import ROOT, markdown

KEPT = ROOT / "build" / "body"
MISSIONS = ("paper_single_wall", "paper_dual_collision")
PARTS = ("yaw", "vary")
FIRST_SEED = 7001
YAWS_DEG = (0.0, 5.0, -5.0, 10.0, -10.0)
_AFTER_US = 600_000  # what a hit does to tilt and rate shows within this time
_MOTOR_AT_LIMIT = 0.995  # of full command; or as little above none


class Case(msgspec.Struct, frozen=True):
    """What the paper does not tell of the body: one point in the ranges.

    Attributes:
        name: for tables.
        friction_lever_share, vertical_lever_m, guard_height_m, guard_along_m: as in `simulation.contact`.
        inertia: factor of the configured one.
    """

    name: str
    friction_lever_share: float
    vertical_lever_m: float
    guard_height_m: float
    guard_along_m: float
    inertia: float

    def settings(self) -> tuple[str, ...]:
        """As `--set` takes them."""
        moments = load_vehicle(ROOT / "configs" / "dart.yaml").airframe.inertia_kg_m2
        contact = [
            f"simulation.contact.{key}={getattr(self, key):g}"
            for key in ("friction_lever_share", "vertical_lever_m", "guard_height_m", "guard_along_m")
        ]
        inertia = ", ".join(f"{self.inertia * moment:g}" for moment in moments)
        return ("simulation.contact.body=guards", *contact, f"airframe.inertia_kg_m2=[{inertia}]")


# Plausible ranges, with their sources in configs/dart.yaml; not to be turned down once recovery is worked on.
RANGES: dict[str, tuple[float, float]] = {
    "friction_lever_share": (0.0, 1.0),
    "vertical_lever_m": (0.0, 0.04),
    "guard_height_m": (-0.03, 0.03),
    "guard_along_m": (0.10, 0.16),
    "inertia": (0.7, 1.4),
}


def default_case() -> Case:
    """The configured body."""
    body = load_vehicle(ROOT / "configs" / "dart.yaml").simulation.contact
    return Case(
        "default",
        body.friction_lever_share,
        body.vertical_lever_m,
        body.guard_height_m,
        body.guard_along_m,
        1.0,
    )


MIDDLE = Case("mid-range", *((low + high) / 2.0 for low, high in RANGES.values()))
WORST = Case("worst corner", 1.0, 0.0, -0.03, 0.10, 0.7)  # of all corners, docs/results/body.md


class Job(msgspec.Struct, frozen=True):
    """One flight.

    Attributes:
        mission: name of a shipped one.
        seed: of sensors, scatter and draws.
        case: the body.
        yaw_deg: every wall turned by so much, counter-clockwise seen from above.
        vary: as `--vary` takes it.
    """

    mission: str
    seed: int
    case: Case
    yaw_deg: float = 0.0
    vary: tuple[str, ...] = ()


class HitFigures(msgspec.Struct):
    """One true contact and what the vehicle did in the 0.6 s from its beginning on, or until the next."""

    wall: str
    mode: str
    normal_m_s: float
    tangential_m_s: float
    peak_n: float
    torque_nm: float
    incidence_deg: float
    rate_out_deg_s: float
    tilt_deg: float = 0.0
    rate_deg_s: float = 0.0
    saturated_s: float = 0.0


class Flown(msgspec.Struct):
    """One flight in a few figures.

    Attributes:
        job: what was flown.
        outcome: of the verdict.
        rule: what broke it off; empty where it completed.
        problems: why it counts as uncontrolled (`tools.campaigns.faults`); empty where it does not.
        tilt_deg: largest of the flight.
        miss_m: of the goal.
        hits: true contacts in order.
        drawn: by `vary`.
    """

    job: Job
    outcome: str
    rule: str
    problems: list[str]
    tilt_deg: float
    miss_m: float | None
    hits: list[HitFigures]
    drawn: dict[str, float | str]

    @property
    def kind(self) -> str:
        """completed, broken off or uncontrolled."""
        if self.problems:
            return "uncontrolled"
        return "completed" if self.outcome == Outcome.COMPLETED else "broken off"

    def second(self) -> HitFigures | None:
        """The first contact with the second collision's wall."""
        walls = list(dict.fromkeys(hit.wall for hit in self.hits))
        return next((hit for hit in self.hits if len(walls) > 1 and hit.wall == walls[1]), None)


class _HitWatch:
    """Collects what follows every true contact."""

    def __init__(self) -> None:
        self.contacts: list[TruthContact] = []
        self._tilts: list[tuple[int, float]] = []
        self._rates: list[tuple[int, float]] = []
        self._motors: list[tuple[int, bool]] = []

    def take(self, record: Record) -> None:
        if isinstance(record, TruthContact):
            self.contacts.append(record)
        elif isinstance(record, TruthSample):
            self._tilts.append((record.t_us, tilt_of(record.q_frd_to_ned)))
        elif isinstance(record, ImuSample):
            self._rates.append((record.t_us, norm(record.rate_frd)))
        elif isinstance(record, ActuatorSample):
            at_limit = any(u > _MOTOR_AT_LIMIT or u < 1.0 - _MOTOR_AT_LIMIT for u in record.motors)
            self._motors.append((record.t_us, at_limit))

    def figures(self) -> list[HitFigures]:
        begins = [c.t_us for c in self.contacts] + [sys.maxsize]
        found = []
        for contact, following in zip(self.contacts, begins[1:], strict=True):
            begin, end = contact.t_us, min(following, contact.t_us + _AFTER_US)
            mine = [
                [value for t, value in series if begin <= t < end]
                for series in (self._tilts, self._rates, self._motors)
            ]
            found.append(
                HitFigures(
                    wall=contact.wall,
                    mode=contact.mode.value,
                    normal_m_s=contact.normal_in_m_s,
                    tangential_m_s=contact.tangential_in_m_s,
                    peak_n=contact.peak_normal_force_n,
                    torque_nm=contact.peak_torque_nm,
                    incidence_deg=math.degrees(contact.incidence_rad),
                    rate_out_deg_s=math.degrees(norm(contact.rate_out_frd)),
                    tilt_deg=math.degrees(max(mine[0], default=0.0)),
                    rate_deg_s=math.degrees(max(mine[1], default=0.0)),
                    saturated_s=sum(mine[2]) * 0.008,  # motor outputs come at 125 Hz
                )
            )
        return found


def place_walls(
    world: DrawnWorld, away_m: Mapping[str, float], angles_deg: Mapping[str, float]
) -> DrawnWorld:
    """The world with walls moved out and turned by so much, by name (`Wall.moved`, `Wall.turned`)."""
    walls = {
        w.name: w.moved(away_m.get(w.name, 0.0)).turned(math.radians(angles_deg.get(w.name, 0.0)))
        for w in world.mission.walls
    }
    return with_walls(world, walls)


def fly(job: Job) -> Flown:
    """One flight, on to the ground."""
    path = ROOT / "missions" / f"{job.mission}.yaml"
    mission = load_mission(path, settings=job.case.settings())
    if job.vary:
        spreads = parse_vary(job.vary, mission.vehicle)
        world = draw_world(mission, job.seed, spreads)
    else:
        world = DrawnWorld(mission, None, {})
    world = place_walls(world, {}, {wall.name: job.yaw_deg for wall in mission.walls})
    watch, hits, builder = Watch(mission), _HitWatch(), VerdictBuilder(mission)

    def observe(record: Record, number: int) -> None:
        for one in (builder, watch, hits):
            one.take(record)

    flight = FastFlight(
        mission, job.seed, LockDriver.MOCK, faults=world.lock_faults, observe=observe, world=world
    )
    problems = []
    try:
        flight.run()
        run_out(flight)
    except Exception as error:
        problems.append(f"exception {type(error).__name__}: {error}")
    verdict = builder.build(World.FAST, job.seed)
    # A flight may be broken off more than once on its way down: the first reason is the cause.
    acted = [event.rule for event in verdict.guard if event.action is not Override.NONE]
    rule = acted[0] if acted and verdict.outcome != Outcome.COMPLETED else ""
    problems += judge(flight, watch, None, verdict.outcome, rule)
    return Flown(
        job=job,
        outcome=verdict.outcome.value,
        rule=rule,
        problems=problems,
        tilt_deg=math.degrees(watch.truth.tilt_rad),
        miss_m=verdict.goal_miss_m,
        hits=hits.figures(),
        drawn=world.drawn,
    )


def fly_all(part: str, jobs: Sequence[Job], processes: int, fresh: bool = False) -> list[Flown]:
    """Fly what build/body/ does not have yet; results in the order of the jobs."""
    return fly_missing(KEPT / f"{part}.jsonl", jobs, fly, tuple[Job, Flown], processes, fresh)


# --- what is flown -----------------------------------------------------------------------------------------


def yaw_jobs(case: Case, missions: Iterable[str], runs: int) -> list[Job]:
    """Both missions, every yaw, over seeds; all yaws of a seed before the next seed."""
    seeds = range(FIRST_SEED, FIRST_SEED + runs)
    return [
        Job(mission, seed, case, yaw) for seed, mission, yaw in itertools.product(seeds, missions, YAWS_DEG)
    ]


def vary_jobs(runs: int) -> list[Job]:
    """Dual flights with everything drawn."""
    return [
        Job("paper_dual_collision", seed, default_case(), vary=("all",))
        for seed in range(FIRST_SEED, FIRST_SEED + runs)
    ]


# --- what came of it ---------------------------------------------------------------------------------------


def _counts(flights: Sequence[Flown]) -> str:
    """Ends other than completion, most frequent first."""
    ends = Counter(f.rule or "-" if f.kind != "uncontrolled" else "uncontrolled" for f in flights)
    del ends[""], ends["-"]
    return ", ".join(f"{name} {count}" for name, count in ends.most_common()) or "-"


def _middle_and_worst(values: Iterable[float], digits: int = 0) -> str:
    known = list(values)
    if not known:
        return "-"
    worst = max(known, key=abs)
    return f"{statistics.median(known):.{digits}f}, {worst:.{digits}f}"


def yaw_table(flights: Sequence[Flown]) -> str:
    """Markdown: a row a case, mission and yaw; figures are median, worst."""
    heads = (
        "body", "mission", "wall yaw", "completed", "broken off", "uncontrolled", "tilt after first hit, deg",
        "rate after it, deg/s", "motors at a limit, ms", "second hit, m/s", "its force, N",
        "tilt after it, deg",
    )  # fmt: skip
    rows = []
    groups: dict[tuple[str, str, float], list[Flown]] = {}
    for f in flights:
        groups.setdefault((f.job.case.name, f.job.mission, f.job.yaw_deg), []).append(f)
    for (case, mission, yaw), mine in groups.items():
        first = [f.hits[0] for f in mine if f.hits]
        second = [hit for f in mine if (hit := f.second()) is not None]
        lost = sum(f.kind == "uncontrolled" for f in mine)
        cells = [
            case,
            mission,
            f"{yaw:+.0f}" if yaw else "0",
            f"{sum(f.kind == 'completed' for f in mine)} of {len(mine)}",
            _counts([f for f in mine if f.kind == "broken off"]),
            str(lost),
            _middle_and_worst(h.tilt_deg for h in first),
            _middle_and_worst(h.rate_deg_s for h in first),
            _middle_and_worst(1e3 * h.saturated_s for h in first),
            _middle_and_worst((h.normal_m_s for h in second), 2),
            _middle_and_worst(h.peak_n for h in second),
            _middle_and_worst(h.tilt_deg for h in second),
        ]
        rows.append(cells)
    return markdown(heads, rows)


def vary_table(flights: Sequence[Flown]) -> str:
    """Markdown: success rate with its interval, every break-off by its cause, and what was drawn there."""
    done = sum(f.kind == "completed" for f in flights)
    low, high = wilson(done, len(flights))
    lost = [f for f in flights if f.kind == "uncontrolled"]
    lines = [
        f"{done} of {len(flights)} completed: {100 * done / len(flights):.1f} % "
        f"(95 % interval {100 * low:.1f} to {100 * high:.1f} %), {len(lost)} uncontrolled.",
        "",
        "| broken off by | flights | seeds |",
        "|---|---|---|",
    ]
    causes: dict[str, list[int]] = {}
    for f in flights:
        if f.kind == "broken off":
            causes.setdefault(f.rule, []).append(f.job.seed)
    for rule, seeds in sorted(causes.items(), key=lambda cause: -len(cause[1])):
        shown = ", ".join(map(str, seeds[:12])) + (", ..." if len(seeds) > 12 else "")
        lines.append(f"| `{rule}` | {len(seeds)} | {shown} |")
    lines += ["", *(f"- uncontrolled, seed {f.job.seed}: {'; '.join(f.problems)}" for f in lost)]
    first = [f.hits[0] for f in flights if f.hits]
    second = [hit for f in flights if (hit := f.second()) is not None]
    for said, hits in (("First hit", first), ("Second hit", second)):
        lines.append(
            f"{said} (median, worst of {len(hits)}): "
            f"{_middle_and_worst((h.normal_m_s for h in hits), 2)} m/s, "
            f"{_middle_and_worst(h.peak_n for h in hits)} N, tilt after it "
            f"{_middle_and_worst(h.tilt_deg for h in hits)} degrees, rate "
            f"{_middle_and_worst(h.rate_deg_s for h in hits)} deg/s."
        )
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly what is asked for; 1 where a flight was uncontrolled."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("part", nargs="*", help=f"of {', '.join(PARTS)}; all by default")
    parser.add_argument(
        "--runs", type=int, help="seeds of yaw (20, 5 off the default body) and flights of vary (200)"
    )
    parser.add_argument("--case", action="append", choices=("default", "mid-range", "worst corner"))
    parser.add_argument("--mission", action="append", choices=MISSIONS)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--fresh", action="store_true", help="forget what was flown")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "body.md")
    options = parser.parse_args(arguments)
    unknown = [part for part in options.part if part not in PARTS]
    if unknown:
        parser.error(f"unknown part {unknown[0]}, known: {', '.join(PARTS)}")
    cases = [c for c in (default_case(), MIDDLE, WORST) if c.name in (options.case or [c.name])]
    said, lost = [], 0
    for part in options.part or PARTS:
        if part == "yaw":
            jobs = [
                job
                for case in cases
                for job in yaw_jobs(
                    case, options.mission or MISSIONS, options.runs or (20 if case.name == "default" else 5)
                )
            ]
        else:
            jobs = vary_jobs(options.runs or 200)
        flights = fly_all(part, list(dict.fromkeys(jobs)), options.processes, options.fresh)
        lost += sum(f.kind == "uncontrolled" for f in flights)
        table = yaw_table if part == "yaw" else vary_table
        said.append(f"## {part}\n\n{table(flights)}")
        sys.stdout.write(said[-1] + "\n")
        sys.stdout.flush()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text("\n".join(said), encoding="utf-8")
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
