"""Flights with a real PX4: acceptance, three worlds, versions, body.

Acceptance flies ten seeds; the versions are both missions on every version of PX4 at hand; body is what the
guards do in a hit, with walls as planned and turned; ways are the missions that use collisions, flown with
them and without.

    DART_PX4_DIR=... python -m tools.campaigns.px4 [--part NAME] [--speed X] [--report DIR]
    python -m tools.campaigns.px4 --part versions --px4 NAME=DIR [--px4 NAME=DIR ...]
    python -m tools.campaigns.px4 --part body --px4 NAME=DIR [--px4 NAME=DIR ...]
    python -m tools.campaigns.px4 --part ways --px4 NAME=DIR [--px4 NAME=DIR ...]

Every flight's figures go to `px4_flights.jsonl` in the report folder as they come; a part that is flown again
replaces its lines. The tables (`px4.md`) are written from that file alone, so parts can be flown one
by one. docs/results/px4.md is such a report; docs/px4.md explains it. The tables of versions, of the body
with guards and of both ways go into docs/results/px4_versions.md; a version that is flown again replaces its
lines there, others stay.
"""

from __future__ import annotations

import argparse
import itertools
import math
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import msgspec

from dart_flight.base.geometry import norm, tilt_of
from dart_flight.base.records import ImuSample, TruthSample
from dart_flight.config.document import InputError
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.vehicle import packaged
from dart_flight.recording.reader import read_log
from dart_flight.recording.verdict import Verdict
from dart_flight.run.embedded import fly_embedded
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import load_flyable
from dart_flight.run.px4_flight import fly_px4
from dart_flight.sim.px4.launch import find_install
from tools.campaigns.arrivals import COLLIDING, FREE, USING_COLLISIONS, arrival_of, both_ways
from tools.campaigns.results import RESULTS, markdown, measured_by

SEEDS = range(1, 11)
EMBEDDED_SEEDS = range(1, 4)  # real time: few
SPEED = 3.0  # times real time, what lockstep sustains with room to spare where nothing else runs
MISSIONS = {"single": "paper_single_wall.yaml", "dual": "paper_dual_collision.yaml"}
FLIGHTS, TABLES = "px4_flights.jsonl", "px4.md"
VERSIONS = "version "  # begins the names of the parts that compare versions; then NAME
VERSION_SEEDS = range(1, 3)
VERSION_FLIGHTS = (("dual", "mocap"), ("single", "mocap"), ("single", "rtk"))
BODY = "body "  # begins the names of the parts that fly the body with guards; then NAME
BODY_SEEDS = range(1, 6)
WALL_YAW_DEG = 5.0  # standard deviation
BODY_FLIGHTS = (("single", 0.0), ("dual", 0.0), ("single", WALL_YAW_DEG))  # mission, spread of the wall's yaw
WAYS = "ways "  # begins the names of the parts that fly with collisions and without; then NAME
WAYS_SEEDS = range(1, 4)
_AFTER_US = 600_000  # what a hit does to tilt and rate shows within this time
PAGE = RESULTS / "px4_versions.md"


class Hit(msgspec.Struct):
    """One collision of a flight: true and measured."""

    wall: str
    mode: str
    normal_m_s: float | None
    normal_true_m_s: float | None
    tangential_true_m_s: float | None
    force_n: float | None
    force_true_n: float | None
    detection_ms: float | None
    setpoint_ms: float | None
    incidence_deg: float | None = None  # true
    tilt_deg: float | None = None  # largest in the 0.6 s from it on, as is the rate
    rate_deg_s: float | None = None
    normal_planned_m_s: float | None = None


class Flight(msgspec.Struct):
    """One line of the results."""

    part: str
    world: str
    speed: float  # times real time
    sensor: str
    mission: str
    seed: int
    outcome: str
    reason: str | None
    failsafe: bool | None
    resets: int | None
    tilt_deg: float | None
    ekf_m: float | None
    miss_m: float | None
    final_m: float | None
    hits: list[Hit]
    guard: list[str]
    told: str | None = None  # PX4's version as it tells it
    drawn: dict[str, float | str] = {}
    way: str = ""  # colliding, free
    followed: bool | None = None
    places: str = ""  # passed, of how many
    planned_s: float | None = None
    there_s: float | None = None  # from the first trajectory on (`arrivals`)


