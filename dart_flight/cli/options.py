"""Options that several commands share."""

from __future__ import annotations

import argparse
import errno
import os
from collections.abc import Callable
from pathlib import Path

from dart_flight.config.document import InputError, write_problem
from dart_flight.config.link_url import usable_link
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.vehicle import LockDriver, packaged
from dart_flight.config.vehicle.autopilot import ConnectionConfig
from dart_flight.lock.drivers import DRIVERS
from dart_flight.sim.motion_capture import KINDS
from dart_flight.vehicle.motion_capture.source import URLS


def add_flight_options(parser: argparse.ArgumentParser) -> None:
    add_log_dir_option(parser)
    add_driver_option(parser)
    parser.add_argument(
        "--standoff",
        type=float,
        metavar="M",
        help="rehearsal: stop this many metres short of each wall instead of hitting it",
    )


def add_log_dir_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--log-dir", type=Path, default=Path("flights"), metavar="DIR", help="default: flights"
    )


def add_overrule_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--overrule",
        action="append",
        default=[],
        metavar="ITEM",
        help="fly despite this failed check (repeatable)",
    )


def add_driver_option(parser: argparse.ArgumentParser) -> None:
    known = ", ".join(f"{kind.value} ({entry.words})" for kind, entry in DRIVERS.items())
    parser.add_argument(
        "--driver",
        type=LockDriver,
        choices=list(LockDriver),
        metavar="DRIVER",
        help=f"driver of the lock: {known} (default: the configuration's lock.driver)",
    )


def add_set_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change a key of the configuration, such as simulation.contact.body=point; repeatable",
    )


def add_vary_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="NAME[=SD]",
        help="draw a random value of this quantity for every seed; `all` draws every quantity; give the "
        "option again for another quantity (docs/draws.md)",
    )


def add_position_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--position-from",
        type=PositionSource,
        choices=list(PositionSource),
        metavar="SOURCE",
        help="source of PX4's position: "
        + ", ".join(PositionSource)
        + " (default: as reported by the vehicle)",
    )


def add_mocap_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--mocap",
        metavar="URL",
        help=f"motion capture whose poses are forwarded to PX4: {URLS}; none: forward no poses, as with "
        "`simulate` (default: mocap.url; docs/motion_capture.md)",
    )


def add_emulated_mocap_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--mocap",
        metavar="KIND",
        help="emulate a motion capture of this kind, and forward its poses to the vehicle: "
        f"{', '.join(KINDS)} (docs/motion_capture.md)",
    )


def link_of(arguments: argparse.Namespace, connection: ConnectionConfig) -> str:
    """Return the URL of `--connection` or, without this option, the configuration's `connection.url`.

    Raises:
        InputError: the URL is malformed, or names a serial port that does not exist.
    """
    if arguments.connection is not None:
        return usable_link(arguments.connection)
    return usable_link(connection.url, "connection.url")


def refuse_unwritable(arguments: argparse.Namespace, path: Path) -> None:
    """Raise InputError if a calibration cannot be written, or if the configuration is the packaged one."""
    if not arguments.config and path == packaged("configs", "dart.yaml"):
        raise InputError(
            "is the packaged default; copy it with `dart-flight init` and name the copy with --config",
            source=str(path),
        )
    if not os.access(path, os.W_OK):
        why = write_problem(path, PermissionError(errno.EACCES, os.strerror(errno.EACCES)))
        raise InputError(f"cannot write the calibration to this file: {why}", source=str(path))


def whole_number(low: int, high: int) -> Callable[[str], int]:
    """Return an argparse type for a whole number within limits."""

    def convert(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"must be from {low} to {high}, not {value}")
        return value

    return convert


def number(low: float, high: float) -> Callable[[str], float]:
    """Return an argparse type for a finite number within limits."""

    def convert(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"must be from {low:g} to {high:g}, not {text}")
        return value

    return convert
