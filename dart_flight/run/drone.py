"""Flight of the vehicle at a connection URL, through MAVSDK and with a deadman, for `fly` and `survey`."""

from __future__ import annotations

import asyncio
from pathlib import Path

from dart_flight.base.records import World
from dart_flight.config.mission import Mission
from dart_flight.recording.verdict import Verdict
from dart_flight.run.app import AppOptions, FlightApp
from dart_flight.run.computer import ComputerWatch
from dart_flight.run.embedded import DEADMAN_NOTE
from dart_flight.run.flight_record import FlightRecord, Onlooker
from dart_flight.run.prepare import with_px4_delays
from dart_flight.vehicle.link import LinkLease


def fly_vehicle(
    mission: Mission,
    url: str,
    log_dir: Path,
    progress: Onlooker = lambda record: None,
    lease: LinkLease | None = None,
    viewer: Onlooker | None = None,
) -> Verdict:
    """Fly a mission with the vehicle at a connection URL and return the verdict.

    Args:
        lease: lease of the link, in which the log's path is stored, or None to acquire a lease for this
            flight.

    Raises:
        InputError: the log cannot be written.
        LinkInUseError: another program has the link.
        VehicleError: no vehicle answers.
    """
    if lease is None:
        with LinkLease(url, "fly") as own:
            return fly_vehicle(mission, url, log_dir, progress, own, viewer)
    mission = with_px4_delays(mission)
    record = FlightRecord(mission, World.DRONE, None, log_dir)
    if viewer is not None:
        record.viewers.append(viewer)
    try:
        note = record.folder / DEADMAN_NOTE
        lease.store_log_path(record.path)
        app = FlightApp(mission, url, record, AppOptions(progress, note, lease.lock_device))
        record.notice = app.show
        with ComputerWatch(record.truth):
            asyncio.run(app.run())
    finally:
        record.close()
    return record.build()
