"""`dart-flight parameters MISSION`: list or write the PX4 parameters that differ from the wanted values."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

from rich.table import Table

from dart_flight.check.parameter_setting import (
    ParameterReading,
    read_differences,
    save_previous,
    write_rows,
)
from dart_flight.check.wanted_parameters import ParameterRow
from dart_flight.cli.options import add_driver_option, add_position_option, add_set_option, link_of
from dart_flight.cli.terminal import confirm, emit_json, messages, print_status, tables
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError
from dart_flight.config.mission import load_mission
from dart_flight.run.prepare import with_driver
from dart_flight.vehicle.ground_link import GroundLink
from dart_flight.vehicle.link import LinkLease


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("mission", metavar="MISSION", help="mission that gives the vehicle and the frame")
    parser.add_argument("--connection", metavar="URL", help="the vehicle's link (default: connection.url)")
    parser.add_argument(
        "--write", action="store_true", help="write the wanted values; the vehicle must be disarmed"
    )
    parser.add_argument(
        "--restore", type=Path, metavar="FILE", help="write the values of a .params file instead"
    )
    parser.add_argument("--yes", action="store_true", help="do not ask before writing")
    parser.add_argument(
        "--save-dir",
        type=Path,
        default=Path(),
        metavar="DIR",
        help="folder for the previous values (default: the working folder)",
    )
    add_position_option(parser)
    add_driver_option(parser)
    add_set_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return 0 if no parameter differs or all differing parameters were written."""
    mission = load_mission(arguments.mission, arguments.config, arguments.set)
    mission = with_driver(mission, arguments.driver)
    url = link_of(arguments, mission.vehicle.connection)
    if not arguments.save_dir.is_dir():
        raise InputError("not a folder", source=str(arguments.save_dir), key=("--save-dir",))
    print_vehicle(mission.flown_vehicle(), arguments)
    saved, refused, written = None, dict[str, str](), False
    timeout_s = mission.vehicle.connection.timeout_s
    with LinkLease(url, "parameters") as lease, GroundLink(url, timeout_s) as link:
        lease.lock_device()
        with _shown("reading parameters") as progress:
            found = read_differences(link, mission, arguments.position_from, arguments.restore, progress)
        if not arguments.json:
            _show(found)
        rows = found.writable
        if rows and (arguments.write or arguments.restore):
            link.require_disarmed()
            if arguments.yes or confirm(f"Write {len(rows)} parameters?"):
                link.require_disarmed()
                saved = save_previous(rows, arguments.save_dir, f"{url}, PX4 {found.version or 'unknown'}")
                print_status(f"previous values: {saved}")
                with _shown("writing parameters") as progress:
                    refused = write_rows(link, rows, progress)
                written = True
            else:
                print_status("nothing written")
    for problem in refused.values():
        print_status(problem)
    if written:
        _report_written([row for row in rows if row.name not in refused])
    if arguments.json:
        emit_json(
            {
                "parameters": found.rows,
                "position_from": found.position_from,
                "px4_version": found.version or None,
                "restart_source": found.restart_source,
                "written": [row.name for row in rows if row.name not in refused] if written else [],
                "refused": refused,
                "saved": None if saved is None else str(saved),
                "vehicle": mission.flown_vehicle(),
            }
        )
    return 0 if not rows or (written and not refused) else 1


def _show(found: ParameterReading) -> None:
    """Print the parameters that differ, or a message if none does."""
    if found.position_from is not None:
        print_status(f"position from {found.position_from} (--position-from)")
    if not found.rows:
        print_status("all parameters have the wanted values")
        return
    table = Table()
    table.add_column("parameter", no_wrap=True)
    table.add_column("vehicle", justify="right", no_wrap=True)
    table.add_column("wanted", justify="right", no_wrap=True)
    table.add_column("restart", no_wrap=True)
    table.add_column("why", overflow="fold")
    for row in found.rows:
        has = "skipped" if row.vehicle is None else f"{row.vehicle:g}"
        table.add_row(row.name, has, f"{row.wanted:g}", "yes" if row.restart else "", row.why)
    tables().print(table)
    missing = [row.name for row in found.rows if row.vehicle is None]
    if missing:
        print_status(f"not on this vehicle, skipped: {', '.join(missing)}")
    print_status(f"restart: according to {found.restart_source}")


def _report_written(rows: list[ParameterRow]) -> None:
    later = [row.name for row in rows if row.restart]
    print_status(f"{len(rows)} parameters written and read back")
    if later:
        print_status(
            f"restart the flight controller; without a restart these have no effect: {', '.join(later)}"
        )


@contextlib.contextmanager
def _shown(what: str) -> Iterator[Callable[[int, int], None]]:
    """Show progress on a terminal until the context ends.

    The context yields a function. Its arguments are the number of finished items and the total number.
    """
    from rich.progress import Progress  # slow to import

    console = messages()
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, of: bar.update(task, completed=done, total=of)
