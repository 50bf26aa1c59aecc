"""The world in which a real PX4 SITL flies the plant, through MAVSDK, in lockstep or in real time."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path

import msgspec

from dart_flight.base.records import StatusText, World
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.lab_entries import PX4_FIGURES, load_entry
from dart_flight.planning.positioning import frame_problem
from dart_flight.recording.found import PX4_LOG
from dart_flight.recording.verdict import Px4Figures, TimeKind, Verdict
from dart_flight.run.app import AppOptions, FlightApp, WorldLink
from dart_flight.run.flight_record import FlightRecord, Onlooker
from dart_flight.run.prepare import emulated_kind, with_px4_delays
from dart_flight.run.program_fault import ProgramFault
from dart_flight.run.simulator_process import Px4SimulatorProcess, SimulatorProcess, fly_simulated
from dart_flight.sim.draws import draw_world
from dart_flight.sim.faults.fault_table import Fault
from dart_flight.sim.pipe import Px4SimulatorSpec, SimulatorSpec, require_mavlink
from dart_flight.vehicle.clock import LockstepClock
from dart_flight.vehicle.link import LinkLease, acquire_free_link

_LOCKSTEP_PAUSE_S = 0.5


def fly_px4(
    mission: Mission,
    directory: str | Path | None,
    seed: int,
    log_dir: Path,
    progress: Onlooker = lambda record: None,
    *,
    position_from: PositionSource = PositionSource.MOCAP,
    speed: float = 1.0,
    realtime: bool = False,
    parameter_files: tuple[Path, ...] = (),
    spreads: Mapping[str, float] | None = None,
    fault: Fault | None = None,
    viewer: Onlooker | None = None,
) -> Verdict:
    """Fly the simulated plant with a real PX4 SITL, through MAVSDK over UDP, and return the verdict.

    Args:
        directory: where PX4 is, or None to search for PX4 (`find_install`).
        log_dir: parent folder of the flight's folder, which also receives PX4's ULog as `px4.ulg`.
        realtime: whether simulated time advances without waiting for this program.
        parameter_files: PX4 parameters in addition to `configs/px4/`.
        fault: fault of the motion capture.

    Raises:
        InputError: PX4 is not found, a parameter file is wrong, or the mission's frame is not valid with GPS.
        SimulatorError, VehicleError: PX4 did not start or did not answer.
    """
    require_mavlink()
    from dart_flight.sim.px4.installation import find_install  # noqa: PLC0415
    from dart_flight.sim.px4.launch import flight_parameters, motors_from, values_of  # noqa: PLC0415

    install = find_install(directory)
    problem = frame_problem(mission, position_from)
    if problem is not None:
        raise InputError(problem, source=mission.source, key=("frame", "origin"))
    mission = with_px4_delays(_for_pauses(mission, speed) if realtime else mission)
    parameters = flight_parameters(mission.vehicle, position_from, list(parameter_files))
    motors_from(values_of(parameters), mission.vehicle)  # wrong motors raise InputError before PX4 starts
    drawn = draw_world(mission, seed, spreads or {})
    record = FlightRecord(mission, World.PX4, seed, log_dir, drawn.drawn)
    if viewer is not None:
        record.viewers.append(viewer)
    folder = record.folder
    px4 = Px4SimulatorSpec(str(install.folder), str(folder.resolve()), parameters, position_from)
    record.time = TimeKind.REALTIME if realtime else TimeKind.LOCKSTEP
    spec = SimulatorSpec(
        mission,
        seed,
        [],
        px4=px4,
        spreads=dict(spreads or {}),
        speed=speed,
        lockstep=not realtime,
        mocap=emulated_kind(mission),
    )

    with contextlib.ExitStack() as leases:
        if not realtime:
            port, lease = acquire_free_link("dry-run --px4", record.path)
            leases.callback(lease.release)
            spec.ports = [port]

        def make_app(world: SimulatorProcess) -> FlightApp:
            url = f"udpin://127.0.0.1:{world.port}"
            if realtime:  # PX4 derives the port from its instance number
                leases.enter_context(LinkLease(url, "dry-run --px4", record.path))
            version = f"v{world.version}" if world.version else "of unknown version"
            progress(StatusText(0, 0, "notice", f"PX4 {version} in {install.folder}", found_here=True))
            clock = LockstepClock(speed) if realtime else None
            world_link = WorldLink(world, clock, not realtime, drawn.lock_faults, world.mocap_url)
            app = FlightApp(mission, url, record, AppOptions(progress), world_link)
            if fault is not None:
                record.onlookers.append(ProgramFault(fault, app, world, record.path))
            return app

        world = fly_simulated(record, spec, make_app, Px4SimulatorProcess)
    ulog = folder / PX4_LOG
    built = record.build(px4_log=ulog)
    built.px4 = _px4_figures(ulog, world.version, progress)
    return built


def _px4_figures(ulog: Path, version: str | None, notify: Onlooker) -> Px4Figures:
    """Return the values from PX4's own log; if it is unreadable, report this and return the version only."""
    try:
        figures: Px4Figures = load_entry(PX4_FIGURES)(ulog, version)
    except ImportError:
        return Px4Figures(version)
    except Exception as error:
        notify(StatusText(0, 0, "warning", f"cannot read PX4's log {ulog.name}: {error!r}", found_here=True))
        return Px4Figures(version)
    return figures


def _for_pauses(mission: Mission, speed: float) -> Mission:
    """Return the mission with guard timeouts that tolerate pauses of the simulator.

    PX4 and the plant are in lockstep, so a stall of the computer also stops the vehicle's time and is
    harmless. The core's guard therefore tolerates missing telemetry for at least 0.5 s divided by `speed`.
    """
    guard = mission.vehicle.guard
    timeout_s = max(guard.stream_timeout_s, _LOCKSTEP_PAUSE_S / speed)
    late_s = max(guard.telemetry_late_s, _LOCKSTEP_PAUSE_S / speed)
    guard = msgspec.structs.replace(guard, stream_timeout_s=timeout_s, telemetry_late_s=late_s)
    vehicle = msgspec.structs.replace(mission.vehicle, guard=guard)
    return msgspec.structs.replace(mission, vehicle=vehicle)
