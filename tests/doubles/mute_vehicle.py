"""A vehicle that sends as PX4 does but ignores every request, and falls silent after a while.

python -m tests.doubles.mute_vehicle PORT SILENT_AFTER_S
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from dart_flight.config.vehicle import LockDriver
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.served_world import ticks_in_real_time
from dart_flight.sim.simulated_vehicle import SimulatedVehicle
from tests.doubles.vehicle_peer import ANY, TableEndpoint

MISSION = Path(__file__).parents[2] / "missions" / "single_wall.yaml"


def main() -> None:
    port, silent_after_s = int(sys.argv[1]), float(sys.argv[2])
    vehicle = SimulatedVehicle(load_flyable(MISSION), 1, LockDriver.PX4)
    endpoint = TableEndpoint(vehicle.autopilot, (port,), {ANY: lambda message: []})
    end_s = time.monotonic() + silent_after_s
    for _ in ticks_in_real_time():
        vehicle.advance()
        endpoint.exchange()
        if time.monotonic() > end_s:
            break
    time.sleep(3600.0)


if __name__ == "__main__":
    main()
