"""Every fault in every phase, and thousands of random ones, in the fast world: is any flight uncontrolled?

    python -m tools.campaigns.faults --runs 2000
    python -m tools.campaigns.faults --only second-vehicle  # one row of the matrix anew

A flight counts as controlled only when all of this holds:

* no exception escaped;
* it ended: landed and disarmed (by the mission, the guard, or PX4's own failsafe once the app is gone), or
  held still in another mode than offboard after a pilot took over;
* what did not complete says why: a rule of the guard is in the log and in the verdict's reason (where the app
  itself was hung or killed nothing is left to say it: then PX4's failsafe must have landed the vehicle);
* by its truth it is controlled as `dart_flight.recording.uncontrolled` defines that, out of the bounds by no
  more than `excursion_allowed_m` (a vehicle whose kill switch was thrown may tilt and fall);
* its log opens.
"""

from __future__ import annotations

import argparse
import csv
import math
import random
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import msgspec
from mcap.records import Chunk, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk

from dart_flight.base.geometry import distance2
from dart_flight.base.records import FlightMode, GuardEvent, Record, TruthSample, World
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import packaged
from dart_flight.recording.reader import read_log
from dart_flight.recording.uncontrolled import OUT_M, TruthExtremes, find_uncontrolled
from dart_flight.recording.verdict import VerdictBuilder
from dart_flight.recording.writer import FlightLog
from dart_flight.run.fast import FastFlight
from dart_flight.run.prepare import load_flyable
from dart_flight.run.program_fault import fill_disk_of
from dart_flight.sim.faults.fault_table import KINDS, Fault, parse_fault
from tools.campaigns.kept import fly_missing
from tools.campaigns.results import RESULTS, measured_by

EXPECTED = Path(__file__).resolve().parents[2] / "tests" / "faults" / "expected.csv"
ON_GROUND = "ground"  # from the start on
PHASES = (ON_GROUND, "take-off", "approach", "contact", "recovery", "goal")
MISSIONS = ("paper_dual_collision", "paper_single_wall")
_NAMES = tuple(kind.name for kind in KINDS)
# Every fault at its default value, and where more than one value matters those.
_VALUES = {"delay": (100, 300, 1000, 2000), "ev-delay": (90,), "heading-reset": (90,)}
ROWS = tuple(
    row for name in _NAMES for row in (name, *(f"{name}={value}" for value in _VALUES.get(name, ())))
)
_DOWN_M = 0.2  # lying on its side the vehicle's centre is this high
_STILL_M_S = 0.3


class Flown(msgspec.Struct):
    """One faulted flight in a few figures."""

    fault: Fault
    seed: int
    mission: str
    began: bool
    outcome: str
    rule: str
    decision_ms: float | None
    excursion_m: float
    landing_m_s: float
    tilt_deg: float
    problems: list[str]


_KEPT = tuple[tuple[str, str] | int, Flown]  # a cell of the matrix or the number of a random flight


class Watch:
    """What truth did in one flight, and when a part of the program first decided something."""

    def __init__(self, mission: Mission) -> None:
        self.truth = TruthExtremes(mission.bounds)
        self.flight: FastFlight | None = None
        self.decided_us: int | None = None
        self.rules: list[str] = []

    def take(self, record: Record) -> None:
        if isinstance(record, GuardEvent):
            self.rules.append(record.rule)
            self._decide()
        elif isinstance(record, TruthSample):
            self.truth.update(record)

    @property
    def is_down(self) -> bool:
        """Whether the vehicle lay on the ground at last; true of one that has not been seen."""
        last = self.truth.last
        return last is None or last.position_mission[2] <= _DOWN_M

    def on_text(self, text: str) -> None:
        if "failsafe" in text.lower():
            self._decide()

    def _decide(self) -> None:
        faulted = self.flight.faulted if self.flight is not None else None
        if self.decided_us is None and faulted is not None and faulted.began_us is not None:
            assert self.flight is not None
            self.decided_us = self.flight.host_us


