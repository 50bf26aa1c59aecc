"""Hardware-in-the-loop flights by the command, against a PX4 without lockstep on pseudo-terminals.

The app's link is limited to the rate of 921600 baud, and the servo is behind an emulated Maestro. A flight is
also uncontrolled if PX4 stays armed, if it reports no cause, or if it prints a traceback.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import msgspec

from dart_flight.base.records import TruthSample
from dart_flight.recording.reader import read_log
from dart_flight.recording.uncontrolled import TruthExtremes, find_uncontrolled
from dart_flight.run.prepare import load_flyable
from tests.doubles.emulated_maestro import EmulatedMaestro
from tests.doubles.hitl_px4 import ENVIRONMENT, HitlPx4

ROOT = Path(__file__).parents[2]
_NO_REMOTE = {"COM_RC_IN_MODE": 4, "NAV_DLL_ACT": 0}  # no sticks and no ground station
_LIMIT_S = 240.0  # for a command; a flight takes 40 s


class BenchFlight(msgspec.Struct):
    """The figures of one flight."""

    outcome: str
    reason: str | None = None
    tilt_deg: float | None = None  # largest true tilt
    ekf_m: float | None = None
    lost_bytes: list[int] = []  # USB and TELEM2, to PX4 and back
    problems: list[str] = []


def fly_bench(name: str, seed: int, cut_usb_s: float = 0.0) -> BenchFlight:
    """Fly in hardware in the loop, with the USB cable cut for `cut_usb_s` when the approach begins."""
    mission = load_flyable(ROOT / "missions" / f"{name}.yaml")
    lock = mission.vehicle.lock
    assert lock is not None
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
        follower = threading.Thread(target=_follow, args=(process.stderr, lines, px4, cut_usb_s))
        follower.start()
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write("propellers off\n")
        process.stdin.close()
        guard = threading.Timer(_LIMIT_S, process.kill)
        guard.start()
        output = process.stdout.read()
        status = process.wait()
        guard.cancel()
        follower.join()
        lost = [*px4.usb.dropped[::-1], *px4.telem2.dropped[::-1]]
        flight = BenchFlight("no verdict", lost_bytes=lost)
        if px4.is_armed():
            flight.problems.append("left armed")
        return _figures(flight, name, output, status, "".join(lines), folder / "logs")


def _follow(stream: Iterator[str], lines: list[str], px4: HitlPx4, cut_usb_s: float) -> None:
    """Keep the messages of the command, and cut the cable at the first approach."""
    for line in stream:
        lines.append(line)
        if cut_usb_s and "→ APPROACH" in line:
            px4.usb.cut = True
            time.sleep(cut_usb_s)
            px4.usb.cut = False
            cut_usb_s = 0.0


def _figures(
    flight: BenchFlight, name: str, output: str, status: int, messages: str, logs: Path
) -> BenchFlight:
    if "Traceback" in messages:
        flight.problems.append("traceback")
    verdict = json.loads(output) if output.strip() else {}
    flight.outcome = verdict.get("outcome", flight.outcome)
    flight.reason = verdict.get("reason") or ("" if verdict else messages.strip().splitlines()[-1])
    flight.ekf_m = verdict.get("ekf_error_m")
    if (status == 0) is not (flight.outcome == "completed"):
        flight.problems.append(f"exit status {status}")
    if flight.outcome != "completed" and not flight.reason:
        flight.problems.append("no cause")
    for log in logs.rglob("flight.mcap"):
        truth = TruthExtremes(load_flyable(ROOT / "missions" / f"{name}.yaml").bounds)
        for entry in read_log(log).entries:
            if isinstance(entry.record, TruthSample):
                truth.update(entry.record)
        flight.tilt_deg = math.degrees(truth.tilt_rad)
        flight.problems += find_uncontrolled(truth, completed=True, explained=True)
    return flight
