"""Flights whose program hangs or dies, with the setpoints recorded on the wire by a proxy."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.doubles.ports import free_udp_port
from tests.real_time import LATENESS_RULES, TooSlow, run_within

ROOT = Path(__file__).parents[2]
FAULTS = ("hang-core", "hang-loop", "hang-lock", "sigstop", "sigkill")
_NEAR = str(ROOT / "tests/data/near_wall.yaml")
_SET_POSITION_TARGET = 84  # MAVLink


@contextmanager
def vehicle_behind_proxy(record: Path) -> Iterator[str]:
    """Run a simulated vehicle and a recording proxy, and yield the URL for the app."""
    near, far = free_udp_port(), free_udp_port()
    proxy = subprocess.Popen(
        [
            *(sys.executable, "-m", "tools.lossy_proxy"),
            *("--listen", str(far), "--to", str(near), "--record", str(record)),
        ],
        cwd=ROOT,
    )
    vehicle = subprocess.Popen(
        [sys.executable, "-m", "dart_flight", "simulate", _NEAR, "--port", str(far)],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield f"udpin://127.0.0.1:{near}"
    finally:
        for process in (vehicle, proxy):
            process.terminate()
            process.wait(10)


def last_setpoint_s(fault: str, folder: Path) -> float:
    """Fly with a fault of the program at the approach, and return the time of the last setpoint after it.

    Raises:
        AssertionError: the flight did not end by SIGKILL.
        TooSlow: the computer ended the flight before the fault.
    """
    record = folder / "wire.csv"
    with vehicle_behind_proxy(record) as url:
        program = [sys.executable, str(Path(__file__).with_name("sabotaged_flight.py"))]
        fly = [*program, _NEAR, url, str(folder), f"{fault}@approach"]
        flight = run_within(60.0, fly, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)})
        time.sleep(1.0)  # record a sender that has survived
    if flight.returncode != -signal.SIGKILL and (late := re.search("|".join(LATENESS_RULES), flight.stderr)):
        raise TooSlow(f"the flight ended before the fault: {late[0]}")
    assert flight.returncode == -signal.SIGKILL, flight.stderr
    assert fault == "sigkill" or "deadman:" in flight.stderr
    at = re.search(r"at monotonic ([0-9.]+) s", flight.stderr)
    assert at is not None, flight.stderr
    passed = (line.split(",") for line in record.read_text().splitlines())
    times = [
        float(t) for t, direction, kind in passed if direction == "up" and int(kind) == _SET_POSITION_TARGET
    ]
    assert len(times) > 100, "the vehicle did not fly: a flight sends 20 to 125 setpoints a second"
    return max(times) - float(at[1])