def fly(mission: Mission, fault: Fault, seed: int, folder: Path | None = None) -> Flown:
    """One flight with one fault, on to the ground; with `folder` its log is written, opened and removed."""
    watch, builder = Watch(mission), VerdictBuilder(mission)
    path = None if folder is None else folder / f"{fault.name}-{fault.phase}-{seed}.mcap"
    log = None if path is None else FlightLog(path, {"mission": mission.name})

    filled: list[bool] = []

    def observe(record: Record, number: int) -> None:
        builder.take(record)
        watch.take(record)
        if log is not None:
            log.put(record, number)
            if filled:
                return
            if fault.name == "disk-full" and flight.faulted is not None and flight.faulted.began_us and path:
                filled.append(True)
                fill_disk_of(path)

    flight = FastFlight(mission, seed, observe=observe, fault=fault)
    watch.flight = flight
    tell = flight.autopilot.say

    def say(severity: str, text: str) -> None:
        watch.on_text(text)
        tell(severity, text)

    flight.autopilot.say = say
    problems = []
    try:
        flight.run()
        run_out(flight)
    except Exception as error:
        problems.append(f"exception {type(error).__name__}: {error}")
    problems += _close(log, path)
    verdict = builder.build(World.FAST, seed)
    assert flight.faulted is not None
    began = flight.faulted.began_us
    rule = (verdict.reason or "").split(":")[0] if verdict.guard else ""
    if flight.faulted.app_silent:
        rule = "app gone"
    problems += judge(flight, watch, fault, verdict.outcome, rule)
    return Flown(
        fault=fault,
        seed=seed,
        mission=mission.name,
        began=began is not None,
        outcome=verdict.outcome,
        rule=rule,
        decision_ms=None if watch.decided_us is None or began is None else (watch.decided_us - began) * 1e-3,
        excursion_m=watch.truth.excursion_m,
        landing_m_s=watch.truth.landing_m_s,
        tilt_deg=math.degrees(watch.truth.tilt_rad),
        problems=problems,
    )


def _close(log: FlightLog | None, path: Path | None) -> list[str]:
    if log is None or path is None:
        return []
    log.close()
    try:
        # Every record of every log decoded would take longer than the flights: a sample of them is.
        if sum(path.name.encode()) % 10 == 0 or log.failure is not None:
            named = bool(read_log(path).about.get("mission"))
        else:
            named = any(isinstance(record, Metadata) for record in _records(path))
    except Exception as error:
        return [f"its log does not open: {error}"]
    finally:
        path.unlink()
    return [] if named else ["its log does not say what it is"]


def _records(path: Path) -> list[object]:
    """Everything in an MCAP file, checksums checked."""
    with open(path, "rb") as stream:
        records = list(StreamReader(stream, emit_chunks=True).records)
    for chunk in records:
        if isinstance(chunk, Chunk):
            breakup_chunk(chunk, validate_crc=True)
    return list(records)


def run_out(flight: FastFlight, limit_s: float = 60.0) -> None:
    """Let the vehicle fly on by itself until it has landed, for `limit_s` more seconds at most.

    In a pilot's hands it only has to hold still: three seconds of that are enough.
    """
    until_s = flight.autopilot.now_s + limit_s
    while flight.autopilot.armed and flight.autopilot.now_s < until_s:
        flight.tick()
        if flight.autopilot.mode is FlightMode.MANUAL:
            until_s = min(until_s, flight.autopilot.now_s + 3.0)


def excursion_allowed_m(fault: Fault | None) -> float:
    """How far outside of the bounds a faulted flight may get before it counts as uncontrolled, metres.

    Half a metre for braking; and where the position itself is wrong, as much as it is wrong by.
    """
    wrong = abs(fault.value) if fault is not None and fault.name == "ekf-jump" else 0.0
    return OUT_M + wrong if math.isfinite(wrong) else math.inf


def judge(flight: FastFlight, watch: Watch, fault: Fault | None, outcome: str, rule: str) -> Iterator[str]:
    """What is uncontrolled about a flight; nothing where it is not."""
    a = flight.autopilot
    falls = fault is not None and fault.name == "kill-switch"  # what the switch is for
    gone = flight.faulted is not None and flight.faulted.app_silent
    if flight.core.end is None and not gone:
        yield "it did not end"
    if a.armed:
        speed = distance2(a.plant.velocity, (0.0, 0.0))
        held = a.mode in (FlightMode.MANUAL, FlightMode.HOLD) and speed < _STILL_M_S
        if not (outcome == "released" and held):
            yield f"still armed in {a.mode.value} at {speed:.2f} m/s"
    elif not falls and not watch.is_down:
        yield "disarmed in the air"
    allowed_m = excursion_allowed_m(fault)
    yield from find_uncontrolled(watch.truth, outcome == "completed", bool(rule), allowed_m, falls)


# --- the matrix --------------------------------------------------------------------------------------------


def expected() -> dict[tuple[str, str], frozenset[str]]:
    """Cell -> what may come of it: rules of the guard, `completed`, or `app gone`."""
    with open(EXPECTED, newline="") as file:
        rows = list(csv.reader(file))
    return {
        (row[0], phase): frozenset(cell.split("|"))
        for row in rows[1:]
        for phase, cell in zip(rows[0][1:], row[1:], strict=True)
    }


