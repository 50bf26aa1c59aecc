"""`dart-flight simulate [MISSION]`: run a standalone simulated vehicle."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path

from dart_flight.cli.live_options import add_live_options, live_view
from dart_flight.cli.options import add_emulated_mocap_option, add_set_option, whole_number
from dart_flight.cli.terminal import messages
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import Document, InputError
from dart_flight.config.mission import Mission, load_empty_room, load_mission, parse_mission
from dart_flight.config.provenance import find_vehicle
from dart_flight.config.vehicle import LockDriver, packaged
from dart_flight.run.prepare import emulated_kind, with_simulated_mocap
from dart_flight.sim.pipe import require_mavlink
from dart_flight.vehicle.link import LinkInUseError, LinkLease, feed_name

GROUND_STATION_PORT = 14550
_DEFAULT_ROOM = Path("missions/dual_collision.yaml")


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "mission",
        metavar="MISSION",
        nargs="?",
        help=f"mission that specifies walls and start (default: {_DEFAULT_ROOM} if the vehicle can fly it, "
        "otherwise an empty room)",
    )
    parser.add_argument(
        "--port",
        type=whole_number(1024, 65535),
        default=14540,
        help="UDP port to send to (default 14540, for a companion computer; 14550 for a ground station)",
    )
    parser.add_argument("--seed", type=whole_number(0, 2**31 - 1), default=1, help="random seed (default 1)")
    add_emulated_mocap_option(parser)
    add_live_options(parser)
    add_set_option(parser)


def run(arguments: argparse.Namespace) -> int:
    require_mavlink()
    from dart_flight.sim.pose_feed import EmulatedMotionCapture
    from dart_flight.sim.simulated_vehicle import SimulatedVehicle
    from dart_flight.sim.standalone import VehiclePortLease, run_vehicle

    mission = with_simulated_mocap(_load_room(arguments), arguments.mocap)
    kind = emulated_kind(mission)
    console = messages()
    print_vehicle(mission.flown_vehicle(), arguments)
    with contextlib.ExitStack() as held:
        feed = VehiclePortLease(arguments.port)
        held.callback(feed.release)
        ports = [arguments.port]
        try:
            if arguments.port != GROUND_STATION_PORT:
                held.enter_context(LinkLease(feed_name(GROUND_STATION_PORT), "simulate"))
                ports.append(GROUND_STATION_PORT)
        except LinkInUseError as error:
            # A ground station cannot distinguish two vehicles with the same system id.
            console.print(
                f"no messages go to UDP port {GROUND_STATION_PORT}: {error.message}", soft_wrap=True
            )
        lock = mission.vehicle.lock
        flown = arguments.mission or (_DEFAULT_ROOM if mission.walls else "MISSION")
        servo = "" if lock is None else f"; its lock servo follows PX4's actuator {lock.px4.actuator_index}"
        driver = "" if lock is None else "--driver px4 "
        where = f"for {mission.name}" if mission.walls else "in an empty room"
        console.print(
            f"the simulated vehicle {where} sends to UDP {' and '.join(map(str, ports))}"
            f"{servo}. In another terminal:",
            soft_wrap=True,
        )
        vehicle = SimulatedVehicle(mission, arguments.seed, LockDriver.PX4)
        mocap = None
        if kind is not None:
            vehicle.autopilot.use_external_poses()
            mocap = EmulatedMotionCapture(kind, mission, vehicle.autopilot.plant)
            held.callback(mocap.close)
        console.print(
            f"  dart-flight fly {flown} {driver}--connection udpin://127.0.0.1:{arguments.port}"
            + ("" if mocap is None else f" --mocap {mocap.url}"),
            soft_wrap=True,
        )
        viewer = held.enter_context(live_view(arguments, mission, from_truth=True)) or (lambda record: None)
        run_vehicle(
            vehicle,
            tuple(ports),
            lambda line: console.print(line, soft_wrap=True),
            feed.own_port,
            viewer,
            mocap,
        )
    return 0


def _load_room(arguments: argparse.Namespace) -> Mission:
    """Return the mission that specifies walls and start."""
    if arguments.mission is not None:
        return load_mission(arguments.mission, arguments.config, arguments.set)
    vehicle = find_vehicle(arguments.config, arguments.set)
    try:
        return parse_mission(Document.load(packaged(*_DEFAULT_ROOM.parts)), vehicle)
    except InputError:  # this vehicle lacks the lock or the materials of the default mission
        return load_empty_room(arguments.config, arguments.set)
