"""The simulated vehicle for another program: no pipe, no truth, until it is stopped."""

from __future__ import annotations

import contextlib
import gc
import signal
from collections.abc import Callable

from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import LockDriver
from dart_flight.sim.mavlink_endpoint import MavlinkEndpoint
from dart_flight.sim.process import run_in_real_time
from dart_flight.sim.vehicle import SimulatedVehicle


def run_vehicle(mission: Mission, seed: int, ports: tuple[int, ...], say: Callable[[str], None]) -> None:
    """Simulate in real time until SIGINT or SIGTERM; `say` takes lines for the terminal."""
    vehicle = SimulatedVehicle(mission, seed, LockDriver.PX4)
    endpoint = MavlinkEndpoint(vehicle.autopilot, ports)
    to_link = vehicle.autopilot.say
    stopped: list[int] = []

    def tell(severity: str, text: str) -> None:
        to_link(severity, text)
        say(f"{vehicle.autopilot.now_s:8.2f} s  {text}")

    def step() -> None:
        vehicle.advance()
        endpoint.exchange()
        plant = vehicle.autopilot.plant
        while plant.finished:
            hit = plant.finished.pop(0)
            say(
                f"{vehicle.autopilot.now_s:8.2f} s  hit {hit.wall} {hit.mode.value} at "
                f"{hit.normal_in_m_s:.2f} m/s normal, {hit.tangential_in_m_s:.2f} m/s along: "
                f"{hit.peak_normal_force_n:.1f} N"
            )

    vehicle.autopilot.say = tell
    for number in (signal.SIGINT, signal.SIGTERM):
        with contextlib.suppress(ValueError):  # not the main thread
            signal.signal(number, lambda signum, _frame: stopped.append(signum))
    gc.freeze()
    run_in_real_time(step, lambda: bool(stopped))
    endpoint.close()