def came_of(flown: Flown) -> str:
    """A flight's outcome in the words of the table."""
    return flown.rule if flown.outcome != "completed" else "completed"


def _mission(name: str) -> Mission:
    return load_flyable(packaged("missions", f"{name}.yaml"))


def cell(row: str, phase: str, seed: int = 1) -> Flown:
    """One cell of the matrix: the paper's dual collision."""
    fault = parse_fault(row if phase == ON_GROUND else f"{row}@{phase}")
    with tempfile.TemporaryDirectory() as folder:
        return fly(_mission("paper_dual_collision"), fault, seed, Path(folder))


def random_flight(number: int) -> Flown:
    """One of the campaign's flights: fault, value, phase, moment and mission follow from its number."""
    chance = random.Random(f"faults {number}")
    kind = KINDS[number % len(KINDS)]
    value = chance.uniform(kind.low, kind.high)
    if kind.name == "packet-loss":
        value = chance.uniform(1.0, 20.0)
    elif kind.name in ("reorder", "duplicate"):
        value = chance.uniform(1.0, 50.0)
    elif kind.name in ("delay", "jitter"):
        value = chance.uniform(5.0, 300.0)
    elif kind.name == "ekf-jump":
        value = chance.uniform(-1.0, 1.0)
    elif kind.name == "gust":
        value = chance.uniform(-8.0, 8.0)
    elif kind.name == "wall-nearer":
        value = chance.uniform(-0.3, 0.3)
    phase = chance.choice((None, "take-off", "transit", "approach", "contact", "recovery", "goal", "landing"))
    fault = Fault(kind.name, value, phase, chance.choice((0.0, 0.0, chance.uniform(0.0, 3.0))))
    with tempfile.TemporaryDirectory() as folder:
        return fly(_mission(chance.choice(MISSIONS)), fault, number, Path(folder))


def _flight(job: tuple[str, str] | int) -> Flown:
    return random_flight(job) if isinstance(job, int) else cell(*job)


# --- the report --------------------------------------------------------------------------------------------


def _cell_text(flown: Flown) -> str:
    if not flown.began:
        return "-"
    parts = [came_of(flown)]
    if flown.decision_ms is not None:
        parts.append(f"{flown.decision_ms:.0f} ms")
    parts.append(f"{flown.excursion_m:.2f} m")
    if flown.problems:
        parts.append(_UNCONTROLLED + "; ".join(flown.problems) + "**")
    return "<br>".join(parts)


def _most(values: Iterable[float]) -> float:
    return max(values, default=0.0)


_RANDOM = "## Random faults"
_UNCONTROLLED = "**uncontrolled: "


def _head(row: str) -> str:
    """What a row of the matrix begins with."""
    fault = parse_fault(row)
    return f"| {fault.name} {fault.value:g} {fault.kind.unit} |" if fault.kind.unit else f"| {fault.name} |"


def _row(row: str, cells: list[Flown]) -> str:
    """A row of the matrix; its cells in the order of the phases."""
    return f"{_head(row)} " + " | ".join(map(_cell_text, cells)) + " |"


def _row_of(line: str) -> str | None:
    """The row of the matrix that a line of the page is; None: it is none."""
    return next((row for row in ROWS if line.startswith(_head(row))), None)


def _count(matrix: list[str]) -> str:
    rows = [line for line in matrix if _row_of(line)]
    wrong = sum(line.count(_UNCONTROLLED) for line in rows)
    return f"{len(rows) * len(PHASES)} cells, {wrong} uncontrolled."


def with_row(page: str, row: str) -> str:
    """The page with a row of the matrix put in or replaced, and its count; the rest as it is."""
    matrix, heading, rest = page.partition(_RANDOM)
    lines = [line for line in matrix.splitlines() if not re.match(r"\d+ cells, ", line)]
    rows = {name: line for line in lines if (name := _row_of(line)) is not None}
    rows[_row_of(row) or ""] = row
    head = lines[: next(i for i, line in enumerate(lines) if line.startswith("|---")) + 1]
    lines = [*head, *(rows[name] for name in ROWS if name in rows)]
    return "\n".join([*lines, "", _count(lines), "", heading + rest])


