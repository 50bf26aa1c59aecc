"""Campaign: what ten viewers of the live view cost a flight's setpoints, in alternating pairs of flights.

    python -m tools.campaigns.viewers [--pairs N]

Every flight is a `dry-run` of the single wall in the embedded world, in a process of its own; the second of a
pair, in every other pair the first, is flown with `--live` and ten viewers: seven read all that comes, three
subscribe to everything and never read. Measured is every setpoint from approach to goal: the time from the
receipt of the sample that led to it until it has left the program. A pair counts by the difference of its two
99th percentiles; the one-sided 95 % bound of the mean difference (Student) must not exceed 0.5 ms.

Viewers are meant to be on another machine: here they share a process of Linux's idle class. The figures mean
something where nothing else runs.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import os
import socket
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import mean, median, quantiles, stdev

import msgspec
from rich.console import Console
from rich.table import Table
from scipy.stats import t as student
from websockets.asyncio.client import connect
from websockets.exceptions import WebSocketException
from websockets.typing import Subprotocol

from dart_flight.base.processes import stand_back
from dart_flight.base.records import SetPoint
from dart_flight.cli import main as dart_flight
from dart_flight.config.vehicle import packaged
from dart_flight.run.app import FlightApp
from dart_flight.vehicle.clock import host_us

PAIRS = 10
VIEWERS, STALLED = 10, 3
MOST_MS = 0.5
_FLIGHT_S = 180.0
_STALLED_QUEUE = 1  # frames that a viewer's library takes before it stops reading from its socket


class Flown(msgspec.Struct):
    """What a flight with or without viewers has left.

    Attributes:
        latencies_ms: of every setpoint.
        messages: that the reading viewers got, all together.
        left_out: what the live view said of records that it had no room for.
    """

    latencies_ms: list[float]
    messages: int = 0
    left_out: str = ""

    @property
    def percentile_99(self) -> float:
        """Of the latencies, ms."""
        return quantiles(self.latencies_ms, n=100)[98]


# --- the processes ----------------------------------------------------------------------------------------


def fly(folder: Path, port: int | None) -> int:
    """The flight's process: `dry-run` as it is, with a clock at the door by which setpoints leave."""
    latencies: list[float] = []
    send = FlightApp.send

    def timed(app: FlightApp, setpoint: SetPoint) -> None:
        send(app, setpoint)
        latencies.append((host_us() - setpoint.trigger_received_us) * 1e-3)

    FlightApp.send = timed  # type: ignore[method-assign,assignment]
    command = [
        "dry-run",
        str(packaged("missions", "paper_single_wall.yaml")),
        "--json",
        "--log-dir",
        str(folder),
    ]
    if port is not None:
        command += ["--live", "--live-port", str(port)]
    status = dart_flight(command)
    (folder / "latencies.json").write_bytes(msgspec.json.encode(latencies))
    return status


async def look(port: int) -> int:
    """The viewers' process: messages that the readers got until the server went."""
    stand_back()
    stalled = [asyncio.create_task(_view(port, stalled=True)) for _ in range(STALLED)]
    counts = await asyncio.gather(*(_view(port, stalled=False) for _ in range(VIEWERS - STALLED)))
    for task in stalled:
        task.cancel()
    return sum(counts)


async def _view(port: int, *, stalled: bool) -> int:
    count = 0
    subprotocols = [Subprotocol("foxglove.sdk.v1")]
    queue = _STALLED_QUEUE if stalled else None
    async with connect(
        f"ws://127.0.0.1:{port}",
        subprotocols=subprotocols,
        max_size=None,
        max_queue=queue,
        ping_interval=None,
    ) as server:
        try:
            async for frame in server:
                count += 1
                if not isinstance(frame, str):
                    continue
                message = json.loads(frame)
                if message["op"] == "advertise":
                    wanted = [{"id": c["id"], "channelId": c["id"]} for c in message["channels"]]
                    await server.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
                    if stalled:
                        await asyncio.sleep(_FLIGHT_S)
        except WebSocketException:
            pass
    return count


