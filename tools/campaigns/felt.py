"""Mode and coefficients after a contact, against the world that was drawn (docs/results/felt.md).

    python -m tools.campaigns.felt                        # every set, point and guards, build/felt.md
    python -m tools.campaigns.felt wood headon --runs 1000 --body guards --processes 2
    python -m tools.campaigns.felt wood --first-seed 1    # the seeds that the software was tuned on
    python -m tools.campaigns.felt --theory               # what a perfect judge could tell head-on

Flies the single wall in the fast world up to what was felt of it. Approach velocity, mode and whether the
lock tells the truth are drawn anew for every seed; so are the wall's coefficients (30 %) and each hit's
(5 %). A flight is kept under build/felt/ as soon as it is over: an interrupted campaign goes on where it was;
`--fresh` forgets what was flown (after a change of the software).

No decision of the software may be tuned on the seeds from `FIRST_SEED` on.
"""

from __future__ import annotations

import argparse
import itertools
import math
import random
import statistics
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from dart_flight.base.records import Mode, Phase, PhaseChange, Record, TruthContact, WallEstimate, World
from dart_flight.config.file_kinds import FileKind, load_document
from dart_flight.config.mission import Mission, parse_mission
from dart_flight.config.vehicle import BodyModel, Coefficients, LockDriver, load_vehicle
from dart_flight.contact.contact_map import collide
from dart_flight.contact.law import Onset
from dart_flight.core.mission.approach import NoApproachError
from dart_flight.lab.statistics import wilson
from dart_flight.lock.drivers.mock import MockFaults
from dart_flight.lock.servo import ServoFaults
from dart_flight.recording.flown_impact import CollisionVerdict
from dart_flight.recording.verdict import VerdictBuilder
from dart_flight.run.fast import FastFlight
from dart_flight.sim.draws import draw_world
from tools.campaigns.kept import fly_missing
from tools.campaigns.results import ROOT, markdown

KEPT, PAGE = ROOT / "build" / "felt", ROOT / "build" / "felt.md"
FIRST_SEED = 9001
_LONGEST_S = 40.0
_NORMAL_M_S = (0.5, 1.2)
_LIE_SHARE = 0.5
_STUCK = MockFaults(servo=ServoFaults(stuck=True))
_CONTACT = {"contact": 0.3, "contact_scatter": 0.05}
_SURE = 1.959964
_DEADLINE_MS = 60.0


class Set(NamedTuple):
    """What the flights of a set have in common.

    Attributes:
        material: of the wall.
        tangential_m_s: smallest and largest speed along the wall, either way.
        spreads: what is drawn beside mode and approach (`sim.draws`).
        half_engaged: the rods of a lock that says rigid are half-way.
        settings: of the simulated vehicle alone, as `--set` takes them.
    """

    material: str
    tangential_m_s: tuple[float, float]
    spreads: dict[str, float]
    half_engaged: bool = False
    settings: tuple[str, ...] = ()


_OTHER_ARMS = tuple(
    f"simulation.arm_vibration.{key}"
    for key in ("frequency_hz=23", "damping_ratio=0.2", "mass_fraction=0.12")
)
_OTHERS = {"wall_yaw_deg": 4.0, "wall_offset_m": 0.03, "mass": 0.03, "wind_m_s": 0.5, "battery": 0.05}
SETS = {
    "wood": Set("wood", (0.2, 0.6), _CONTACT),
    "sliding": Set("acrylic", (0.2, 0.6), _CONTACT),
    "headon": Set("acrylic", (0.0, 0.0), _CONTACT),
    "wood-all": Set("wood", (0.2, 0.6), _CONTACT | _OTHERS),
    "sliding-all": Set("acrylic", (0.2, 0.6), _CONTACT | _OTHERS),
    "wood-shaken": Set("wood", (0.2, 0.6), _CONTACT | _OTHERS | {"imu": 0.02}),
    "headon-arms": Set("acrylic", (0.0, 0.0), _CONTACT, settings=_OTHER_ARMS),
    "half": Set("acrylic", (0.2, 0.6), _CONTACT, half_engaged=True),
}


class Job(msgspec.Struct, frozen=True):
    """One flight: name of its set, what touches the wall, seed."""

    kind: str
    body: BodyModel
    seed: int


