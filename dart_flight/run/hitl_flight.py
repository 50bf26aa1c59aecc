"""The world of hardware in the loop: real flight controller, link and servo, simulated vehicle."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from dart_flight.base.errors import FlightError
from dart_flight.base.records import World
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.vehicle import Motor
from dart_flight.recording.verdict import TimeKind, Verdict
from dart_flight.run.app import FlightApp
from dart_flight.run.computer import ComputerWatch
from dart_flight.run.embedded import DEADMAN_NOTE
from dart_flight.run.flight_record import FlightRecord, Onlooker
from dart_flight.run.prepare import with_px4_delays
from dart_flight.run.simulator_process import HitlProcess, SimulatorProcess, fly_simulated
from dart_flight.sim.draws import draw_world
from dart_flight.sim.pipe import HitlSpec, SimulatorSpec
from dart_flight.vehicle.ground_link import GroundLink
from dart_flight.vehicle.link import LinkLease

# PX4 sends it at 200 Hz on every fast link, 40 % of what TELEM2 carries, and the app has no use for it.
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
    """Fly on a flight controller that `check.hitl_check` has found ready; propellers off.

    Args:
        mission: what to fly; its lock driver is the real one.
        hitl_url: the flight controller's port for simulated sensors.
        url: MAVSDK connection URL of the app's own link.
        seed: of the sensors' noise.
        log_dir: where the flight's folder goes.
        progress: sees every record.
        motors: where the flight controller's parameters have them; None: as the configuration.
        position_from: motion capture or a GPS receiver, simulated.
        spreads: what is drawn anew by the seed (`sim.draws`).
        viewer: sees every record, on the thread that took it.

    Raises:
        InputError: the log cannot be written.
        LinkTakenError: another program has one of the links.
        SimulatorError, VehicleError: the flight controller does not answer on one of its links.
    """
    mission = with_px4_delays(mission)
    drawn = draw_world(mission, seed, spreads or {})
    with LinkLease(url, "dry-run --hitl") as lease, LinkLease(hitl_url, "dry-run --hitl"):
        record = FlightRecord(mission, World.HITL, seed, log_dir, drawn.drawn, viewer=viewer)
        record.time = TimeKind.REALTIME
        lease.note_log(record.path)
        hitl = HitlSpec(hitl_url, motors, position_from)
        spec = SimulatorSpec(mission, seed, [], hitl=hitl, spreads=dict(spreads or {}))

        def make_app(world: SimulatorProcess) -> FlightApp:
            return FlightApp(
                mission,
                url,
                record,
                world,
                progress,
                deadman_note=record.folder / DEADMAN_NOTE,
                opened=lease.close_device,
                unwanted=[_HIL_ACTUATOR_CONTROLS],
            )

        try:
            with ComputerWatch(record.truth):
                fly_simulated(record, spec, make_app, HitlProcess)
        finally:
            _leave_disarmed(mission, url)
    return record.build()


def _leave_disarmed(mission: Mission, url: str) -> None:
    """A flight controller that has lost its simulated sensors stays armed: PX4 never disarms by itself then.

    Raises:
        FlightError: it does not answer, or refuses.
    """
    try:
        with GroundLink(url, mission.vehicle.connection.timeout_s) as link:
            mode = link.heartbeat_mode()
            if mode is not None and mode.armed:
                link.kill()
    except Exception as error:
        raise FlightError(
            f"cannot tell that the flight controller is disarmed ({error}): unplug it"
        ) from None
