"""MAVSDK's callback thread keeps its thread-local data: real MAVSDK against the embedded autopilot."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from dart_flight.config.mission import load_mission
from dart_flight.vehicle.vehicle_session import connect
from tests.doubles.ports import free_udp_port
from tests.real_time import limited, run_within

ROOT = Path(__file__).parents[2]
MISSION = ROOT / "missions" / "paper_single_wall.yaml"
_WAIT_S, _ENOUGH = 20.0, 100


@pytest.mark.realtime
@pytest.mark.mavlink
def test_thread_local_data_persists_between_callbacks() -> None:
    """If the interpreter forgot the thread between two callbacks, the count would restart at one."""
    port = free_udp_port()
    thread_data = threading.local()
    counts: dict[int, int] = {}

    async def listen() -> None:
        vehicle = load_mission(MISSION).vehicle
        loop, enough = asyncio.get_running_loop(), asyncio.Event()

        def deliver(_: object) -> None:
            thread_data.count = getattr(thread_data, "count", 0) + 1
            counts[threading.get_ident()] = thread_data.count
            if thread_data.count == _ENOUGH:
                loop.call_soon_threadsafe(enough.set)

        async with connect(f"udpin://127.0.0.1:{port}", _WAIT_S, deliver) as session:
            session.subscribe(vehicle.estimation, len(vehicle.airframe.motors))
            with limited("a hundred callbacks"):
                await asyncio.wait_for(enough.wait(), _WAIT_S)

    command = [sys.executable, "-m", "dart_flight", "simulate", str(MISSION), "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as simulator:
        try:
            for _ in range(2):  # a second connection has a thread of its own
                counts.clear()
                asyncio.run(listen())
                assert max(counts.values()) >= _ENOUGH
        finally:
            simulator.terminate()


BLOCKED = """
import asyncio, sys, threading
from dart_flight.base.processes import exit_within
from dart_flight.config.mission import load_mission
from dart_flight.vehicle.vehicle_session import connect

async def listen():
    vehicle = load_mission(sys.argv[1]).vehicle
    blocked = threading.Event()
    def deliver(_):
        blocked.set()
        threading.Event().wait()
    async with connect(sys.argv[2], 20.0, deliver) as session:
        session.subscribe(vehicle.estimation, len(vehicle.airframe.motors))
        while not blocked.is_set():
            await asyncio.sleep(0.05)

asyncio.run(listen())
print("verdict")
exit_within(3, 0.5)
"""


@pytest.mark.realtime
@pytest.mark.mavlink
def test_a_callback_that_never_returns_keeps_neither_the_verdict_nor_the_program() -> None:
    """MAVSDK waits for a running callback when it closes; without a limit the program stays for ever."""
    port = free_udp_port()
    command = [sys.executable, "-m", "dart_flight", "simulate", str(MISSION), "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as simulator:
        try:
            program = [sys.executable, "-c", BLOCKED, str(MISSION), f"udpin://127.0.0.1:{port}"]
            done = run_within(60.0, program)
        finally:
            simulator.terminate()
    assert done.stdout == "verdict\n", done.stderr
    assert done.returncode in (3, -14)