class Flown(msgspec.Struct):
    """One contact: what was drawn, what was felt.

    Attributes:
        job: what was flown.
        failed: why there was no contact to judge; empty where there was.
        true_mode: of the arms at the contact.
        felt: as logged.
        after_ms: from the true end of the contact to the moment at which it was known.
        wall: the drawn wall's coefficients in the true mode.
        by_time: mode whose contact with this material lasts nearest to what was measured.
        plane_offset_m: of the drawn wall where it was met.
        incidence_rad: true.
        normal_m_s, tangential_m_s: true, before the contact.
    """

    job: Job
    failed: str = ""
    true_mode: Mode | None = None
    felt: WallEstimate | None = None
    after_ms: float = 0.0
    wall: Coefficients | None = None
    by_time: Mode | None = None
    plane_offset_m: float = 0.0
    incidence_rad: float = 0.0
    normal_m_s: float = 0.0
    tangential_m_s: float = 0.0


class Plan(NamedTuple):
    """The mission of a flight, and whether the lock does what it says."""

    mission: Mission
    lies: bool


def plan_of(job: Job) -> Plan:
    """The single wall, with approach, mode and lie drawn by the seed."""
    chosen, rng = SETS[job.kind], random.Random(f"{job.kind} {job.seed}")
    normal = -rng.uniform(*_NORMAL_M_S)
    tangential = rng.choice((-1.0, 1.0)) * rng.uniform(*chosen.tangential_m_s)
    mode = Mode.RIGID if chosen.half_engaged else rng.choice(list(Mode))
    lies = not chosen.half_engaged and rng.random() < _LIE_SHARE
    document = load_document(ROOT / "missions" / "paper_single_wall.yaml", FileKind.MISSION)
    tree = document.tree
    tree["start"]["position_m"] = [0.0, 0.5]
    tree["bounds_m"]["y"] = [-3.5, 4.5]
    tree["walls"]["acrylic"] |= {"material": chosen.material, "length_m": 6.0}
    approach = {"normal_m_s": normal, "tangential_m_s": tangential}
    tree["collisions"][0] |= {"mode": mode.value, "approach": approach}
    tree["limits"] = {"speed_m_s": 4.0, "peak_force_n": 300.0}
    settings = [f"simulation.contact.body={job.body.value}", *chosen.settings]
    if chosen.half_engaged:
        settings.append("simulation.contact.half_engaged=true")
    return Plan(parse_mission(document, None, settings), lies)


def fly(job: Job) -> Flown:
    """One flight, up to what was felt."""
    plan = plan_of(job)
    world = draw_world(plan.mission, job.seed, SETS[job.kind].spreads)
    builder = VerdictBuilder(plan.mission)
    felt: list[tuple[int, WallEstimate]] = []
    contacts: list[TruthContact] = []
    commanded = plan.mission.collisions[0].mode
    sticks_rigid = plan.lies and commanded is Mode.FLEXIBLE

    def observe(record: Record, number: int) -> None:
        builder.take(record)
        if isinstance(record, WallEstimate):
            felt.append((flight.autopilot.time_us, record))
        elif isinstance(record, TruthContact):
            contacts.append(record)
        elif isinstance(record, PhaseChange) and record.after is Phase.PREPARE and sticks_rigid:
            # The rods are in: from now on they stay there, whatever the servo is told.
            assert flight.mock is not None
            flight.mock.inject(_STUCK)

    faults = _STUCK if plan.lies and commanded is Mode.RIGID else None
    try:
        flight = FastFlight(
            plan.mission, job.seed, LockDriver.MOCK, faults=faults, observe=observe, world=world
        )
    except NoApproachError as error:
        return Flown(job, str(error))
    while flight.core.end is None and flight.autopilot.now_s < _LONGEST_S and not (felt and contacts):
        flight.tick()
    if not felt or not contacts:
        return Flown(job, str(flight.core.end or "nothing was felt"))
    (known_us, told), contact = felt[0], contacts[0]
    true, believed = world.mission.walls[0], plan.mission.walls[0]
    x, y, _ = contact.position_mission
    away = true.signed_distance((x, y))
    met = (x - away * true.normal[0], y - away * true.normal[1])
    verdict = builder.build(World.FAST, job.seed).collisions
    return Flown(
        job=job,
        true_mode=contact.mode,
        felt=told,
        after_ms=(known_us - contact.end_us) * 1e-3,
        wall=world.mission.vehicle.materials[true.material].of(contact.mode),
        by_time=_mode_by_time(believed.material, plan.mission, verdict),
        plane_offset_m=believed.signed_distance(met),
        incidence_rad=contact.incidence_rad,
        normal_m_s=contact.normal_in_m_s,
        tangential_m_s=contact.tangential_in_m_s,
    )


def _mode_by_time(material: str, mission: Mission, hits: Sequence[CollisionVerdict]) -> Mode | None:
    if not hits or hits[0].contact_time_ms is None:
        return None
    vehicle, measured_s = mission.vehicle, max(hits[0].contact_time_ms, 1.0) * 1e-3

    def unlikeness(mode: Mode) -> float:
        c = vehicle.materials[material].of(mode)
        hit = collide(c, vehicle.airframe.mass_kg, -1.0, 0.0, Onset(vehicle.onset))
        return abs(math.log(measured_s / hit.contact_time_s))

    return min(Mode, key=unlikeness)


