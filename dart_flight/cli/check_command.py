"""`dart-flight check MISSION`: decide between go and no-go, on the ground."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from dart_flight.check.checks import FlightContext, Stage, run_checks
from dart_flight.check.findings import CheckFinding, CheckReport, decide
from dart_flight.cli.mission_picture import add_plot_option, write_picture
from dart_flight.cli.options import (
    add_driver_option,
    add_log_dir_option,
    add_mocap_option,
    add_overrule_option,
    add_position_option,
    add_set_option,
    link_of,
)
from dart_flight.cli.terminal import emit_json, messages, print_status, styled
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError, Stamp, noting_files, stamp_of
from dart_flight.config.mission import load_mission
from dart_flight.config.parameter_file import PX4_NAME
from dart_flight.run.prepare import NO_MOCAP, with_driver, with_mocap
from dart_flight.vehicle.link import LinkLease

_LOOK_S = 0.5


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("mission", metavar="MISSION", help="mission file, see missions/")
    parser.add_argument("--connection", metavar="URL", help="also check the vehicle at this URL")
    add_overrule_option(parser)
    add_log_dir_option(parser)
    add_position_option(parser)
    add_driver_option(parser)
    add_mocap_option(parser)
    add_set_option(parser)
    add_plot_option(parser)
    parser.add_argument(
        "--watch",
        action="store_true",
        help="repeat the check and the picture whenever the mission or one of its files is saved",
    )


def run(arguments: argparse.Namespace) -> int:
    if not arguments.watch:
        return _check(arguments)
    if arguments.json or arguments.connection is not None:
        raise InputError("--watch cannot be combined with --json or --connection", key=("--watch",))
    return keep_checking(lambda: _check(arguments))


def keep_checking(check: Callable[[], int], sleep: Callable[[float], None] = time.sleep) -> int:
    """Check again whenever an input file is saved, until Ctrl-C; return the last exit status.

    Args:
        check: returns an exit status, or raises InputError.
        sleep: waits between two polls of the files.
    """
    status, watched = 2, dict[Path, Stamp]()
    try:
        while True:
            with noting_files() as read:
                try:
                    status = check()
                except InputError as error:
                    print_status(error.one_line())
                    status = 2
            watched |= read
            print_status(f"watching {', '.join(sorted({p.name for p in watched}))}; Ctrl-C ends")
            _wait_for_save(watched, sleep)
    except KeyboardInterrupt:
        return status


def _wait_for_save(watched: dict[Path, Stamp], sleep: Callable[[float], None]) -> None:
    """Wait until a file has changed and all files have stopped changing; update the stamps."""
    changed = False
    while True:
        now = {path: stamp_of(path) for path in watched}
        if changed and now == watched:
            return
        changed = changed or now != watched
        watched.update(now)
        sleep(_LOOK_S)


def _check(arguments: argparse.Namespace) -> int:
    mission = load_mission(arguments.mission, arguments.config, arguments.set)
    mission = with_mocap(with_driver(mission, arguments.driver), arguments.mocap)
    if arguments.connection is None and arguments.mocap not in (None, NO_MOCAP):
        raise InputError("poses are read only from a vehicle: give --connection too", key=("--mocap",))
    if arguments.plot is not None:
        write_picture(mission, arguments.plot)
    context = FlightContext(mission, arguments.log_dir, position_from=arguments.position_from)
    if arguments.connection is not None:
        context.url = link_of(arguments, mission.vehicle.connection)
    run_checks(context, Stage.FILE, Stage.COMPUTER, Stage.DESK)
    if context.url is not None:
        with LinkLease(context.url, "check"):
            run_checks(context, Stage.VEHICLE)
    report = decide(mission, context.found, arguments.overrule)
    print_vehicle(mission.flown_vehicle(), arguments)
    if arguments.json:
        emit_json(report)
    else:
        show(report, messages())
    return 0 if report.go else 1


def show(report: CheckReport, console: Console) -> None:
    """Print the findings, no-goes in red and remarks in yellow, then the result."""
    for finding in report.findings:
        print_finding(finding, console, "go", "NO-GO")
    if any(PX4_NAME.match(f.item) and (f.remark or not f.go) for f in report.findings):
        console.print(
            "some parameters differ: `dart-flight parameters` lists and writes them", soft_wrap=True
        )
    end = styled(("go", "bold green")) if report.go else styled(("no-go", "bold red"), ": do not fly")
    console.print(end)


def print_finding(finding: CheckFinding, console: Console, go: str, no_go: str) -> None:
    """Print one finding, preceded by the word `go` or the word `no_go`."""
    word, style = (go, "green") if finding.go else (no_go, "red")
    if finding.remark:
        word, style = "remark", "yellow"
    if finding.overruled:
        word, style = "overruled", "yellow"
    line = styled((f"{word:9}", style), " ", (finding.item, "bold"), f": {finding.message}")
    console.print(line, soft_wrap=True)
