"""The embedded world: our small autopilot on the plant, through MAVSDK over UDP, in real time or faster."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from dart_flight.base.records import World
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.recording.verdict import Verdict
from dart_flight.run.app import FlightApp
from dart_flight.run.flight_record import FlightRecord, Onlooker
from dart_flight.run.program_fault import ProgramFault
from dart_flight.run.simulator_process import SimulatorProcess, fly_simulated
from dart_flight.sim.draws import draw_world
from dart_flight.sim.faults.fault_table import Fault
from dart_flight.sim.pipe import SimulatorSpec, need_mavlink
from dart_flight.vehicle.clock import LockstepClock
from dart_flight.vehicle.link import free_link

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
    viewer: Onlooker | None = None,
) -> Verdict:
    """Fly through MAVSDK over UDP against the embedded autopilot.

    `deadman` starts the process that kills this one when it hangs; `fault` is what goes wrong; `spreads`
    says what is drawn anew by the seed (`sim.draws`); `speed` is simulated seconds per second: what the core
    times by stamps goes by at that pace, silence alone is judged by the host's time; `viewer` sees every
    record, on the thread that took it.

    Raises:
        InputError: the log cannot be written.
        SimulatorError, VehicleError: the simulated vehicle did not start or did not answer.
    """
    need_mavlink()
    drawn = draw_world(mission, seed, spreads or {})
    record = FlightRecord(mission, World.EMBEDDED, seed, log_dir, drawn.drawn, viewer=viewer)
    try:
        port, lease = free_link("dry-run", record.path)
    except InputError:
        record.close()
        raise
    spec = SimulatorSpec(mission, seed, [port], spreads=dict(spreads or {}), speed=speed)

    def make_app(world: SimulatorProcess) -> FlightApp:
        note = record.folder / DEADMAN_NOTE if deadman else None
        url = f"udpin://127.0.0.1:{port}"
        clock = None if speed == 1.0 else LockstepClock(speed)
        app = FlightApp(mission, url, record, world, progress, clock, note, drawn.lock_faults)
        if fault is not None:
            record.onlookers.append(ProgramFault(fault, app, world, record.path))
        return app

    try:
        fly_simulated(record, spec, make_app)
    finally:
        lease.release()
    return record.build()
