"""Benchmark of a flight's share of a core at 250 Hz, by part, compared with MAVSDK alone at the same rates.

    python -m tools.bench.share [--seconds S] [--rounds N]

Each client is a separate process that receives from `impact_source` (a contact every three seconds), and the
clients take turns. The parts are threads, with the processor time that Linux counts for each. Threads that
neither Python nor the app started belong to MAVSDK. MAVSDK's callbacks build the records. The deadman is a
separate process. The figures are in docs/results/processor_time.md.
"""

from __future__ import annotations

import argparse
import asyncio
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import msgspec

from dart_flight.base.records import World
from dart_flight.config.mission import Mission
from dart_flight.run.app import AppOptions, FlightApp
from dart_flight.run.flight_record import FlightRecord
from dart_flight.vehicle.vehicle_session import connect
from tools.bench import alone
from tools.bench.impact_source import free_udp_port
from tools.bench.latency import RepeatingCore, rigid_mission
from tools.bench.processor import process_seconds, thread_seconds

SECONDS, ROUNDS = 20.0, 3
_PERIOD_S = 3.0
_LEAD_S = 8.0  # time for connection, rates and start of the app
MAVSDK = "MAVSDK and its callbacks"
Shares = dict[str, float]  # part -> per cent of a core


def _thread_names() -> dict[int, str]:
    return {thread.native_id or 0: thread.name for thread in threading.enumerate()}


async def _measure(seconds: float, extra: Callable[[], Shares] = dict) -> Shares:
    """Measure the shares of this process's threads for `seconds`; `extra` adds seconds of other processes."""
    names, before, began, others = _thread_names(), thread_seconds(), time.monotonic(), extra()
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
    """Measure MAVSDK with the same subscriptions and rates, but empty callbacks."""
    ended = asyncio.Event()
    staying = asyncio.create_task(alone.keep_connected(mission, url, ended))
    await asyncio.sleep(_LEAD_S)
    shares = await _measure(seconds)
    ended.set()
    await staying
    return shares


async def samples_only(mission: Mission, url: str, seconds: float) -> Shares:
    """Measure the app's own callbacks, with their records dropped."""
    async with connect(url, mission.vehicle.connection.timeout_s, _drop) as session:
        session.subscribe(mission.vehicle.estimation, len(mission.vehicle.airframe.motors))
        await session.set_rates()
        await asyncio.sleep(_LEAD_S)
        return await _measure(seconds)


def _drop(_: object) -> None:
    """Drop a record."""


async def whole_app(mission: Mission, url: str, seconds: float) -> Shares:
    """Measure the parts of the app in a flight: link, core, lock, log, deadman and terminal."""
    with tempfile.TemporaryDirectory() as folder:
        record = FlightRecord(mission, World.EMBEDDED, None, Path(folder))
        app = FlightApp(mission, url, record, AppOptions(deadman_note=Path(folder) / "deadman.txt"))
        core = RepeatingCore(mission, 1)
        app.shell.core = core
        flying = asyncio.create_task(app.run())
        await asyncio.sleep(_LEAD_S)
        shares = await _measure(seconds, lambda: {"deadman (process)": _process_seconds(app)})
        app._done.set()
        await flying
        record.close()
        if not core.recoveries:
            raise RuntimeError("no impact was answered")
    return shares


def _process_seconds(app: FlightApp) -> float:
    return 0.0 if app._deadman is None else process_seconds(app._deadman.pid)


CLIENTS = {"MAVSDK alone": mavsdk_alone, "samples": samples_only, "app": whole_app}


# --- taking turns ------------------------------------------------------------------------------------------


def _run_client(client: str, seconds: float) -> Shares:
    """Run source and client in one process each."""
    port = str(free_udp_port())
    impacts = round((seconds + 4.0) / _PERIOD_S)
    source = [sys.executable, "-m", "tools.bench.impact_source", port, str(impacts), str(_PERIOD_S)]
    command = [sys.executable, "-m", "tools.bench.share", "--client", client, port, str(seconds)]
    with subprocess.Popen(source, stdout=subprocess.DEVNULL) as sending:
        try:
            done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
        finally:
            sending.kill()
    return msgspec.json.decode(done.stdout.splitlines()[-1], type=Shares)


def measure(seconds: float, rounds: int) -> dict[str, Shares]:
    """Return medians over the rounds: client -> part -> per cent of a core."""
    found: dict[str, list[Shares]] = {client: [] for client in CLIENTS}
    for _ in range(rounds):
        for client, shares in found.items():
            shares.append(_run_client(client, seconds))
    return {
        client: {part: median(s.get(part, 0.0) for s in shares) for part in shares[0]}
        for client, shares in found.items()
    }


def rows(seconds: float = SECONDS, rounds: int = 1) -> list[dict[str, Any]]:
    """Return rows for the benchmark table: the share of a core above MAVSDK alone, and its parts."""
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
    """Measure and print; `--client` runs one client in this process."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--client", nargs=3, metavar=("NAME", "PORT", "SECONDS"))
    options = parser.parse_args()
    if options.client:
        name, port, seconds = options.client
        shares = asyncio.run(CLIENTS[name](rigid_mission(), f"udpin://127.0.0.1:{port}", float(seconds)))
        print(msgspec.json.encode(shares).decode())
        return 0
    for row in rows(options.seconds, options.rounds):
        print(f"{row['name']:36s} {row['value']:6.1f} {row['unit']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
