"""MAVSDK's callback thread keeps its thread-local data: real MAVSDK against the embedded autopilot."""

from __future__ import annotations

import asyncio
import sys
import threading

import pytest

from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.vehicle.vehicle_session import connect
from tests.flights.test_embedded_flights import simulated_vehicle
from tests.real_time import limited, run_within

MISSION = str(packaged("missions", "paper_single_wall.yaml"))
_WAIT_S, _ENOUGH = 20.0, 100


@pytest.mark.realtime
@pytest.mark.mavlink
def test_thread_local_data_persists_between_callbacks() -> None:
    """If the interpreter forgot the thread between two callbacks, the count would restart at one."""
    thread_data = threading.local()
    counts: dict[int, int] = {}

    async def listen(url: str) -> None:
        vehicle = load_mission(MISSION).vehicle
        loop, enough = asyncio.get_running_loop(), asyncio.Event()

        def deliver(_: object) -> None:
            thread_data.count = getattr(thread_data, "count", 0) + 1
            counts[threading.get_ident()] = thread_data.count
            if thread_data.count == _ENOUGH:
                loop.call_soon_threadsafe(enough.set)

        async with connect(url, _WAIT_S, deliver) as session:
            session.subscribe(vehicle.estimation, len(vehicle.airframe.motors))
            with limited("a hundred callbacks"):
                await asyncio.wait_for(enough.wait(), _WAIT_S)

    with simulated_vehicle(MISSION) as url:
        for _ in range(2):  # a second connection has a thread of its own
            counts.clear()
            asyncio.run(listen(url))
            assert max(counts.values()) >= _ENOUGH


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
    with simulated_vehicle(MISSION) as url:
        done = run_within(60.0, [sys.executable, "-c", BLOCKED, MISSION, url])
    assert done.stdout == "verdict\n", done.stderr
    assert done.returncode in (3, -14)
