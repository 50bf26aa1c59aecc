"""Benchmark of the latency from an IMU sample to the recovery setpoint, both on the wire, through MAVSDK and
UDP.

The whole app runs (MAVSDK, core thread, lock thread, log) at the rates of the stream table against
`impact_source`, which is a separate process. The latency begins when the source sends the IMU sample that
completes the detection of a force peak, and ends when the source receives the resulting setpoint.

    python -m tools.bench.latency [IMPACTS]
"""

from __future__ import annotations

import asyncio
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from dart_flight.base.records import (
    Input,
    LockPhase,
    LockState,
    Mode,
    Output,
    Override,
    Phase,
    Setpoint,
    SetpointSent,
    VehicleCommand,
    World,
)
from dart_flight.config.mission import Mission, load_mission
from dart_flight.core.flight_core import FlightCore
from dart_flight.core.guard.guard import Guard
from dart_flight.core.pace import Pace
from dart_flight.run.app import AppOptions, FlightApp
from dart_flight.run.flight_record import FlightRecord
from tools.bench.impact_source import MISSION, Record, free_udp_port

IMPACTS = 500
PERIOD_S = 0.3  # longer than the contact (46 ms), the detection of its end and the refractory time together
_MATCH_M = 1e-3  # tolerance for matching a setpoint on the wire with a setpoint of the core
_LONGEST_NS = 100_000_000


class RepeatingCore:
    """A core that returns to its approach 0.2 s after every impact.

    Args:
        mission: mission of one collision.
        impacts: number of impacts; after their recoveries the source falls silent, and the guard is ignored.
    """

    def __init__(self, mission: Mission, impacts: int) -> None:
        self._mission, self._core = mission, FlightCore(mission)  # a compiled class cannot be subclassed
        self.recoveries: list[Setpoint] = []
        self.overruled: list[str] = []  # reasons why the guard acted, such as a stall of the machine
        self._impacts = impacts
        self._restart_us = 0
        self._begun = False

    @property
    def pace(self) -> Pace:
        """The pace of the core."""
        return self._core.pace

    def step(self, item: Input) -> list[Output]:
        """Step the core, and restart its approach after a recovery."""
        core = self._core
        if isinstance(item, LockState):
            item = LockState(item.t_us, LockPhase.SETTLED, Mode.RIGID)
        progress, now = core._executive.progress, core.state.now_us
        if core.override is not Override.NONE:
            if len(self.recoveries) < self._impacts:
                self.overruled.append(core._guard.reason or "")
            core._guard = Guard(self._mission)
            self._begun = False
        status = core.state.status
        ready = core.state.odometry is not None and status.armed and status.local_position_ok
        rested = progress.phase is Phase.RECOVERY and now > self._restart_us
        if rested or (not self._begun and ready):
            self._begin(now)
        elif not self._begun:
            progress.phase = Phase.READYING
            core.state.lock = LockState(now, LockPhase.SETTLED, Mode.RIGID)
        elif progress.phase is Phase.APPROACH and now - (progress.entered_us or 0) > 1_000_000:
            progress.entered_us = now
        outputs = core.step(item)
        for output in outputs:
            if isinstance(output, Setpoint) and output.recovery:
                self.recoveries.append(output)
                self._restart_us = output.t_us + 200_000
        # The guard is reset above, so drop its commands: the source stays in offboard mode.
        return [output for output in outputs if not isinstance(output, VehicleCommand)]

    def _begin(self, now_us: int) -> None:
        state, executive, self._begun = self._core.state, self._core._executive, True
        state.anchor(self._mission.frame_at((0.0, 0.0, 0.0)))  # the source starts in the air
        progress = executive.progress
        progress.phase, progress.index, progress.entered_us = Phase.APPROACH, 0, now_us
        executive._begin_approach(self._mission.collisions[0])


class Result(msgspec.Struct):
    """The latencies per impact on the wire and inside the program, milliseconds."""

    wire_ms: list[float]
    inside_ms: list[float]
    expected: int
    overruled: list[str]
    cpu_percent: float
    poses_sent: int


class _AppRun(NamedTuple):
    """The app's part of a result: its core, the latencies that it measures itself, and its load."""

    core: RepeatingCore
    inside_ms: list[float]
    cpu_percent: float
    poses_sent: int


def rigid_mission(mocap_url: str | None = None) -> Mission:
    """Return the single-wall mission in rigid mode, with a pose source."""
    mission = load_mission(MISSION)
    first = msgspec.structs.replace(mission.collisions[0], mode=Mode.RIGID)
    mocap = msgspec.structs.replace(mission.vehicle.mocap, url=mocap_url)
    vehicle = msgspec.structs.replace(mission.vehicle, mocap=mocap)
    return msgspec.structs.replace(mission, collisions=(first,), vehicle=vehicle)