def fly_all(name: str, jobs: Sequence[Job], processes: int, fresh: bool = False) -> list[Flown]:
    """Fly what build/felt/ does not have yet; results in the order of the jobs."""
    return fly_missing(KEPT / f"{name}.jsonl", jobs, fly, tuple[Job, Flown], processes, fresh)


# --- what came of it -------------------------------------------------------------------------------------


class Judged(NamedTuple):
    """A flight that was felt, with nothing missing."""

    job: Job
    true_mode: Mode
    felt: WallEstimate
    wall: Coefficients
    flown: Flown


def judged_of(flights: Iterable[Flown]) -> list[Judged]:
    """Those with a contact."""
    return [
        Judged(f.job, f.true_mode, f.felt, f.wall, f)
        for f in flights
        if f.true_mode is not None and f.felt is not None and f.wall is not None
    ]


def is_wrong(j: Judged) -> bool:
    """Whether the other mode was felt."""
    return j.felt.mode_felt not in (None, j.true_mode)


def told_mode(felt: WallEstimate) -> Mode | None:
    """The mode that the coefficients are of."""
    return felt.mode_felt or felt.mode_reported


_COEFFICIENTS: dict[
    str, tuple[Callable[[WallEstimate], tuple[float, float]], Callable[[Coefficients], float]]
] = {
    "k": (lambda w: (w.k_n_per_m, w.k_sd), lambda c: c.k),
    "f": (lambda w: (w.f_ns_per_m, w.f_sd), lambda c: c.f),
    "mu": (lambda w: (w.mu_s_per_m, w.mu_sd), lambda c: c.mu),
}


def covered(j: Judged, name: str) -> bool:
    """Whether the wall's coefficient lies in the 95 % interval."""
    (mean, sd), true = _COEFFICIENTS[name][0](j.felt), _COEFFICIENTS[name][1](j.wall)
    return abs(true / mean - 1.0) <= _SURE * sd


def _rate(count: int, of: int) -> str:
    if not of:
        return "-"
    low, high = wilson(count, of)
    return f"{count} ({100 * low:.1f} to {100 * high:.1f} %)"


def mode_table(groups: dict[str, list[Judged]]) -> str:
    """Markdown: a row a group: wrong, undecided, moment at which it was known."""
    heads = (
        "set", "body", "contacts", "wrong (95 % interval)", "undecided (95 % interval)",
        "known after the contact's end, median, latest", "within 60 ms", "wrong by its duration",
    )  # fmt: skip
    rows = []
    for name, mine in groups.items():
        late = [j.flown.after_ms for j in mine]
        kind, body = name.rsplit(" ", 1)
        cells = [
            kind,
            body,
            str(len(mine)),
            _rate(sum(map(is_wrong, mine)), len(mine)),
            _rate(sum(j.felt.mode_felt is None for j in mine), len(mine)),
            f"{statistics.median(late):.0f}, {max(late):.0f} ms",
            f"{sum(ms <= _DEADLINE_MS for ms in late)} of {len(mine)}",
            _rate(sum(j.flown.by_time is not j.true_mode for j in mine), len(mine)),
        ]
        rows.append(cells)
    return markdown(heads, rows)


def coefficient_table(groups: dict[str, list[Judged]], prior_sd: float) -> str:
    """Markdown: coverage of the 95 % intervals, posterior over prior deviation; the true mode told only."""
    heads = ["set", "body", "contacts"]
    heads += [f"{name} {what}" for name in _COEFFICIENTS for what in ("covered", "posterior over prior")]
    heads.append("plane, mm, mean and deviation of the error")
    rows = []
    for name, mine in groups.items():
        right = [j for j in mine if told_mode(j.felt) is j.true_mode]
        if not right:
            continue
        kind, body = name.rsplit(" ", 1)
        cells = [kind, body, str(len(right))]
        for symbol, (read, _) in _COEFFICIENTS.items():
            cells.append(f"{100 * sum(covered(j, symbol) for j in right) / len(right):.0f} %")
            cells.append(f"{statistics.median(read(j.felt)[1] for j in right) / prior_sd:.2f}")
        off = [1e3 * (j.felt.plane_offset_m - j.flown.plane_offset_m) for j in right]
        cells.append(f"{statistics.fmean(off):+.1f}, {statistics.pstdev(off):.1f}")
        rows.append(cells)
    return markdown(heads, rows)


