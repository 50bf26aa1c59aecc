"""`dart-flight simulate [MISSION]`: a simulated vehicle alone."""

from __future__ import annotations

import argparse

from rich.console import Console

from dart_flight.cli.options import whole_number
from dart_flight.cli.terminal import messages
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import packaged
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
    parser.add_argument("--seed", type=whole_number(0, 2**31 - 1), default=1, help="of the noise (default 1)")


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit status."""
    try:
        from dart_flight.sim.standalone import Feed
    except ImportError as error:
        raise InputError(f"simulation needs {error.name}: pip install 'dart-flight[sim]'") from None

    path = arguments.mission or packaged("missions", "dual_collision.yaml")
    mission = load_mission(path, arguments.config)
    console = messages()
    feed = Feed(arguments.port)
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

    console.print(
        f"simulated vehicle for [bold]{mission.name}[/], sends to UDP {' and '.join(map(str, ports))}"
        f"; its lock servo listens to PX4's actuator "
        f"{mission.vehicle.lock.px4.actuator_index}. In another terminal:",
        soft_wrap=True,
    )
    console.print(
        f"  dart-flight fly {path} --driver px4 --connection udpin://127.0.0.1:{arguments.port}",
        soft_wrap=True,
    )
    run_vehicle(mission, arguments.seed, ports, lambda line: console.print(line, soft_wrap=True), own_port)