def figures(part: str, sensor: str, mission: str, verdict: Verdict, pace: float = 1.0) -> Flight:
    """A verdict in one line."""
    hits = [
        Hit(
            c.wall,
            c.mode,
            c.measured.normal_m_s,
            c.truth.normal_m_s if c.truth else None,
            c.truth.tangential_m_s if c.truth else None,
            c.measured.peak_force_n,
            c.truth.peak_force_n if c.truth else None,
            c.detection_latency_ms,
            c.setpoint_latency_ms,
        )
        for c in verdict.collisions
    ]
    px4 = verdict.px4
    return Flight(
        part=part,
        world=verdict.world or "unknown",
        speed=pace,
        sensor=sensor,
        mission=mission,
        seed=verdict.seed or 0,
        outcome=verdict.outcome,
        reason=verdict.reason,
        failsafe=px4.failsafe if px4 else None,
        resets=px4.ekf_resets if px4 else None,
        tilt_deg=verdict.max_tilt_deg,
        ekf_m=verdict.ekf_error_m,
        miss_m=verdict.goal_miss_m,
        final_m=verdict.final_error_m,
        hits=hits,
        guard=[f"{g.rule}: {g.detail}" for g in verdict.guard],
        told=px4.version if px4 else None,
    )


# --- flying ------------------------------------------------------------------------------------------


def _accept(part: str, pace: float, mission: str, sensor: str) -> Iterator[Flight]:
    loaded = load_flyable(packaged("missions", MISSIONS[mission]))
    for seed in SEEDS:
        with tempfile.TemporaryDirectory() as folder:
            verdict = fly_px4(
                loaded, None, seed, Path(folder), position_from=PositionSource(sensor), speed=pace
            )
            yield figures(part, sensor, mission, verdict, pace)


def _other_world(part: str, _pace: float, world: str, mission: str) -> Iterator[Flight]:
    loaded = load_flyable(packaged("missions", MISSIONS[mission]))
    fly, seeds = (fly_fast, SEEDS) if world == "fast" else (fly_embedded, EMBEDDED_SEEDS)
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder:
            yield figures(part, "mocap", mission, fly(loaded, seed, Path(folder)))


def parts() -> dict[str, Callable[[str, float], Iterator[Flight]]]:
    """Name of every part -> what flies it, given the name and the pace in times real time."""
    table: dict[str, Callable[[str, float], Iterator[Flight]]] = {}
    for sensor in ("mocap", "rtk", "plain"):
        for mission in MISSIONS:
            table[f"{mission}-{sensor}"] = partial(_accept, mission=mission, sensor=sensor)
    for world in ("fast", "embedded"):
        for mission in MISSIONS:
            table[f"{world}-{mission}"] = partial(_other_world, world=world, mission=mission)
    return table


def fly_part(name: str, report_dir: Path, pace: float) -> None:
    """Fly one part; its lines replace what the results had of it."""
    _keep(name, parts()[name](name, pace), report_dir)


def fly_version(name: str, directory: str, report_dir: Path, pace: float) -> None:
    """Both missions on one version of PX4; its lines replace what the results had of it."""

    def flights(part: str) -> Iterator[Flight]:
        for mission, sensor in VERSION_FLIGHTS:
            loaded = load_flyable(packaged("missions", MISSIONS[mission]))
            for seed in VERSION_SEEDS:
                with tempfile.TemporaryDirectory() as folder:
                    source = PositionSource(sensor)
                    verdict = fly_px4(loaded, directory, seed, Path(folder), position_from=source, speed=pace)
                    yield figures(part, sensor, mission, verdict, pace)

    _keep(VERSIONS + name, flights(VERSIONS + name), report_dir)


def fly_body(name: str, directory: str, report_dir: Path, pace: float) -> None:
    """The body with guards on one version of PX4; its lines replace what the results had of it."""

    def flights(part: str) -> Iterator[Flight]:
        for mission, yaw_deg in BODY_FLIGHTS:
            loaded = load_flyable(packaged("missions", MISSIONS[mission]))
            spreads = {"wall_yaw_deg": yaw_deg} if yaw_deg else None
            for seed in BODY_SEEDS:
                with tempfile.TemporaryDirectory() as folder:
                    verdict = fly_px4(loaded, directory, seed, Path(folder), speed=pace, spreads=spreads)
                    flight = figures(part, "mocap", mission, verdict, pace)
                    flight.drawn = verdict.drawn
                    _add_what_follows(flight, verdict)
                    yield flight

    _keep(BODY + name, flights(BODY + name), report_dir)


