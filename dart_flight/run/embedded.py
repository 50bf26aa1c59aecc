"""Embedded world: MAVSDK over UDP to the project's own small autopilot, in lockstep or in real time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from dart_flight.base.records import World
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.recording.verdict import TimeKind, Verdict
from dart_flight.run.app import AppOptions, FlightApp, WorldLink
from dart_flight.run.flight_record import FlightRecord, Onlooker
from dart_flight.run.prepare import emulated_kind
from dart_flight.run.program_fault import ProgramFault
from dart_flight.run.simulator_process import SimulatorProcess, fly_simulated
from dart_flight.sim.draws import draw_world
from dart_flight.sim.faults.fault_table import Fault
from dart_flight.sim.pipe import SimulatorSpec, require_mavlink
from dart_flight.vehicle.clock import LockstepClock
from dart_flight.vehicle.link import acquire_free_link

DEADMAN_NOTE = "deadman.txt"


def fly_embedded(
    mission: Mission,
    seed: int,
    log_dir: Path,
    progress: Onlooker = lambda record: None,
    *,
    deadman: bool = False,
    fault: Fault | None = None,
    spreads: Mapping[str, float] | None = None,
    speed: float = 1.0,
    realtime: bool = False,
    viewer: Onlooker | None = None,
) -> Verdict:
    """Fly through MAVSDK over UDP with the embedded autopilot and return the verdict.

    Args:
        deadman: whether to start the deadman, which kills this program if the program hangs. Used in real
            time only.
        realtime: whether simulated time advances without waiting for this program. If so, timeouts use the
            host's time.

    Raises:
        InputError: the log cannot be written.
        SimulatorError, VehicleError: the simulated vehicle did not start or did not answer.
    """
    require_mavlink()
    drawn = draw_world(mission, seed, spreads or {})
    record = FlightRecord(mission, World.EMBEDDED, seed, log_dir, drawn.drawn)
    if viewer is not None:
        record.viewers.append(viewer)
    try:
        port, lease = acquire_free_link("dry-run", record.path)
    except InputError:
        record.close()
        raise
    realtime = realtime or (fault is not None and fault.kind.needs_real_time)
    record.time = TimeKind.REALTIME if realtime else TimeKind.LOCKSTEP
    spec = SimulatorSpec(
        mission,
        seed,
        [port],
        spreads=dict(spreads or {}),
        speed=speed,
        lockstep=not realtime,
        mocap=emulated_kind(mission),
    )

    def make_app(world: SimulatorProcess) -> FlightApp:
        # In lockstep the world itself detects a program that hangs, and ends the flight.
        note = record.folder / DEADMAN_NOTE if deadman and realtime else None
        url = f"udpin://127.0.0.1:{port}"
        clock = LockstepClock(speed) if realtime and speed != 1.0 else None
        world_link = WorldLink(world, clock, not realtime, drawn.lock_faults, world.mocap_url)
        app = FlightApp(mission, url, record, AppOptions(progress, note), world_link)
        if fault is not None:
            record.onlookers.append(ProgramFault(fault, app, world, record.path))
        return app

    try:
        fly_simulated(record, spec, make_app)
    finally:
        lease.release()
    return record.build()
