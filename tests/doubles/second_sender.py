"""A second, disarmed vehicle that sends to the UDP port of another vehicle.

python -m tests.doubles.second_sender PORT SYSTEM AHEAD_S

Its clock is AHEAD_S ahead of that of a simultaneously started `simulate`. It sends until it is stopped.
"""

from __future__ import annotations

import sys
from pathlib import Path

from dart_flight.run.prepare import load_flyable
from dart_flight.sim.faults.twin import make_second_vehicle
from dart_flight.sim.mavlink_endpoint import MavlinkEndpoint
from dart_flight.sim.served_world import ticks_in_real_time

MISSION = Path(__file__).parents[2] / "missions" / "paper_single_wall.yaml"


def main() -> None:
    port, system, ahead_s = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
    vehicle = make_second_vehicle(load_flyable(MISSION), 1, ahead_s, 7_000_000)
    endpoint = MavlinkEndpoint(vehicle.autopilot, (port,), system=system)
    for _ in ticks_in_real_time():
        vehicle.advance()
        endpoint.exchange()


if __name__ == "__main__":
    main()