def fly_ways(name: str, directory: str, report_dir: Path, pace: float) -> None:
    """The missions that use collisions, and the free flights of their scenarios, on one version of PX4."""

    def flights(part: str) -> Iterator[Flight]:
        for mission in USING_COLLISIONS:
            both = both_ways(mission)
            for way, seed in itertools.product((COLLIDING, FREE), WAYS_SEEDS):
                flown = both.missions[way]
                with tempfile.TemporaryDirectory() as folder:
                    verdict = fly_px4(flown, directory, seed, Path(folder), speed=pace)
                    flight = figures(part, "mocap", mission, verdict, pace)
                    flight.way, flight.followed = way, verdict.plan_followed
                    flight.planned_s = both.planned_s(way)
                    for hit, collision in zip(flight.hits, verdict.collisions, strict=True):
                        planned = collision.planned
                        hit.normal_planned_m_s = None if planned is None else planned.normal_m_s
                    arrival = None
                    if verdict.log is not None:
                        arrival = arrival_of(read_log(verdict.log), flown, both.visits)
                    if arrival is not None:
                        if both.visits:
                            flight.places = f"{len(arrival.visits_us)} of {len(both.visits)}"
                        flight.there_s = arrival.there_s if verdict.outcome == "completed" else None
                    yield flight

    _keep(WAYS + name, flights(WAYS + name), report_dir)


def _add_what_follows(flight: Flight, verdict: Verdict) -> None:
    """Tilt and rate of the vehicle after every hit, from the flight's log: truth, and its gyro's norm."""
    if verdict.log is None:
        return
    records = [entry.record for entry in read_log(verdict.log).entries]
    tilts = [(r.t_us, tilt_of(r.q_frd_to_ned)) for r in records if isinstance(r, TruthSample)]
    rates = [(r.t_us, norm(r.rate_frd)) for r in records if isinstance(r, ImuSample)]
    begins = [c.t_us for c in verdict.collisions] + [sys.maxsize]
    for hit, collision, following in zip(flight.hits, verdict.collisions, begins[1:], strict=True):
        begin, end = collision.t_us, min(following, collision.t_us + _AFTER_US)
        hit.incidence_deg = collision.truth.incidence_deg if collision.truth else None
        hit.tilt_deg, hit.rate_deg_s = (
            math.degrees(max((value for t_us, value in series if begin <= t_us < end), default=math.nan))
            for series in (tilts, rates)
        )


def _keep(part: str, flights: Iterator[Flight], report_dir: Path) -> None:
    """Write flights into the results as they come; they replace what was there of the part."""
    path = report_dir / FLIGHTS
    kept = [flight for flight in load(report_dir) if flight.part != part]
    path.write_bytes(b"".join(msgspec.json.encode(flight) + b"\n" for flight in kept))
    for flight in flights:
        with path.open("ab") as results:
            results.write(msgspec.json.encode(flight) + b"\n")
        what = f"{part} {flight.mission} {flight.sensor} seed {flight.seed}"
        print(f"{what}: {flight.outcome} {flight.reason or ''}", flush=True)


def load(report_dir: Path) -> list[Flight]:
    """The results so far."""
    path = report_dir / FLIGHTS
    if not path.exists():
        return []
    return [msgspec.json.decode(line, type=Flight) for line in path.read_bytes().splitlines()]


# --- tables ------------------------------------------------------------------------------------------


