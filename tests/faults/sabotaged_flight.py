"""A flight whose own program fails on purpose: sabotaged_flight.py MISSION URL LOG_DIR FAULT

`test_deadman.py` runs it in a separate process, because that process does not survive.
"""

import asyncio
import sys
from pathlib import Path

import msgspec

from dart_flight.base.records import World
from dart_flight.config.vehicle import LockDriver
from dart_flight.run.app import AppOptions, FlightApp
from dart_flight.run.embedded import DEADMAN_NOTE
from dart_flight.run.flight_record import FlightRecord
from dart_flight.run.prepare import load_flyable, with_driver
from dart_flight.run.program_fault import ProgramFault
from dart_flight.sim.faults.fault_table import parse_fault

path, url, log_dir, fault = sys.argv[1:]
mission = with_driver(load_flyable(path), LockDriver.PX4)
# Only the deadman is tested: a pause of a shared machine must not make the guard land first.
guard = msgspec.structs.replace(
    mission.vehicle.guard, imu_timeout_s=0.5, stream_timeout_s=0.5, telemetry_late_s=0.5
)
vehicle = msgspec.structs.replace(mission.vehicle, guard=guard)
mission = msgspec.structs.replace(mission, vehicle=vehicle)
record = FlightRecord(mission, World.DRONE, None, Path(log_dir))
app = FlightApp(mission, url, record, AppOptions(deadman_note=record.folder / DEADMAN_NOTE))
record.onlookers.append(ProgramFault(parse_fault(fault), app))
try:
    asyncio.run(app.run())
finally:
    record.close()
