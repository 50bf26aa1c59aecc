"""Hardware in the loop without hardware: missions beside lockstep, and what breaks on a table.

A PX4 without lockstep in hardware-in-the-loop mode on two pseudo-terminals, that of the app's link held to
what 921600 baud carry, and the lock's servo behind an emulated Maestro on a third; flown by the command, as
a person does.

    DART_PX4_HITL_DIR=... DART_PX4_DIR=... python -m tools.campaigns.hitl [--part NAME]

Every flight goes to `build/hitl.jsonl` as it comes; a part that is flown again replaces its lines, and
docs/results/hitl.md is written from that file. A flight is uncontrolled as in `tools.campaigns.faults`: out
of the bounds, tilted over, hard on the ground, left armed, without a cause, or with a traceback.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import msgspec

from dart_flight.recording.reader import read_log
from dart_flight.recording.uncontrolled import find_uncontrolled
from dart_flight.recording.verdict import Verdict
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.px4.launch import ENVIRONMENT as LOCKSTEP
from tests.doubles.emulated_maestro import EmulatedMaestro
from tests.doubles.hitl_px4 import ENVIRONMENT, HitlPx4
from tools.campaigns.faults import Watch
from tools.campaigns.kept import kept_lines
from tools.campaigns.results import RESULTS, ROOT, markdown, measured_by

MISSIONS = ("single_wall", "dual_collision", "dual_collision_replan")
SEEDS = range(1, 6)
KEPT = ROOT / "build" / "hitl.jsonl"
PAGE, FIRST, LAST = RESULTS / "hitl.md", "<!-- flown -->\n", "<!-- end -->"
_NO_REMOTE = {"COM_RC_IN_MODE": 4, "NAV_DLL_ACT": 0}  # nobody at a stick or a ground station
_LIMIT_S = 240.0  # for a command; a flight takes 40 s
_LINK = re.compile(r"(\d+) not taken by the port; (\d+) of (\d+) ticks reported late; .*? (\d+) ms")


class BenchFlight(msgspec.Struct):
    """One flight in a few figures."""

    part: str
    mission: str
    seed: int
    outcome: str
    reason: str | None = None
    tilt_deg: float | None = None  # true
    ekf_m: float | None = None
    force_ratios: list[float] = []  # measured by true peak
    miss_m: float | None = None
    excursion_m: float = 0.0
    lost_bytes: list[int] = []  # USB and TELEM2, to PX4 and back
    not_taken: int | None = None
    late: float | None = None  # share of ticks
    gap_ms: int | None = None
    problems: list[str] = []


class Bench:
    """What stands on the table, and what a fault does to it."""

    def __init__(self, px4: HitlPx4, maestro: EmulatedMaestro) -> None:
        self.px4, self.maestro = px4, maestro

    def cut_usb(self, seconds: float) -> None:
        """Pull the USB cable, and put it back after a while."""
        self.px4.usb.cut = True
        if math.isfinite(seconds):
            time.sleep(seconds)
            self.px4.usb.cut = False


# Part -> (what it is called, the line of the flight after which it begins, what it does).
FAULTS: dict[str, tuple[str, str, Callable[[Bench], None]]] = {
    "busy": ("two busy cores", "", lambda bench: None),
    "cut-50": ("USB cut for 50 ms", "→ APPROACH", lambda bench: bench.cut_usb(0.05)),
    "cut-200": ("USB cut for 200 ms", "→ APPROACH", lambda bench: bench.cut_usb(0.2)),
    "cut": ("USB cut for good", "→ APPROACH", lambda bench: bench.cut_usb(math.inf)),
    "servo-mute": ("Maestro does not answer", "→ TRANSIT", lambda bench: bench.maestro.mute()),
    "servo-gone": ("Maestro unplugged", "→ TRANSIT", lambda bench: bench.maestro.unplug()),
}


@contextmanager
def busy_cores(many: int) -> Iterator[None]:
    """So many loops beside, of the same priority."""
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(many)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def fly_bench(part: str, name: str, seed: int) -> BenchFlight:
    """One flight in hardware in the loop, by the command; `part` may name a fault."""
    mission = load_flyable(ROOT / "missions" / f"{name}.yaml")
    lock = mission.vehicle.lock
    assert lock is not None
    _, after, break_it = FAULTS.get(part, ("", "", lambda bench: None))
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        began = time.monotonic()
        maestro = stack.enter_context(
            EmulatedMaestro(
                lock.servo,
                folder / "maestro",
                lambda: round((time.monotonic() - began) * 1e6),
                channel=lock.maestro.channel,
                horn_us=lock.servo.flexible_pulse_us,
            )
        )
        (folder / "px4").mkdir()
        px4 = stack.enter_context(HitlPx4(os.environ[ENVIRONMENT], folder / "px4", mission, _NO_REMOTE))
        stack.enter_context(busy_cores(2 if part == "busy" else 0))
        bench = Bench(px4, maestro)
        command = [sys.executable, "-m", "dart_flight", "dry-run", str(mission.source), "--json"]
        command += ["--hitl", px4.usb_url, "--connection", px4.url, "--seed", str(seed)]
        command += ["--driver", "maestro", "--set", f"lock.maestro.port={maestro.link}"]
        command += ["--log-dir", str(folder / "logs")]
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        lines: list[str] = []
        assert process.stderr is not None
        follower = threading.Thread(target=_follow, args=(process.stderr, lines, after, break_it, bench))
        follower.start()
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write("propellers off\n")
        process.stdin.close()
        guard = threading.Timer(_LIMIT_S, process.kill)
        guard.start()
        told = process.stdout.read()
        status = process.wait()
        guard.cancel()
        follower.join()
        lost = [*px4.usb.dropped[::-1], *px4.telem2.dropped[::-1]]
        flight = BenchFlight(part, name, seed, "no verdict", lost_bytes=lost)
        if px4.is_armed():
            flight.problems.append("left armed")
        return _figures(flight, told, status, "".join(lines), folder / "logs")


def _follow(
    stream: Iterator[str], lines: list[str], after: str, break_it: Callable[[Bench], None], bench: Bench
) -> None:
    """Keep what the command says, and break something once it has said a thing."""
    waits = bool(after)
    for line in stream:
        lines.append(line)
        if waits and after in line:
            waits = False
            break_it(bench)


def _figures(flight: BenchFlight, told: str, status: int, said: str, logs: Path) -> BenchFlight:
    if "Traceback" in said:
        flight.problems.append("traceback")
    for text in logs.rglob("autopilot.log"):
        found = _LINK.search(text.read_text())
        if found:
            not_taken, late, ticks, gap_ms = map(int, found.groups())
            flight.not_taken, flight.late, flight.gap_ms = not_taken, late / ticks, gap_ms
    verdict = json.loads(told) if told.strip() else {}
    flight.outcome = verdict.get("outcome", flight.outcome)
    flight.reason = verdict.get("reason") or ("" if verdict else said.strip().splitlines()[-1])
    flight.ekf_m, flight.miss_m = verdict.get("ekf_error_m"), verdict.get("goal_miss_m")
    for collision in verdict.get("collisions", []):
        measured, true = (collision.get(which) or {} for which in ("measured", "truth"))
        if measured.get("peak_force_n") and true.get("peak_force_n"):
            flight.force_ratios.append(measured["peak_force_n"] / true["peak_force_n"])
    if (status == 0) is not (flight.outcome == "completed"):
        flight.problems.append(f"exit status {status}")
    if flight.outcome != "completed" and not flight.reason:
        flight.problems.append("no cause")
    for log in logs.rglob("flight.mcap"):
        _add_truth(flight, log)
    return flight


def _add_truth(flight: BenchFlight, log: Path) -> None:
    watch = Watch(load_flyable(ROOT / "missions" / f"{flight.mission}.yaml"))
    for entry in read_log(log).entries:
        watch.take(entry.record)
    flight.tilt_deg, flight.excursion_m = math.degrees(watch.truth.tilt_rad), watch.truth.excursion_m
    flight.problems += find_uncontrolled(watch.truth, completed=True, explained=True)


def fly_lockstep(name: str, seed: int, speed: float) -> BenchFlight:
    """The same flight under PX4 in lockstep."""
    from dart_flight.run.px4_flight import fly_px4  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as folder:
        mission = load_flyable(ROOT / "missions" / f"{name}.yaml")
        verdict: Verdict = fly_px4(mission, os.environ[LOCKSTEP], seed, Path(folder), speed=speed)
        flight = BenchFlight("lockstep", name, seed, verdict.outcome, verdict.reason)
        flight.ekf_m, flight.miss_m = verdict.ekf_error_m, verdict.goal_miss_m
        for c in verdict.collisions:
            if c.truth and c.truth.peak_force_n and c.measured.peak_force_n:
                flight.force_ratios.append(c.measured.peak_force_n / c.truth.peak_force_n)
        if verdict.log is not None:
            _add_truth(flight, Path(verdict.log))
    return flight


# --- the page ----------------------------------------------------------------------------------------------


def _span(values: list[float], digits: int, scale: float = 1.0) -> str:
    known = sorted(value * scale for value in values if value is not None)
    if not known:
        return "–"
    low, high = f"{known[0]:.{digits}f}", f"{known[-1]:.{digits}f}"
    return low if low == high else f"{low} to {high}"


def _group(flights: list[BenchFlight], name: str, part: str) -> list[str]:
    group = [f for f in flights if (f.mission, f.part) == (name, part)]

    def known(pick: Callable[[BenchFlight], float | None]) -> list[float]:
        return [value for f in group if (value := pick(f)) is not None]

    others = sorted({f.reason or "" for f in group if f.outcome != "completed"})
    lost = [sum(f.lost_bytes[i] for f in group if f.lost_bytes) for i in range(4)]
    return [
        f"`{name}`",
        part,
        f"{sum(f.outcome == 'completed' for f in group)} of {len(group)}" + "".join(f"; {o}" for o in others),
        _span(known(lambda f: f.tilt_deg), 1),
        _span(known(lambda f: f.ekf_m), 3),
        _span([ratio for f in group for ratio in f.force_ratios], 2),
        _span(known(lambda f: f.miss_m), 2),
        " ".join(map(str, lost)) if part == "hitl" else "–",
        _span(known(lambda f: f.late), 2, 100.0),
        _span(known(lambda f: f.gap_ms), 0),
    ]


def tables(flights: list[BenchFlight]) -> str:
    """Missions beside lockstep, then the faults."""
    heads = ["mission", "world", "completed", "tilt °", "EKF off by m", "peak force measured / true"]
    heads += ["goal miss m", "bytes lost: USB, back, TELEM2, back", "ticks late %", "longest gap ms"]
    rows = [_group(flights, name, part) for name in MISSIONS for part in ("hitl", "lockstep")]
    text = markdown(heads, rows)
    heads = ["fault", "outcome", "cause", "tilt °", "out of bounds m", "longest gap ms", "uncontrolled"]
    rows = [
        [
            FAULTS[f.part][0],
            f.outcome,
            f.reason or "–",
            _span([f.tilt_deg or 0.0], 1),
            _span([f.excursion_m], 2),
            "–" if f.gap_ms is None else str(f.gap_ms),
            "; ".join(f.problems) or "no",
        ]
        for part in FAULTS
        for f in flights
        if f.part == part
    ]
    return text + "\n" + markdown(heads, rows)


def write_page() -> None:
    """Put the tables, and the day, where the page has them."""
    page = PAGE.read_text("utf-8")
    head, _, rest = page.partition(FIRST)
    tail = rest.partition(LAST)[2]
    day = measured_by("tools.campaigns.hitl", "in simulation").partition(" by ")[0]
    head = re.sub(r"^Measured on [\d-]+", day, head, flags=re.MULTILINE)
    PAGE.write_text(head + FIRST + tables(kept_lines(KEPT, BenchFlight)) + LAST + tail, "utf-8")


def main() -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--part", choices=["hitl", "lockstep", *FAULTS, "page"], help="one part alone")
    parser.add_argument("--mission", choices=MISSIONS, help="of the parts hitl and lockstep")
    parser.add_argument("--seed", type=int, help="one alone, likewise")
    parser.add_argument("--speed", type=float, default=1.0, help="of lockstep, times real time")
    given = parser.parse_args()
    parts = ["hitl", "lockstep", *FAULTS] if given.part is None else [given.part]
    KEPT.parent.mkdir(exist_ok=True)
    for part in (part for part in parts if part != "page"):
        names = MISSIONS if part in ("hitl", "lockstep") else MISSIONS[:1]
        for name in [given.mission] if given.mission else names:
            for seed in [given.seed] if given.seed else SEEDS if part not in FAULTS else SEEDS[:1]:
                if part == "lockstep":
                    flight = fly_lockstep(name, seed, given.speed)
                else:
                    flight = fly_bench(part, name, seed)
                key = (flight.part, flight.mission, flight.seed)
                kept = [f for f in kept_lines(KEPT, BenchFlight) if (f.part, f.mission, f.seed) != key] + [
                    flight
                ]
                KEPT.write_bytes(b"".join(msgspec.json.encode(f) + b"\n" for f in kept))
                said = f"{flight.outcome} {flight.reason or ''} {flight.problems or ''}"
                print(f"{part} {name} seed {seed}: {said}", flush=True)
    write_page()
    return 0


if __name__ == "__main__":
    sys.exit(main())
