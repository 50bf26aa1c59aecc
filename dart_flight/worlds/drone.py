"""The drone: whatever answers at a connection URL, through MAVSDK, with a deadman."""

from __future__ import annotations

import asyncio
from pathlib import Path

from dart_flight.config.mission import Mission
from dart_flight.samples import World
from dart_flight.verdict import Verdict
from dart_flight.worlds.app import FlightApp
from dart_flight.worlds.embedded import DEADMAN_NOTE
from dart_flight.worlds.flight_record import FlightRecord, Onlooker


def fly_vehicle(
    mission: Mission, url: str, log_dir: Path, progress: Onlooker = lambda record: None
) -> Verdict:
    """Fly on whatever answers at a connection URL.

    Raises:
        InputError: the log cannot be written.
        VehicleError: nothing answers.
    """
    record = FlightRecord(mission, World.DRONE, None, log_dir)
    try:
        note = record.folder / DEADMAN_NOTE
        asyncio.run(FlightApp(mission, url, record, None, progress, deadman_note=note).run())
    finally:
        record.close()
    return record.build()