# --- pairs ------------------------------------------------------------------------------------------------


def one_flight(watched: bool) -> Flown:
    """Fly once.

    Raises:
        RuntimeError: it does not complete.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        environment = {**os.environ, "DART_FLIGHT_STATE_DIR": str(folder / "state")}
        program = [sys.executable, "-m", "tools.campaigns.viewers"]
        port = _free_port() if watched else None
        options = ["--fly", name] + ([] if port is None else ["--port", str(port)])
        pipe = subprocess.PIPE
        viewers = None
        with subprocess.Popen(
            [*program, *options], env=environment, stdout=pipe, stderr=pipe, text=True
        ) as flight:
            assert flight.stderr is not None
            said = []
            for line in flight.stderr:
                said.append(line.strip())
                if line.startswith("live: ") and viewers is None:
                    viewers = subprocess.Popen(
                        [*program, "--look", "--port", str(port)], stdout=pipe, stderr=pipe, text=True
                    )
            flight.wait(_FLIGHT_S)
        seen = "0" if viewers is None else _count(viewers)
        if flight.returncode != 0:
            raise RuntimeError(f"a flight did not complete: {said[-1] if said else flight.returncode}")
        latencies = msgspec.json.decode((folder / "latencies.json").read_bytes(), type=list[float])
        left_out = next((line for line in said if "left out" in line), "")
        return Flown(latencies, int(seen), left_out)


def _count(viewers: subprocess.Popen[str]) -> str:
    try:
        return viewers.communicate(timeout=10.0)[0].strip() or "0"
    except subprocess.TimeoutExpired:
        viewers.kill()
        viewers.communicate()
        return "0"


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port


def upper_bound_ms(differences: list[float]) -> float:
    """One-sided 95 % bound of the mean difference."""
    n = len(differences)
    quantile = float(student.ppf(0.95, n - 1))
    return mean(differences) + quantile * stdev(differences) / math.sqrt(n)


def campaign(pairs: int) -> int:
    """Fly the pairs, print the table; 1 where the bound is above what is allowed."""
    console = Console()
    flown: dict[bool, list[Flown]] = {False: [], True: []}
    for i in range(pairs):
        for watched in (False, True) if i % 2 == 0 else (True, False):
            flown[watched].append(one_flight(watched))
        console.print(
            f"pair {i + 1}: p99 {flown[False][-1].percentile_99:.3f} ms alone, "
            f"{flown[True][-1].percentile_99:.3f} ms watched, {flown[True][-1].messages} messages"
        )
    table = Table(title=f"{pairs} pairs, ms; load average {os.getloadavg()[0]:.1f}")
    for name in ("", "alone", "ten viewers"):
        table.add_column(name)
    table.add_row("median", *(f"{median(x for f in flown[w] for x in f.latencies_ms):.3f}" for w in flown))
    table.add_row(
        "p99, median of flights", *(f"{median(f.percentile_99 for f in flown[w]):.3f}" for w in flown)
    )
    table.add_row("longest", *(f"{max(x for f in flown[w] for x in f.latencies_ms):.3f}" for w in flown))
    console.print(table)
    for one in flown[True]:
        if one.left_out:
            console.print(one.left_out)
    differences = [b.percentile_99 - a.percentile_99 for a, b in zip(flown[False], flown[True], strict=True)]
    bound = upper_bound_ms(differences)
    console.print(f"change of p99: mean {mean(differences):+.3f} ms, upper 95 % bound {bound:+.3f} ms")
    return 0 if bound <= MOST_MS else 1


def main() -> int:
    """As campaign, or as one of its processes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--pairs", type=int, default=PAIRS)
    parser.add_argument("--fly", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--look", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.fly is not None:
        return fly(arguments.fly, arguments.port)
    if arguments.look:
        sys.stdout.write(f"{asyncio.run(look(arguments.port))}\n")
        return 0
    return campaign(arguments.pairs)


if __name__ == "__main__":
    sys.exit(main())
