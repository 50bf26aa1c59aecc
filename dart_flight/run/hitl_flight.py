"""Hardware-in-the-loop world: flight controller, link and servo are real, the vehicle is simulated."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from dart_flight.base.errors import FlightError
from dart_flight.base.records import World
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.vehicle import Motor
from dart_flight.recording.verdict import TimeKind, Verdict
from dart_flight.run.app import AppOptions, FlightApp, WorldLink
from dart_flight.run.computer import ComputerWatch
from dart_flight.run.embedded import DEADMAN_NOTE
from dart_flight.run.flight_record import FlightRecord, Onlooker
from dart_flight.run.prepare import with_px4_delays
from dart_flight.run.simulator_process import HitlProcess, SimulatorProcess, fly_simulated
from dart_flight.sim.draws import draw_world
from dart_flight.sim.pipe import HitlSpec, SimulatorSpec
from dart_flight.vehicle.ground_link import GroundLink
from dart_flight.vehicle.link import LinkLease

# PX4 sends this message at 200 Hz, 40 % of TELEM2's capacity, and the app does not use it.
_HIL_ACTUATOR_CONTROLS = 93


def fly_hitl(
    mission: Mission,
    hitl_url: str,
    url: str,
    seed: int,
    log_dir: Path,
    progress: Onlooker = lambda record: None,
    *,
    motors: tuple[Motor, ...] | None = None,
    position_from: PositionSource = PositionSource.MOCAP,
    spreads: Mapping[str, float] | None = None,
    viewer: Onlooker | None = None,
) -> Verdict:
    """Fly with a flight controller that `check.hitl_check` has found ready; the propellers must be removed.

    Args:
        mission: mission with the driver of the real servo.
        hitl_url: URL of the flight controller's port for simulated sensors.
        url: MAVSDK connection URL of the app's own link.
        motors: motor geometry from the flight controller's parameters, or None to use the configuration's
            geometry.

    Raises:
        InputError: the log cannot be written.
        LinkInUseError: another program has one of the links.
        SimulatorError, VehicleError: the flight controller does not answer on one of its links.
    """
    mission = with_px4_delays(mission)
    drawn = draw_world(mission, seed, spreads or {})
    with LinkLease(url, "dry-run --hitl") as lease, LinkLease(hitl_url, "dry-run --hitl"):
        record = FlightRecord(mission, World.HITL, seed, log_dir, drawn.drawn)
        if viewer is not None:
            record.viewers.append(viewer)
        record.time = TimeKind.REALTIME
        lease.store_log_path(record.path)
        hitl = HitlSpec(hitl_url, motors, position_from)
        spec = SimulatorSpec(mission, seed, [], hitl=hitl, spreads=dict(spreads or {}))

        def make_app(world: SimulatorProcess) -> FlightApp:
            note = record.folder / DEADMAN_NOTE
            options = AppOptions(progress, note, lease.lock_device, unwanted=[_HIL_ACTUATOR_CONTROLS])
            return FlightApp(mission, url, record, options, WorldLink(world))

        try:
            with ComputerWatch(record.truth):
                fly_simulated(record, spec, make_app, HitlProcess)
        finally:
            _leave_disarmed(mission, url)
    return record.build()


def _leave_disarmed(mission: Mission, url: str) -> None:
    """Disarm the flight controller: when the simulated sensors stop, PX4 does not disarm by itself.

    Raise FlightError if the flight controller does not answer or refuses.
    """
    try:
        with GroundLink(url, mission.vehicle.connection.timeout_s) as link:
            mode = link.heartbeat_mode()
            if mode is not None and mode.armed:
                link.kill()
    except Exception as error:
        raise FlightError(
            f"cannot confirm that the flight controller is disarmed ({error}): unplug the controller"
        ) from None
