"""A simulated vehicle that forwards messages between the companion computer and a ground station.

python -m tests.doubles.forwarding_vehicle MISSION CONFIG PORT GROUND_PORT
"""

from __future__ import annotations

import sys

from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import LockDriver
from dart_flight.sim.simulated_vehicle import SimulatedVehicle
from dart_flight.sim.standalone import run_vehicle


def main() -> None:
    mission, config, port, ground_port = sys.argv[1:]
    vehicle = SimulatedVehicle(load_mission(mission, config), 1, LockDriver.PX4)
    run_vehicle(vehicle, (int(port), int(ground_port)), lambda line: print(line, flush=True))


if __name__ == "__main__":
    main()