def _text(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _hits(flight: Flight, show: Callable[[Hit], str]) -> str:
    return " / ".join(show(hit) for hit in flight.hits) or "–"


def _spread(values: list[float | None], digits: int) -> str:
    known = sorted(v for v in values if v is not None)
    if not known:
        return "–"
    middle = known[len(known) // 2]
    return f"{middle:.{digits}f} ({known[0]:.{digits}f} to {known[-1]:.{digits}f})"


def _seeds_table(flights: list[Flight], mission: str) -> list[str]:
    """Every figure of a mission, a column for each world and source of the position."""
    columns = {
        "fast, mocap": f"fast-{mission}",
        "embedded, mocap": f"embedded-{mission}",
        "px4, mocap": f"{mission}-mocap",
        "px4, rtk": f"{mission}-rtk",
        "px4, plain": f"{mission}-plain",
    }
    groups = [[f for f in flights if f.part == part] for part in columns.values()]
    head = ["", *(f"{name}: {len(group)} flights" for name, group in zip(columns, groups, strict=True))]

    def line(name: str, of: Callable[[Flight], float | None], digits: int) -> list[str]:
        return [name, *(_spread([of(f) for f in group], digits) for group in groups)]

    rows = [
        ["completed", *(str(sum(f.outcome == "completed" for f in g)) for g in groups)],
        ["ended by", *(_ended_by(g) for g in groups)],
        ["failsafes", *(str(sum(bool(f.failsafe) for f in g)) for g in groups)],
    ]
    walls = max((len(f.hits) for group in groups for f in group), default=0)
    for i in range(walls):

        def of(pick: Callable[[Hit], float | None], i: int = i) -> Callable[[Flight], float | None]:
            return lambda f: pick(f.hits[i]) if i < len(f.hits) else None

        n = f"hit {i + 1}: "
        rows.append(line(n + "normal velocity, true, m/s", of(lambda h: h.normal_true_m_s), 3))
        rows.append(line(n + "tangential velocity, true, m/s", of(lambda h: h.tangential_true_m_s), 3))
        rows.append(line(n + "peak force, true, N", of(lambda h: h.force_true_n), 1))
        rows.append(line(n + "peak force measured / true", of(_force_ratio), 3))
        rows.append(line(n + "detection, ms", of(lambda h: h.detection_ms), 1))
        rows.append(line(n + "setpoint, ms", of(lambda h: h.setpoint_ms), 2))
    rows.append(line("max. tilt, °", lambda f: f.tilt_deg, 1))
    rows.append(line("position estimate off by up to, m", lambda f: f.ekf_m, 3))
    rows.append(line("estimator resets", lambda f: f.resets, 0))
    rows.append(line("goal miss, m", lambda f: f.miss_m, 3))
    rows.append(line("final error, m", lambda f: f.final_m, 3))
    return [markdown(head, rows)]


def _ended_by(flights: list[Flight]) -> str:
    rules = Counter((f.reason or "").partition(":")[0] for f in flights if f.outcome != "completed")
    return ", ".join(f"{rule} {count}" for rule, count in rules.most_common()) or "–"


def _force_ratio(hit: Hit) -> float | None:
    return hit.force_n / hit.force_true_n if hit.force_n and hit.force_true_n else None


def versions_table(flights: list[Flight]) -> str:
    """What was flown on which version, one row for each version, mission and source of position."""
    head = ["PX4", "says", "mission", "position", "completed", "final error m", "max. tilt °"]
    head += ["EKF off by m", "failsafes"]
    rows = []
    parts = {f.part for f in flights if f.part.startswith(VERSIONS)}
    for part in sorted(parts, key=lambda part: (not part.removeprefix(VERSIONS).startswith("v"), part)):
        for mission, sensor in VERSION_FLIGHTS:
            group = [f for f in flights if (f.part, f.mission, f.sensor) == (part, mission, sensor)]
            name = [part.removeprefix(VERSIONS), group[0].told or "–" if group else "–"]
            if not group:
                rows.append([*name, mission, sensor, "not flown", *["–"] * 4])
                continue
            good = sum(f.outcome == "completed" for f in group)
            reasons = sorted({f.reason for f in group if f.reason})
            rows.append(
                [
                    *name,
                    mission,
                    sensor,
                    f"{good} of {len(group)}" + (f" ({'; '.join(reasons)})" if reasons else ""),
                    " / ".join(_text(f.final_m, 3) for f in group),
                    _text(max((f.tilt_deg for f in group if f.tilt_deg is not None), default=None), 1),
                    _text(max((f.ekf_m for f in group if f.ekf_m is not None), default=None), 3),
                    str(sum(bool(f.failsafe) for f in group)),
                ]
            )
    return markdown(head, rows)


def body_table(flights: list[Flight]) -> str:
    """What hits of the body with guards did, one row for each flight."""
    head = ["PX4", "mission", "seed", "walls turned by °", "completed", "incidence °", "normal m/s", "peak N"]
    head += ["tilt after °", "rate after °/s", "final error m"]
    rows = []
    for f in flights:
        if not f.part.startswith(BODY):
            continue
        turned = " / ".join(f"{float(angle):+.1f}" for angle in f.drawn.values()) or "0"
        rows.append(
            [
                f.part.removeprefix(BODY),
                f.mission,
                str(f.seed),
                turned,
                "yes" if f.outcome == "completed" else f"no: {f.reason}",
                _hits(f, lambda h: _text(h.incidence_deg, 1)),
                _hits(f, lambda h: _text(h.normal_true_m_s, 2)),
                _hits(f, lambda h: _text(h.force_true_n, 0)),
                _hits(f, lambda h: _text(h.tilt_deg, 1)),
                _hits(f, lambda h: _text(h.rate_deg_s, 0)),
                _text(f.final_m, 3),
            ]
        )
    return markdown(head, rows)


def ways_table(flights: list[Flight]) -> str:
    """What was flown with collisions and without, one row for each flight."""
    head = [
        "PX4",
        "mission",
        "way",
        "seed",
        "completed",
        "plan followed",
        "places passed",
        "planned s",
        "flown s",
    ]
    head += ["hits: planned m/s", "flown m/s", "max. tilt °", "final error m", "EKF off by m"]
    rows = []
    for f in flights:
        if not f.part.startswith(WAYS):
            continue
        followed = {True: "yes", False: "no", None: "–"}[f.followed]
        rows.append(
            [
                f.part.removeprefix(WAYS),
                f.mission,
                f.way,
                str(f.seed),
                "yes" if f.outcome == "completed" else f"no: {f.reason}",
                followed,
                f.places or "–",
                _text(f.planned_s, 2),
                _text(f.there_s, 2),
                _hits(f, lambda h: _text(h.normal_planned_m_s, 2)),
                _hits(f, lambda h: _text(h.normal_true_m_s, 2)),
                _text(f.tilt_deg, 1),
                _text(f.final_m, 3),
                _text(f.ekf_m, 3),
            ]
        )
    return markdown(head, rows)


def with_table(page: str, name: str, table: str) -> str:
    """The page with a table between its marks; rows of versions that the new one lacks stay."""
    marked = re.compile(rf"(<!-- flown: {name} -->\n)(.*?)(<!-- end -->)", re.DOTALL)

    def version(row: str) -> str:
        return row.removeprefix("| ").partition(" |")[0]

    def put(match: re.Match[str]) -> str:
        head, rows = table.splitlines()[:2], [row for row in table.splitlines()[2:] if row]
        flown = {version(row) for row in rows}
        rows += [row for row in match[2].splitlines()[2:] if version(row) not in flown]
        rows.sort(key=lambda row: (not version(row).startswith("v"), version(row)))
        return match[1] + "\n".join([*head, *rows]) + "\n" + match[3]

    return marked.sub(put, page)


def report(flights: list[Flight]) -> str:
    """The tables, in Markdown."""
    lines = ["# Flights with a real PX4: the tables", ""]
    paces = " and ".join(f"{pace:g}" for pace in sorted({f.speed for f in flights if f.world == "px4"}))
    lines += [
        measured_by("tools.campaigns.px4", f"under PX4 SITL at {paces} times real time"),
        "",
    ]
    lines += ["[px4.md](../px4.md) explains.", ""]
    for mission, title in (("single", "Single wall"), ("dual", "Dual collision")):
        if any(f.part == f"{mission}-mocap" for f in flights):
            lines += [f"## {title}: median (least to most)", "", *_seeds_table(flights, mission)]
    return "\n".join(lines)


def run(report_dir: Path, pace: float) -> None:
    """Fly everything and write the tables.

    Raises:
        InputError: there is no PX4.
    """
    find_install(None)
    report_dir.mkdir(parents=True, exist_ok=True)
    for name in parts():
        fly_part(name, report_dir, pace)
    (report_dir / TABLES).write_text(report(load(report_dir)), encoding="utf-8")


# Parts that fly named versions of PX4, and whose table goes into docs/results/px4_versions.md.
BY_VERSION = {
    "versions": (fly_version, versions_table),
    "body": (fly_body, body_table),
    "ways": (fly_ways, ways_table),
}


def main() -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--part", choices=[*parts(), *BY_VERSION, "report"], help="one part, or only the tables"
    )
    parser.add_argument("--px4", action="append", default=[], metavar="NAME=DIR", help="a version to fly")
    parser.add_argument("--speed", type=float, default=SPEED, help="times real time; less on a busy machine")
    parser.add_argument("--report", type=Path, default=Path("build/campaign"))
    arguments = parser.parse_args()
    try:
        if arguments.part is None:
            run(arguments.report, arguments.speed)
            return 0
        arguments.report.mkdir(parents=True, exist_ok=True)
        if arguments.part in BY_VERSION:
            fly, tabulate = BY_VERSION[arguments.part]
            for name, _, directory in (one.partition("=") for one in arguments.px4):
                find_install(directory)
                fly(name, directory, arguments.report, arguments.speed)
            table = tabulate(load(arguments.report))
            PAGE.write_text(with_table(PAGE.read_text("utf-8"), arguments.part, table), "utf-8")
            return 0
        if arguments.part != "report":
            find_install(None)
            fly_part(arguments.part, arguments.report, arguments.speed)
        tables = report(load(arguments.report))
        (arguments.report / TABLES).write_text(tables, encoding="utf-8")
    except InputError as error:
        print(error.one_line(), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
