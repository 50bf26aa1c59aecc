"""`dart-flight check MISSION`: go or no-go, on the ground."""

from __future__ import annotations

import argparse

from rich.console import Console

from dart_flight.check.checks import FlightContext, checks_of
from dart_flight.check.findings import CheckReport, decide
from dart_flight.check.stages import Stage, run_checks
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
from dart_flight.cli.terminal import emit_json, messages, styled
from dart_flight.cli.vehicle_line import say_vehicle
from dart_flight.config.mission import load_mission
from dart_flight.run.prepare import with_driver, with_mocap
from dart_flight.vehicle.link import LinkLease


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("mission", metavar="MISSION", help="mission file, see missions/")
    parser.add_argument("--connection", metavar="URL", help="also check the vehicle that answers here")
    add_overrule_option(parser)
    add_log_dir_option(parser)
    add_position_option(parser)
    add_driver_option(parser)
    add_mocap_option(parser)
    add_set_option(parser)
    add_plot_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit status."""
    mission = load_mission(arguments.mission, arguments.config, arguments.set)
    mission = with_mocap(with_driver(mission, arguments.driver), arguments.mocap)
    if arguments.plot is not None:
        write_picture(mission, arguments.plot)
    context = FlightContext(mission, arguments.log_dir, position_from=arguments.position_from)
    if arguments.connection is not None:
        context.url = link_of(arguments, mission.vehicle.connection)
    run_checks(checks_of(Stage.FILE, Stage.COMPUTER, Stage.DESK), context)
    if context.url is not None:
        with LinkLease(context.url, "check"):
            run_checks(checks_of(Stage.VEHICLE), context)
    report = decide(mission, context.found, arguments.overrule)
    say_vehicle(mission.flown_vehicle(), arguments)
    if arguments.json:
        emit_json(report)
    else:
        show(report, messages())
    return 0 if report.go else 1


def show(report: CheckReport, console: Console) -> None:
    """The findings, no-goes in red, remarks in yellow, and the word at the end."""
    for finding in report.findings:
        word, style = ("go", "green") if finding.go else ("NO-GO", "red")
        if finding.remark:
            word, style = "remark", "yellow"
        if finding.overruled:
            word, style = "overruled", "yellow"
        line = styled((f"{word:9}", style), " ", (finding.item, "bold"), f": {finding.says}")
        console.print(line, soft_wrap=True)
    end = styled(("go", "bold green")) if report.go else styled(("no-go", "bold red"), ": do not fly")
    console.print(end)
