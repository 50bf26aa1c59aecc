"""A flight on a connection URL that breaks itself: sabotaged_flight.py MISSION URL LOG_DIR FAULT

Run by `test_deadman.py` in a process of its own, because that process does not survive.
"""

import sys
from pathlib import Path

from dart_flight.config.vehicle import LockDriver
from dart_flight.sim.faults.kinds import parse_fault
from dart_flight.worlds.flights import fly_vehicle, load_flyable, with_driver
from dart_flight.worlds.sabotage import Sabotage

mission, url, log_dir, fault = sys.argv[1:]
fly_vehicle(
    with_driver(load_flyable(mission), LockDriver.PX4),
    url,
    Path(log_dir),
    sabotage=Sabotage(parse_fault(fault), None, None),
)
