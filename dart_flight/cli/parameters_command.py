"""`dart-flight parameters MISSION`: list or write the PX4 parameters that differ from the desired values."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

from rich.table import Table

from dart_flight.check.parameter_setting import (
    ParameterReading,
    WriteReport,
    load_restored,
    read_differences,
    save_previous,
    write_rows,
)
from dart_flight.check.wanted_parameters import ParameterRow, ParameterState
from dart_flight.cli.options import add_driver_option, add_position_option, add_set_option, link_of
from dart_flight.cli.terminal import confirm, emit_json, messages, print_status, tables
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError
from dart_flight.config.mission import load_mission
from dart_flight.config.parameter_file import show_value
from dart_flight.run.prepare import with_driver
from dart_flight.vehicle.ground_link import GroundLink
from dart_flight.vehicle.link import LinkLease


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("mission", metavar="MISSION", help="mission that specifies the vehicle and the frame")
    parser.add_argument("--connection", metavar="URL", help="the vehicle's link (default: connection.url)")
    parser.add_argument(
        "--write", action="store_true", help="write the desired values; the vehicle must be disarmed"
    )
    parser.add_argument(
        "--restore", type=Path, metavar="FILE", help="write the values of a .params file instead"
    )
    parser.add_argument(
        "--all",
        action="store_true",
        help="with --restore, also write the values of one flight controller: MAV_SYS_ID, calibration",
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
    """Return 0 if no parameter differs or all differing parameters were written.

    A missing answer also gives 1, because the parameter's value is unknown.
    """
    mission = load_mission(arguments.mission, arguments.config, arguments.set)
    mission = with_driver(mission, arguments.driver)
    url = link_of(arguments, mission.vehicle.connection)
    if not arguments.save_dir.is_dir():
        raise InputError("not a folder", source=str(arguments.save_dir), key=("--save-dir",))
    restored = None if arguments.restore is None else load_restored(arguments.restore, arguments.all)
    print_vehicle(mission.flown_vehicle(), arguments)
    saved, report = None, None
    timeout_s = mission.vehicle.connection.timeout_s
    with LinkLease(url, "parameters") as lease, GroundLink(url, timeout_s) as link:
        lease.lock_device()
        with _shown("reading parameters") as progress:
            found = read_differences(link, mission, arguments.position_from, restored, progress)
        if not arguments.json:
            _show(found)
        unanswered = found.names(ParameterState.NOT_ANSWERED)
        if unanswered:
            print_status(f"no answer for {', '.join(unanswered)}: try again, or improve the link")
        rows = found.writable
        if rows and (arguments.write or arguments.restore):
            link.require_disarmed()
            if arguments.yes or confirm(f"Write {len(rows)} parameters?"):
                link.require_disarmed()
                head = f"{url}, PX4 {found.version or 'unknown'}"
                saved = save_previous(rows, arguments.save_dir, head, link.system_id)
                print_status(f"previous values: {saved}")
                with _shown("writing parameters") as progress:
                    report = write_rows(link, rows, progress)
            else:
                print_status("nothing written")
    if report is not None:
        _report_written(rows, report)
    if arguments.json:
        emit_json(
            {
                "parameters": found.rows,
                "states": found.states,
                "remarks": found.remarks,
                "position_from": found.position_from,
                "px4_version": found.version or None,
                "restart_source": found.restart_source,
                "written": report.written if report else [],
                "read_back": report is not None and report.problem is None,
                "refused": report.refused if report else {},
                "problem": report.problem if report else None,
                "saved": None if saved is None else str(saved),
                "vehicle": mission.flown_vehicle(),
            }
        )
    done = not rows or (report is not None and report.problem is None and not report.refused)
    return 0 if done and not unanswered else 1


def _show(found: ParameterReading) -> None:
    for remark in found.remarks:
        print_status(remark)
    if found.position_from is not None:
        print_status(f"position from {found.position_from} (--position-from)")
    if not found.rows:
        print_status("all parameters have the desired values")
        return
    table = Table()
    table.add_column("parameter", no_wrap=True)
    table.add_column("vehicle", justify="right", no_wrap=True)
    table.add_column("wanted", justify="right", no_wrap=True)
    table.add_column("restart", no_wrap=True)
    table.add_column("why", overflow="fold")
    for row in found.rows:
        has = row.state.value if row.vehicle is None else show_value(row.vehicle)
        table.add_row(row.name, has, show_value(row.wanted), "yes" if row.restart else "", row.why)
    tables().print(table)
    absent = found.names(ParameterState.ABSENT)
    if absent:
        print_status(f"not on this vehicle, skipped: {', '.join(absent)}")
    print_status(f"restart: according to {found.restart_source}")


def _report_written(rows: list[ParameterRow], report: WriteReport) -> None:
    for problem in report.refused.values():
        print_status(problem)
    if report.problem is not None:
        rest = [row.name for row in rows if row.name not in report.written and row.name not in report.refused]
        print_status(report.problem)
        print_status(f"written but not read back: {', '.join(report.written) or 'none'}")
        print_status(f"not written: {', '.join(rest) or 'none'}")
        return
    later = [row.name for row in rows if row.restart and row.name in report.written]
    print_status(f"{len(report.written)} parameters written and read back")
    if later:
        print_status(
            f"restart the flight controller; without a restart these have no effect: {', '.join(later)}"
        )


@contextlib.contextmanager
def _shown(what: str) -> Iterator[Callable[[int, int], None]]:
    """Yield `show(finished, total)`, which shows progress on a terminal."""
    from rich.progress import Progress  # slow to import

    console = messages()
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, of: bar.update(task, completed=done, total=of)
