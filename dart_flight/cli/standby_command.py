"""`dart-flight standby [MISSION ...]`: keep link and lock ready, respond to a ground station's buttons."""

from __future__ import annotations

import argparse
import asyncio

import msgspec

from dart_flight.cli.options import add_driver_option, add_log_dir_option, link_of
from dart_flight.cli.terminal import print_status, write_output
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError
from dart_flight.config.mission import load_empty_room
from dart_flight.run.prepare import load_flyable, with_driver
from dart_flight.run.standby import Standby


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "missions", metavar="MISSION", nargs="*", help="missions for the buttons Fly 1, Fly 2, ..., in order"
    )
    parser.add_argument("--connection", metavar="URL", help="the vehicle's link (default: connection.url)")
    add_driver_option(parser)
    add_log_dir_option(parser)


def run(arguments: argparse.Namespace) -> int:
    flown = [
        with_driver(load_flyable(path, arguments.config), arguments.driver) for path in arguments.missions
    ]
    if flown:
        vehicle, source = flown[0].vehicle, flown[0].flown_vehicle()
        for mission in flown[1:]:
            if (mission.vehicle.lock, mission.vehicle.mocap) != (vehicle.lock, vehicle.mocap):
                raise InputError(
                    "the lock or motion capture of this mission differs from the first mission's",
                    source=mission.source,
                )
    else:
        empty = with_driver(load_empty_room(arguments.config), arguments.driver)
        vehicle, source = empty.vehicle, empty.flown_vehicle()
    url = link_of(arguments, vehicle.connection)
    print_vehicle(source, arguments)
    options = [f"--log-dir={arguments.log_dir}"]
    for option in ("config", "driver"):
        if getattr(arguments, option) is not None:
            options.append(f"--{option}={getattr(arguments, option)}")

    def report(kind: str, text: str) -> None:
        if arguments.json:
            write_output(msgspec.json.encode({"kind": kind, "text": text}).decode() + "\n")
        else:
            print_status(text)

    missions = [(mission.name, path) for mission, path in zip(flown, arguments.missions, strict=True)]
    for number, (name, _) in enumerate(missions, 1):
        report("standby", f"Fly {number}: {name}")
    asyncio.run(Standby(missions, vehicle, url, options, report).run())
    report("standby", "standby has ended")
    return 0