def wrong_list(groups: dict[str, list[Judged]]) -> str:
    """Every contact that was felt wrong."""
    lines = []
    for j in itertools.chain.from_iterable(groups.values()):
        if is_wrong(j):
            f = j.flown
            lines.append(
                f"- {j.job.kind}, {j.job.body.value}, seed {j.job.seed}: {j.true_mode.value} at "
                f"{f.normal_m_s:.2f}, {f.tangential_m_s:.2f} m/s, incidence "
                f"{math.degrees(f.incidence_rad):.1f} degrees, odds {j.felt.log_odds:.1f}, "
                f"k {j.wall.k:.0f}, f {j.wall.f:.1f}, mu {j.wall.mu:.2f}"
            )
    return "\n".join(lines) or "None was felt wrong."


def theory(material: str = "acrylic", draws: int = 1_000_000) -> str:
    """Markdown: the best that can be told head-on, where friction says nothing.

    A judge that knows the spreads of the drawn coefficients and reads k to 1 %, f to 1.5 N s/m and, where it
    looks at it, nu to 1 N decides by the ratio of the likelihoods.
    """
    vehicle = load_vehicle(ROOT / "configs" / "dart.yaml")
    table, rng = vehicle.materials[material], np.random.default_rng(1)
    spread = math.hypot(_CONTACT["contact"], _CONTACT["contact_scatter"])
    rigid = rng.random(draws) < 0.5
    odds = np.zeros(draws)
    rows = []
    readings = (("k", "k", 0.01, 0.0), ("k, f", "f", 0.0, 1.5), ("k, f, nu", "nu", 0.0, 1.0))
    for said, name, share, error in readings:
        means = {mode: float(getattr(table.of(mode), name)) for mode in Mode}
        drawn = np.where(rigid, means[Mode.RIGID], means[Mode.FLEXIBLE])
        drawn = drawn * np.maximum(0.1, 1.0 + _CONTACT["contact"] * rng.standard_normal(draws))
        drawn = drawn * (1.0 + _CONTACT["contact_scatter"] * rng.standard_normal(draws))
        width = np.hypot(error, share * drawn)
        read = drawn + width * rng.standard_normal(draws)
        for mode, sign in ((Mode.RIGID, 1.0), (Mode.FLEXIBLE, -1.0)):
            sd = np.hypot(spread * means[mode], width)
            odds -= sign * (0.5 * ((read - means[mode]) / sd) ** 2 + np.log(sd))
        for level in (100.0, 200.0, 1000.0):
            decided = np.abs(odds) >= math.log(level)
            wrong = float(np.mean(decided & ((odds > 0.0) != rigid)))
            rows.append((said, f"{level:.0f}", f"{100 * wrong:.2f} %", f"{100 * np.mean(~decided):.0f} %"))
    return markdown(("read", "sure from odds of", "wrong", "undecided"), rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly what is asked for and write the tables; 1 where a flight had no contact."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kind", nargs="*", help=f"of {', '.join(SETS)}; all by default")
    parser.add_argument("--runs", type=int, default=1000, help="flights of each kind and body")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--body", action="append", type=BodyModel, choices=list(BodyModel))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--fresh", action="store_true", help="forget what was flown")
    parser.add_argument("--theory", action="store_true", help="only what a perfect judge could tell")
    parser.add_argument("--out", type=Path, default=PAGE)
    options = parser.parse_args(arguments)
    if options.theory:
        print(theory())
        return 0
    unknown = [kind for kind in options.kind if kind not in SETS]
    if unknown:
        parser.error(f"unknown kind {unknown[0]}, known: {', '.join(SETS)}")
    groups: dict[str, list[Judged]] = {}
    failed: list[Flown] = []
    prior_sd = 0.3
    for kind, body in itertools.product(options.kind or SETS, options.body or list(BodyModel)):
        seeds = range(options.first_seed, options.first_seed + options.runs)
        jobs = [Job(kind, body, seed) for seed in seeds]
        prior_sd = plan_of(jobs[0]).mission.vehicle.estimation.walls.spread
        flights = fly_all(f"{kind}-{body.value}", jobs, options.processes, options.fresh)
        failed += [f for f in flights if f.failed]
        groups[f"{kind} {body.value}"] = judged_of(flights)
    groups = {name: mine for name, mine in groups.items() if mine}
    said = "\n".join(
        [
            mode_table(groups),
            coefficient_table(groups, prior_sd),
            wrong_list(groups),
            *(f"- no contact: {f.job.kind} {f.job.body.value} {f.job.seed}: {f.failed}" for f in failed),
        ]
    )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(said + "\n", encoding="utf-8")
    print(said)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
