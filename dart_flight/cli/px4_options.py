"""Options of `dry-run` and `survey` for a real PX4, and the position source that they select."""

from __future__ import annotations

import argparse
from pathlib import Path

from dart_flight.config.document import InputError
from dart_flight.config.parameter_file import PositionSource
from dart_flight.planning.positioning import PLAIN_GPS


def add_px4_options(parser: argparse.ArgumentParser, with_hitl: bool = True) -> None:
    group = parser.add_argument_group("real PX4 (docs/px4.md)")
    group.add_argument(
        "--px4",
        nargs="?",
        const="",
        type=px4_place,
        metavar="DIR",
        help="fly a real PX4 SITL: an installation, a build, a source folder or the program "
        "(default: $DART_PX4_DIR, else the PX4 of this computer)",
    )
    parser.set_defaults(hitl=None)
    if with_hitl:
        group.add_argument(
            "--hitl",
            metavar="URL",
            help="fly a real flight controller on the table, with the propellers off; URL is its port for "
            "simulated sensors, such as serial:///dev/ttyACM0:921600, or UDP (docs/hitl.md)",
        )
        group.add_argument(
            "--connection",
            metavar="URL",
            help="with --hitl: link of the application (default: connection.url)",
        )
    place = group.add_mutually_exclusive_group()
    place.add_argument("--indoor", action="store_true", help="motion capture, no GPS (default)")
    place.add_argument("--outdoor", action="store_true", help="GPS, no motion capture")
    group.add_argument(
        "--gps", choices=("rtk", "plain"), help="type of GPS receiver with --outdoor (default: rtk)"
    )
    group.add_argument(
        "--params",
        type=Path,
        action="append",
        metavar="FILE",
        help="file in QGroundControl's format; its PX4 parameters override configs/px4/ (repeatable)",
    )


def px4_place(text: str) -> str:
    """Parse the value of `--px4`, which must not be the mission."""
    if text.endswith((".yaml", ".yml")):
        raise argparse.ArgumentTypeError(f"{text} is a mission, not a PX4: write it before --px4")
    return text


def position_source_of(arguments: argparse.Namespace) -> PositionSource:
    """Return the source of PX4's position in the simulation.

    Raises:
        InputError: the options contradict each other.
    """
    given = {
        "--indoor": arguments.indoor,
        "--outdoor": arguments.outdoor,
        "--gps": arguments.gps,
        "--params": arguments.params,
    }
    if arguments.connection and arguments.hitl is None:
        raise InputError("--connection needs --hitl; to fly a vehicle, use `fly`")
    if arguments.hitl is not None:
        for name in ("px4", "fast", "speed", "runs", "fault", "params"):
            if getattr(arguments, name):
                raise InputError(f"--{name} and --hitl exclude each other")
    elif arguments.px4 is None:
        for name, value in given.items():
            if value:
                raise InputError(f"{name} needs --px4 or --hitl")
        return PositionSource.MOCAP
    elif arguments.fast:
        raise InputError("--fast and --px4 exclude each other")
    if arguments.gps and not arguments.outdoor:
        raise InputError("--gps needs --outdoor")
    return PositionSource(arguments.gps or "rtk") if arguments.outdoor else PositionSource.MOCAP


def position_warnings(position_from: PositionSource) -> list[str]:
    return [PLAIN_GPS] if position_from is PositionSource.PLAIN else []
