"""`dart-flight init DIR`: copy a vehicle's configuration and missions to a new project folder."""

from __future__ import annotations

import argparse
from pathlib import Path

from dart_flight.cli.terminal import emit_json, print_status
from dart_flight.config.starter import DART, VEHICLES, first_mission, write_starter


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "directory", type=Path, metavar="DIR", help="folder for the files; created if missing"
    )
    parser.add_argument(
        "--vehicle",
        default=DART,
        metavar="NAME",
        help="copy the files of this vehicle: " + ", ".join(VEHICLES) + f" (default: {DART})",
    )


def run(arguments: argparse.Namespace) -> int:
    written = write_starter(arguments.directory, arguments.vehicle)
    if arguments.json:
        files = [str(path) for path in written]
        emit_json({"directory": str(arguments.directory), "vehicle_name": arguments.vehicle, "files": files})
    else:
        mission = first_mission(arguments.vehicle)
        print_status(
            f"{len(written)} files in {arguments.directory}; try:",
            f"  cd {arguments.directory}",
            f"  dart-flight check {mission}",
            f"  dart-flight dry-run {mission} --fast",
        )
    return 0