def report(cells: list[Flown], flights: list[Flown]) -> str:
    """The page."""
    lines = [
        "# Fault matrix",
        "",
        measured_by("tools.campaigns.faults"),
        "",
        "Fast world, the paper's dual collision, seed 1: each fault of `sim/faults/fault_table.py` at its",
        "default value, from the phase's beginning on (ground: from the start on). A cell says what came of",
        "it, the time from the fault to the first decision (of the guard, or of PX4's own failsafe where the",
        "app is gone), and how far truth got out of the bounds. `--only FAULT` flies one row anew.",
        "`tests/faults/expected.csv` says what each cell may be, and `tests/faults/test_matrix.py` holds it",
        "to that. What counts as uncontrolled is in `tools/campaigns/faults.py`. Faults of hardware in the",
        "loop have [a table of their own](hitl.md).",
        "",
        "| fault | " + " | ".join(PHASES) + " |",
        "|---" * (len(PHASES) + 1) + "|",
    ]
    many = len(PHASES)
    lines += [_row(row, cells[many * i : many * (i + 1)]) for i, row in enumerate(ROWS)]
    lines += ["", _count(lines), "", _RANDOM, ""]
    bad = [f for f in flights if f.problems]
    begun = sum(f.began for f in flights)
    decided = sorted(f.decision_ms for f in flights if f.decision_ms is not None)
    lines += [
        f"{len(flights)} flights with a random fault of this table, value, phase and moment (both missions);",
        f"in {begun} of them the fault's moment came. Uncontrolled: {len(bad)}. Logs that did not open: "
        f"{sum('log' in p for f in flights for p in f.problems)}. Largest excursion",
        f"beyond the bounds {_most(f.excursion_m for f in flights):.2f} m, hardest landing "
        f"{_most(f.landing_m_s for f in flights):.2f} m/s, largest tilt "
        f"{_most(f.tilt_deg for f in flights):.0f} degrees.",
        "",
        "| fault | flights | completed | other ends | median decision | largest excursion |",
        "|---|---|---|---|---|---|",
    ]
    for kind in KINDS:
        mine = [f for f in flights if f.fault.name == kind.name]
        ends = Counter(map(came_of, mine))
        done = ends.pop("completed", 0)
        told = ", ".join(f"{name} {count}" for name, count in ends.most_common()) or "-"
        times = sorted(f.decision_ms for f in mine if f.decision_ms is not None)
        median = f"{times[len(times) // 2]:.0f} ms" if times else "-"
        far = max((f.excursion_m for f in mine), default=0.0)
        lines.append(f"| {kind.name} | {len(mine)} | {done} | {told} | {median} | {far:.2f} m |")
    lines += [
        f"- flight {f.seed}: {f.fault.name} {f.fault.value:g} @ {f.fault.phase}: {f.problems}" for f in bad
    ]
    if decided:
        lines += ["", f"Decisions over all: {len(decided)}, median {decided[len(decided) // 2]:.0f} ms."]
    return "\n".join(lines) + "\n"


def run(report_dir: Path, runs: int = 2000) -> None:
    """Matrix and campaign; writes `fault_matrix.md` into `report_dir`.

    Raises:
        RuntimeError: a flight was uncontrolled.
    """
    keys: list[tuple[str, str] | int] = [(row, phase) for row in ROWS for phase in PHASES]
    cells = fly_missing(Path("build/faults_matrix.jsonl"), keys, _flight, _KEPT)
    flights = fly_missing(Path("build/faults_random.jsonl"), range(runs), _flight, _KEPT)
    (report_dir / "fault_matrix.md").write_text(report(cells, flights))
    bad = [f for f in (*cells, *flights) if f.problems]
    if bad:
        raise RuntimeError(f"{len(bad)} flights uncontrolled, first: {bad[0]}")


def run_only(report_dir: Path, name: str) -> None:
    """Fly one fault in every phase and put its row into `fault_matrix.md`.

    Raises:
        RuntimeError: a flight was uncontrolled.
    """
    cells = [cell(name, phase) for phase in PHASES]
    page = report_dir / "fault_matrix.md"
    page.write_text(with_row(page.read_text(), _row(name, cells)))
    bad = [f for f in cells if f.problems]
    if bad:
        raise RuntimeError(f"{len(bad)} flights uncontrolled, first: {bad[0]}")


def main() -> int:
    """Run it from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--report-dir", type=Path, default=RESULTS)
    parser.add_argument("--only", choices=ROWS, metavar="FAULT", help="fly this row of the matrix anew")
    arguments = parser.parse_args()
    if arguments.only:
        run_only(arguments.report_dir, arguments.only)
    else:
        arguments.report_dir.mkdir(parents=True, exist_ok=True)  # before hours of flights, not after them
        run(arguments.report_dir, arguments.runs)
    return 0


if __name__ == "__main__":
    sys.exit(main())


__all__ = [
    "EXPECTED",
    "PHASES",
    "ROWS",
    "came_of",
    "cell",
    "expected",
    "fly",
    "random_flight",
    "run",
    "with_row",
]