def measure(impacts: int = IMPACTS, mocap_url: str | None = None) -> Result:
    """Run source and app, which takes about 0.3 s per impact, and return the result.

    Args:
        impacts: number of impacts.
        mocap_url: source whose poses the app forwards, or None.
    """
    port = free_udp_port()
    command = [sys.executable, "-m", "tools.bench.impact_source", str(port), str(impacts), str(PERIOD_S)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as source, tempfile.TemporaryDirectory() as folder:
        app = asyncio.run(_run_app(port, Path(folder), source, impacts, mocap_url))
        assert source.stdout is not None
        record = msgspec.json.decode(source.stdout.readline(), type=Record)
    core = app.core
    return Result(
        _match(core.recoveries, record),
        app.inside_ms,
        impacts,
        core.overruled,
        app.cpu_percent,
        app.poses_sent,
    )


async def _run_app(
    port: int, folder: Path, source: subprocess.Popen[bytes], impacts: int, mocap_url: str | None
) -> _AppRun:
    mission = rigid_mission(mocap_url)
    record = FlightRecord(mission, World.EMBEDDED, None, folder)
    inside: list[float] = []

    def progress(record: object) -> None:
        if isinstance(record, SetpointSent):
            inside.append(record.latency_us * 1e-3)

    app = FlightApp(mission, f"udpin://127.0.0.1:{port}", record, AppOptions(progress))
    core = RepeatingCore(mission, impacts)
    app.shell.core = core
    flying = asyncio.create_task(app.run())
    # The core is stepped on another thread, so poll it.
    while not core.recoveries and not flying.done():  # noqa: ASYNC110
        await asyncio.sleep(0.1)
    wall, busy = time.monotonic(), time.process_time()
    # The source writes only at its end, so waiting for output cannot block it.
    await asyncio.to_thread(_wait_for_output, source)
    cpu = 100.0 * (time.process_time() - busy) / (time.monotonic() - wall)
    app._done.set()
    # The source stays armed, and the app forwards poses to an armed vehicle until Ctrl-C.
    while not flying.done():
        app._stopped.set()
        await asyncio.sleep(0.1)
    await flying
    record.close()
    return _AppRun(core, inside, cpu, app._bridge.sent if app._bridge is not None else 0)


def _wait_for_output(source: subprocess.Popen[bytes]) -> None:
    assert source.stdout is not None
    source.stdout.peek(1)  # type: ignore[attr-defined]


def _match(recoveries: list[Setpoint], record: Record) -> list[float]:
    sent = dict(record.imu)
    latencies = []
    for output in recoveries:
        begin = sent.get(output.t_us)
        if begin is None:
            continue
        n, e, d = output.position_ned
        for received, x, y, z in record.setpoints:
            if not begin < received < begin + _LONGEST_NS:
                continue
            if abs(x - n) < _MATCH_M and abs(y - e) < _MATCH_M and abs(z - d) < _MATCH_M:
                latencies.append((received - begin) * 1e-6)
                break
    return sorted(latencies)


def percentile(values: list[float], share: float) -> float:
    """Return the percentile `share` (0 to 1) of the values."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, round(share * (len(ordered) - 1)))]


def histogram(values: list[float]) -> str:
    """Return the counts per latency class as text."""
    edges = [0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 16.0, 100.0]
    lines, low = [], 0.0
    for edge in edges:
        count = sum(low <= v < edge for v in values)
        lines.append(f"{low:6.2f} to {edge:6.2f} ms {count:4d} {'#' * round(60 * count / len(values))}")
        low = edge
    return "\n".join(lines)


def rows(impacts: int = IMPACTS) -> list[dict[str, Any]]:
    """Return rows for the benchmark table.

    Raises:
        RuntimeError: no impact was answered.
    """
    result = measure(impacts)
    found = result.wire_ms
    if not found:
        raise RuntimeError(
            f"none of {impacts} impacts was answered; the guard reported: {result.overruled[:3]}"
        )
    print(f"{len(found)} of {result.expected} impacts answered, setpoint for IMU sample, both on the wire:")
    print(histogram(found))
    if result.overruled:
        print(
            f"the guard took over {len(result.overruled)} times and was reset: "
            + "; ".join(sorted(set(result.overruled)))
        )
    values = (
        ("latency impact to set-point p50", percentile(found, 0.5), "ms"),
        ("latency impact to set-point p99", percentile(found, 0.99), "ms"),
        ("latency receipt to set-point p50", percentile(result.inside_ms, 0.5), "ms"),
        ("latency receipt to set-point p99", percentile(result.inside_ms, 0.99), "ms"),
        ("impacts unanswered", float(result.expected - len(found)), ""),
        ("app share of a core at 250 Hz", result.cpu_percent, "%"),
    )
    return [
        {"name": name, "value": v, "unit": unit, "baseline": None, "ratio": None} for name, v, unit in values
    ]


if __name__ == "__main__":
    for row in rows(int(sys.argv[1]) if len(sys.argv) > 1 else IMPACTS):
        print(row)
