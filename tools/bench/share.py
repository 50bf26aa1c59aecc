"""Benchmark: what a flight takes of a core at 250 Hz, by part, above MAVSDK alone at the same rates.

    python -m tools.bench.share [--seconds S] [--rounds N] [--busy] [--monitor | --flight]

Each client is a process of its own against `impact_source` (a contact every three seconds); clients take
turns. Parts are threads, by the processor time that Linux counts for each: what is neither Python's nor the
app's own is MAVSDK's, whose callbacks build the records. The deadman is a process.
Figures: docs/results/latency.md.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

import msgspec
from rich.console import Console
from rich.table import Table

from dart_flight.base.records import World
from dart_flight.config.mission import Mission
from dart_flight.run.app import FlightApp
from dart_flight.run.core_thread import CoreThread
from dart_flight.run.flight_record import FlightRecord
from dart_flight.run.runner import CoreRunner
from dart_flight.vehicle.clock import host_us
from dart_flight.vehicle.vehicle_session import connect
from tests.doubles.ports import free_udp_port
from tools.bench import alone
from tools.bench.impact_source import MISSION
from tools.bench.latency import RepeatingCore, rigid_mission
from tools.bench.processor import family_seconds, process_seconds, thread_seconds

SECONDS, ROUNDS = 20.0, 3
FAR = "app, no wall near"
_FAR_M = 0.6  # north: a metre before the wall
_PERIOD_S = 3.0
_LEAD_S = 8.0  # connection, rates, the app's start
MAVSDK = "MAVSDK and its callbacks"
MONITOR, WATCHING = "monitor", "MAVSDK alone at monitor's rates"
WATCHING_ALL = "MAVSDK alone, until it is ended"
DUAL = MISSION.with_name("paper_dual_collision.yaml")
_QUIET: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
Shares = dict[str, float]  # part -> per cent of a core


def _named() -> dict[int, str]:
    return {thread.native_id or 0: thread.name for thread in threading.enumerate()}


async def _measure(seconds: float, extra: Callable[[], Shares] = dict) -> Shares:
    """Shares of this process's threads from now on; `extra` adds other processes' seconds."""
    names, before, began, others = _named(), thread_seconds(), time.monotonic(), extra()
    await asyncio.sleep(seconds)
    wall = time.monotonic() - began
    shares: Shares = {MAVSDK: 0.0}
    for tid, after in thread_seconds().items():
        name = names.get(tid, MAVSDK)
        shares[name] = shares.get(name, 0.0) + 100.0 * (after - before.get(tid, 0.0)) / wall
    for name, spent in extra().items():
        shares[name] = 100.0 * (spent - others[name]) / wall
    return shares


# --- the clients -------------------------------------------------------------------------------------------


async def mavsdk_alone(mission: Mission, url: str, seconds: float) -> Shares:
    """The floor: the same subscriptions and rates, empty callbacks."""
    ended = asyncio.Event()
    staying = asyncio.create_task(alone.stay(mission, url, ended))
    await asyncio.sleep(_LEAD_S)
    shares = await _measure(seconds)
    ended.set()
    await staying
    return shares


async def samples_only(mission: Mission, url: str, seconds: float) -> Shares:
    """The app's own callbacks, whose records nobody takes."""
    async with connect(url, mission.vehicle.connection.timeout_s, _nobody) as session:
        session.subscribe(mission.vehicle.estimation, len(mission.vehicle.airframe.motors))
        await session.set_rates()
        await asyncio.sleep(_LEAD_S)
        return await _measure(seconds)


def _nobody(_: object) -> None:
    """Takes a record."""


async def far_app(mission: Mission, url: str, seconds: float) -> Shares:
    """The whole app where no wall is near."""
    return await whole_app(mission, url, seconds, hit=False)


async def whole_app(mission: Mission, url: str, seconds: float, *, hit: bool = True) -> Shares:
    """Link, core, lock, log, deadman, terminal, as `fly` has them."""
    with tempfile.TemporaryDirectory() as folder:
        record = FlightRecord(mission, World.EMBEDDED, None, Path(folder))
        app = FlightApp(mission, url, record, deadman_note=Path(folder) / "deadman.txt")
        core = RepeatingCore(mission)
        app._core = CoreThread(CoreRunner(core, app, app._see, host_us), lambda: app._feed(b"c"))
        flying = asyncio.create_task(app.run())
        await asyncio.sleep(_LEAD_S)
        shares = await _measure(seconds, lambda: {"deadman (process)": _process_seconds(app)})
        app._done.set()
        await flying
        record.close()
        if hit and not core.recoveries:
            raise RuntimeError("no impact was answered")
    return shares


