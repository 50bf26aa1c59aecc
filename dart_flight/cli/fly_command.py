"""`dart-flight fly MISSION`: fly it on the vehicle."""

from __future__ import annotations

import argparse
import sys

from dart_flight.check.findings import decide
from dart_flight.check.mission import check_mission
from dart_flight.check.vehicle import check_vehicle
from dart_flight.cli.check_command import show
from dart_flight.cli.flight_output import FlightLines, verdict_table
from dart_flight.cli.options import add_flight_options, add_position_option, link_of
from dart_flight.cli.terminal import emit_json, messages, tables
from dart_flight.cli.vehicle_line import say_vehicle
from dart_flight.config.mission import Mission
from dart_flight.vehicle.link import LinkLease
from dart_flight.worlds.drone import fly_vehicle
from dart_flight.worlds.prepare import load_flyable, with_driver, with_standoff


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add_flight_options(parser)
    parser.add_argument(
        "--connection",
        metavar="URL",
        help="serial:///dev/ttyAMA0:921600, udpin://0.0.0.0:14540 (default: connection.url)",
    )
    parser.add_argument(
        "--overrule", action="append", default=[], metavar="ITEM", help="fly although `check` says no-go here"
    )
    add_position_option(parser)
    parser.add_argument("--yes", action="store_true", help="do not ask before flying")


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit status."""
    mission = load_flyable(arguments.mission, arguments.config)
    if arguments.driver is not None:
        mission = with_driver(mission, arguments.driver)
    if arguments.standoff is not None:
        mission = with_standoff(mission, arguments.standoff)
    url = link_of(arguments, mission.vehicle.connection)
    with LinkLease(url, "fly") as lease:
        return _fly(arguments, mission, url, lease)


def _fly(arguments: argparse.Namespace, mission: Mission, url: str, lease: LinkLease) -> int:
    console = messages()
    say_vehicle(mission.flown_vehicle(), console, asked=arguments.config is not None)
    console.print(_intention(mission, url), soft_wrap=True)
    findings = check_mission(mission) + check_vehicle(mission, url, arguments.position_from)
    report = decide(mission, findings, arguments.overrule)
    show(report, console)
    if not report.go:
        return 1
    if not arguments.yes and not _confirmed():
        console.print("not flown")
        return 1
    lines = FlightLines(console, arguments.verbose > 0)
    verdict = fly_vehicle(mission, url, arguments.log_dir, lines, lease)
    if arguments.json:
        emit_json(verdict)
    else:
        tables().print(verdict_table(verdict))
        console.print(f"log: {verdict.log}", soft_wrap=True)
    return 0 if verdict.outcome == "completed" else 1


def _intention(mission: Mission, url: str) -> str:
    """What is about to happen, in words."""
    lines = [f"[bold]{mission.name}[/] on {url}, lock by {mission.vehicle.lock.driver.value}"]
    lines.append(f"  take off to {mission.altitude_m:g} m, to ({mission.start[0]:g}, {mission.start[1]:g})")
    for c in mission.collisions:
        if c.approach_m_s is not None:
            normal, tangential = c.approach_m_s
            how = f"at {normal:g} m/s normal, {tangential:g} m/s along"
        else:
            how = "by the recovery from the one before"
        lines.append(f"  hit {c.wall.name} ({c.wall.material}) {c.mode.value}, {how}")
    goal = mission.goal.position_m
    lines.append(f"  hold ({goal[0]:g}, {goal[1]:g}) for {mission.goal.hold_s:g} s, land")
    return "\n".join(lines)


def _confirmed() -> bool:
    if not sys.stdin.isatty():
        return False
    sys.stderr.write("Fly? [y/N] ")
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower() in ("y", "yes")
