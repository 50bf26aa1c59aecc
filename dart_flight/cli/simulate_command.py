"""`dart-flight simulate [MISSION]`: a simulated vehicle alone."""

from __future__ import annotations

import argparse

from rich.console import Console

from dart_flight.cli.live_options import add_live_options, live_view
from dart_flight.cli.options import add_set_option, whole_number
from dart_flight.cli.terminal import messages
from dart_flight.cli.vehicle_line import say_vehicle
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import default_config_path, packaged
from dart_flight.sim.pipe import need_mavlink
from dart_flight.vehicle.link import LinkLease, LinkTakenError, feed_of

GROUND_STATION_PORT = 14550


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument(
        "mission",
        metavar="MISSION",
        nargs="?",
        help="its walls and start (default: the dual collision)",
    )
    parser.add_argument(
        "--port",
        type=whole_number(1024, 65535),
        default=14540,
        help="UDP port it sends to, as PX4 does to a companion (default 14540; a ground station: 14550)",
    )
    parser.add_argument("--seed", type=whole_number(0, 2**31 - 1), default=1, help="random seed (default 1)")
    add_live_options(parser)
    add_set_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit status."""
    need_mavlink()
    from dart_flight.sim.standalone import VehiclePortLease

    path = arguments.mission or packaged("missions", "dual_collision.yaml")
    # Without a mission of its own the vehicle is this folder's, not that of the packaged mission.
    config = arguments.config or (None if arguments.mission else default_config_path())
    mission = load_mission(path, config, arguments.set)
    console = messages()
    say_vehicle(mission.flown_vehicle(), arguments)
    feed = VehiclePortLease(arguments.port)
    try:
        station = LinkLease(feed_of(GROUND_STATION_PORT), "simulate")
        ports = [arguments.port]
        try:
            if arguments.port != GROUND_STATION_PORT:
                station.acquire()
                ports.append(GROUND_STATION_PORT)
        except LinkTakenError as error:
            # A ground station takes two vehicles of one system id for one, too.
            console.print(f"nothing goes to UDP {GROUND_STATION_PORT}: {error.message}", soft_wrap=True)
        try:
            _run(arguments, mission, path, tuple(ports), feed.own_port, console)
        finally:
            station.release()
    finally:
        feed.release()
    return 0


def _run(
    arguments: argparse.Namespace,
    mission: Mission,
    path: object,
    ports: tuple[int, ...],
    own_port: int,
    console: Console,
) -> None:
    from dart_flight.sim.standalone import run_vehicle

    lock = mission.vehicle.lock
    servo = "" if lock is None else f"; its lock servo listens to PX4's actuator {lock.px4.actuator_index}"
    driver = "" if lock is None else "--driver px4 "
    console.print(
        f"simulated vehicle for [bold]{mission.name}[/], sends to UDP {' and '.join(map(str, ports))}"
        f"{servo}. In another terminal:",
        soft_wrap=True,
    )
    console.print(
        f"  dart-flight fly {path} {driver}--connection udpin://127.0.0.1:{arguments.port}",
        soft_wrap=True,
    )
    with live_view(arguments, mission, from_truth=True) as live:
        viewer = live if live is not None else lambda record: None
        run_vehicle(
            mission, arguments.seed, ports, lambda line: console.print(line, soft_wrap=True), own_port, viewer
        )