def _process_seconds(app: FlightApp) -> float:
    return 0.0 if app._deadman is None else process_seconds(app._deadman.pid)


async def _stay_alone(mission: Mission, url: str, seconds: float) -> Shares:
    """What a flight has of MAVSDK, until it is ended."""
    await alone.stay(mission, url, asyncio.Event())
    return {}


async def _watching_alone(mission: Mission, url: str, seconds: float) -> Shares:
    """What `monitor` has of it, until it is ended."""
    await alone.stay(mission, url, asyncio.Event(), watching=True)
    return {}


CLIENTS = {"MAVSDK alone": mavsdk_alone, "samples": samples_only, FAR: far_app, "app": whole_app}
STAYING = {WATCHING: _watching_alone, WATCHING_ALL: _stay_alone}


class InFlight(msgspec.Struct):
    """A whole flight by `fly`, between take-off and landing.

    Attributes:
        app: per cent of a core, the deadman included.
        alone: of MAVSDK alone at the same rates, at the same time.
        seconds: how long it was.
    """

    app: float
    alone: float
    seconds: float


def in_flight() -> InFlight:
    """What `fly` takes for the dual collision with a simulated vehicle, and MAVSDK alone with another.

    At the same time: what the machine has to give wanders from minute to minute by a third.

    Raises:
        RuntimeError: the flight did not complete.
    """
    with _vehicle() as url, _vehicle() as other, tempfile.TemporaryDirectory() as folder:
        port = other.rpartition(":")[2]
        watching = [sys.executable, "-m", "tools.bench.share", "--client", WATCHING_ALL, port, "0"]
        flying = [sys.executable, "-m", "dart_flight", "fly", str(DUAL), "--driver", "px4", "--yes"]
        flying += ["--connection", url, "--log-dir", folder]
        at: dict[str, tuple[float, float, float]] = {}
        with subprocess.Popen(watching, **_QUIET) as alone_:
            time.sleep(_LEAD_S)
            with subprocess.Popen(flying, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as app:
                assert app.stdout is not None
                for line in app.stdout:  # "  12.34 s  phase  why"
                    phase = line.split()[2:3]
                    if phase and phase[0] in ("climb", "landing"):
                        spent = family_seconds(app.pid), process_seconds(alone_.pid)
                        at.setdefault(phase[0], (time.monotonic(), *spent))
            alone_.terminate()
    if app.returncode or len(at) != 2:
        raise RuntimeError("the flight did not complete")
    seconds, app_s, alone_s = (after - before for before, after in zip(*at.values(), strict=True))
    return InFlight(100.0 * app_s / seconds, 100.0 * alone_s / seconds, seconds)


@contextmanager
def _vehicle() -> Iterator[str]:
    port = free_udp_port()
    command = [sys.executable, "-m", "dart_flight", "simulate", str(DUAL), "--port", str(port)]
    with subprocess.Popen(command, **_QUIET) as vehicle:
        try:
            yield f"udpin://127.0.0.1:{port}"
        finally:
            vehicle.terminate()


def _share_of(command: list[str], seconds: float) -> float:
    """Per cent of a core that a process takes once it runs."""
    with subprocess.Popen(command, **_QUIET) as process:
        time.sleep(_LEAD_S)
        before, began = process_seconds(process.pid), time.monotonic()
        time.sleep(seconds)
        share = 100.0 * (process_seconds(process.pid) - before) / (time.monotonic() - began)
        process.terminate()
    return share


def watching_shares(seconds: float) -> Shares:
    """`monitor`, and MAVSDK alone at its rates, in turn beside a simulated vehicle; without their start."""
    return {client: _watching(client, seconds) for client in (WATCHING, MONITOR)}


def _watching(client: str, seconds: float) -> float:
    with _vehicle() as url:
        if client == MONITOR:
            return _share_of([sys.executable, "-m", "dart_flight", "monitor", "--connection", url], seconds)
        port = url.rpartition(":")[2]
        return _share_of([sys.executable, "-m", "tools.bench.share", "--client", client, port, "0"], seconds)


# --- taking turns ------------------------------------------------------------------------------------------


@contextmanager
def both_cores_busy() -> Iterator[None]:
    """Other work on every core, at ordinary priority."""
    command = [sys.executable, "-c", "while True: pass"]
    spinning = [subprocess.Popen(command) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for process in spinning:
            process.kill()
            process.wait()


def _one(client: str, seconds: float) -> Shares:
    """Run source and client, each a process."""
    port = str(free_udp_port())
    impacts = round((seconds + 4.0) / _PERIOD_S)
    source = [sys.executable, "-m", "tools.bench.impact_source", port, str(impacts), str(_PERIOD_S)]
    source += [str(_FAR_M)] if client == FAR else []
    command = [sys.executable, "-m", "tools.bench.share", "--client", client, port, str(seconds)]
    with subprocess.Popen(source, stdout=subprocess.DEVNULL) as sending:
        try:
            done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
        finally:
            sending.kill()
    return msgspec.json.decode(done.stdout.splitlines()[-1], type=Shares)


def measure(seconds: float, rounds: int) -> dict[str, Shares]:
    """Medians over the rounds: client -> part -> per cent of a core."""
    found: dict[str, list[Shares]] = {client: [] for client in CLIENTS}
    for _ in range(rounds):
        for client, shares in found.items():
            shares.append(_one(client, seconds))
    return {
        client: {part: median(s.get(part, 0.0) for s in shares) for part in shares[0]}
        for client, shares in found.items()
    }


def rows(seconds: float = SECONDS, rounds: int = 1) -> list[dict[str, Any]]:
    """Rows for the benchmark table: share of a core above MAVSDK alone, and of it each part."""
    found = measure(seconds, rounds)
    floor = sum(found["MAVSDK alone"].values())
    whole = found["app"]
    out = [
        _row("share of a core, MAVSDK alone", floor, None),
        _row("share of a core, app", sum(whole.values()), floor),
        _row("app above MAVSDK alone", sum(whole.values()) - floor, None),
        _row("of it records", sum(found["samples"].values()) - floor, None),
    ]
    return out + [_row(f"of it {part}", share, None) for part, share in whole.items() if part != MAVSDK]


def _row(name: str, value: float, baseline: float | None) -> dict[str, Any]:
    ratio = None if baseline is None else baseline / value
    return {"name": name, "value": value, "unit": "%", "baseline": baseline, "ratio": ratio}


def main() -> int:
    """Measure and print; `--client` is the process of one client."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--busy", action="store_true", help="other work on both cores, this at nice -15")
    parser.add_argument("--monitor", action="store_true", help="`monitor` instead, and its floor")
    parser.add_argument("--flight", action="store_true", help="a whole flight by `fly`, and its floor")
    parser.add_argument("--client", nargs=3, metavar=("NAME", "PORT", "SECONDS"))
    options = parser.parse_args()
    if options.client:
        name, port, seconds = options.client
        stay = {**CLIENTS, **STAYING}[name]
        shares = asyncio.run(stay(rigid_mission(), f"udpin://127.0.0.1:{port}", float(seconds)))
        print(msgspec.json.encode(shares).decode())
        return 0
    if options.monitor:
        turns = [watching_shares(options.seconds) for _ in range(options.rounds)]
        for client in turns[0]:
            found_here = sorted(shares[client] for shares in turns)
            low, high = found_here[0], found_here[-1]
            print(f"{client}: {median(found_here):.1f} % of a core ({low:.1f} to {high:.1f})")
        return 0
    if options.flight:
        for _ in range(options.rounds):
            one = in_flight()
            added = one.app - one.alone
            both = f"fly {one.app:.1f} % of a core, MAVSDK alone {one.alone:.1f}: {added:+.1f}"
            print(f"{both}, over {one.seconds:.1f} s of flight")
        return 0
    if options.busy:
        with both_cores_busy():
            os.setpriority(os.PRIO_PROCESS, 0, -15)
            found = measure(options.seconds, options.rounds)
    else:
        found = measure(options.seconds, options.rounds)
    table = Table(title=f"per cent of a core, median of {options.rounds} x {options.seconds:g} s")
    parts = list(dict.fromkeys(part for shares in found.values() for part in shares))
    for column in ("", *found):
        table.add_column(column)
    for part in [*parts, "all"]:
        values = (
            sum(shares.values()) if part == "all" else shares.get(part, 0.0) for shares in found.values()
        )
        table.add_row(part, *(f"{value:.1f}" for value in values))
    Console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
