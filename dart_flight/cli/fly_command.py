"""`dart-flight fly MISSION`: fly the mission on the vehicle."""

from __future__ import annotations

import argparse
import contextlib
import shlex
from pathlib import Path

from dart_flight.base.errors import FlightError
from dart_flight.check.checks import FlightContext, Stage, run_checks
from dart_flight.check.findings import CheckFinding, decide
from dart_flight.cli.check_command import show
from dart_flight.cli.flight_output import FlightLines, exit_status, live_line_for, show_end
from dart_flight.cli.live_options import add_live_options, live_view
from dart_flight.cli.mission_picture import add_plot_option, write_picture
from dart_flight.cli.options import (
    add_flight_options,
    add_mocap_option,
    add_overrule_option,
    add_position_option,
    link_of,
)
from dart_flight.cli.px4_log_command import download_px4_log
from dart_flight.cli.terminal import confirm, emit_json, messages, print_status
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, Waypoint
from dart_flight.config.provenance import display_path
from dart_flight.recording.about import armed_span
from dart_flight.recording.reader import read_log
from dart_flight.recording.verdict import Verdict
from dart_flight.run.drone import fly_vehicle
from dart_flight.run.operator_buttons import reply_before_take_off
from dart_flight.run.prepare import as_rehearsal, load_flyable, with_driver, with_mocap
from dart_flight.run.px4_log_download import list_px4_logs
from dart_flight.vehicle.command_server import Press, Result
from dart_flight.vehicle.downloads import Px4LogEntry
from dart_flight.vehicle.link import LinkLease


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("mission", metavar="MISSION", help="mission file, see missions/")
    add_flight_options(parser)
    parser.add_argument(
        "--connection",
        metavar="URL",
        help="serial:///dev/ttyAMA0:921600, udpin://0.0.0.0:14540 (default: connection.url)",
    )
    add_overrule_option(parser)
    add_position_option(parser)
    add_mocap_option(parser)
    add_live_options(parser)
    add_plot_option(parser)
    parser.add_argument("--yes", action="store_true", help="do not ask before flying")
    parser.add_argument("--px4-log", action="store_true", help="download PX4's own log after disarming")


def run(arguments: argparse.Namespace) -> int:
    mission = load_flyable(arguments.mission, arguments.config)
    mission = as_rehearsal(with_driver(mission, arguments.driver), arguments.standoff)
    mission = with_mocap(mission, arguments.mocap)
    url = link_of(arguments, mission.vehicle.connection)
    with LinkLease(url, "fly") as lease:
        return _fly(arguments, mission, url, lease)


def _fly(arguments: argparse.Namespace, mission: Mission, url: str, lease: LinkLease) -> int:
    console = messages()
    if arguments.plot is not None:
        write_picture(mission, arguments.plot)
    else:
        see = f"to see the path first: dart-flight check {shlex.quote(arguments.mission)} --plot mission.png"
        print_status(see)
    print_vehicle(mission.flown_vehicle(), arguments)
    console.print(_flight_summary(mission, url), soft_wrap=True)
    cancelled: list[Press] = []

    def answer(press: Press) -> tuple[Result, str]:
        reply = reply_before_take_off(press)
        if reply.effect is not None:
            cancelled.append(press)
        return reply.result, reply.text

    context = FlightContext(mission, arguments.log_dir, url, arguments.position_from, answer)
    findings = run_checks(context, Stage.FILE, Stage.COMPUTER, Stage.VEHICLE)
    if cancelled:
        message = "landing requested during the check: the vehicle will not take off"
        findings.append(CheckFinding("operator", False, message))
    before = _listed(mission, url) if arguments.px4_log else None
    verdict = fly_if_go(arguments, mission, url, lease, findings)
    if verdict is None:
        return 1
    if arguments.px4_log and verdict.log is not None:
        lease.release()  # release the lease, because the download acquires it again
        verdict.px4_log = _downloaded(mission, url, Path(verdict.log), before)
    show_end(verdict, console, arguments.json)
    return exit_status(verdict)


def _listed(mission: Mission, url: str) -> list[Px4LogEntry] | None:
    """Return the logs that PX4 had before the flight, or None if they cannot be listed."""
    try:
        return list_px4_logs(url, mission.vehicle.connection.timeout_s)
    except FlightError as error:
        print_status(f"{error}; this flight's log will be chosen by its date")
        return None


def _downloaded(mission: Mission, url: str, log: Path, before: list[Px4LogEntry] | None) -> str | None:
    """Download PX4's log and return its path.

    A failure is printed and does not change the result of the flight.
    """
    try:
        span = armed_span(read_log(log))
        timeout_s = mission.vehicle.connection.timeout_s
        return display_path(download_px4_log(url, timeout_s, log.parent, span, before=before))
    except KeyboardInterrupt:
        print_status("PX4's log skipped")
    except (FlightError, InputError) as error:
        print_status(error.one_line() if isinstance(error, InputError) else error)
    print_status(f"to download it later: dart-flight px4-log {shlex.quote(str(log.parent))}")
    return None


def fly_if_go(
    arguments: argparse.Namespace, mission: Mission, url: str, lease: LinkLease, findings: list[CheckFinding]
) -> Verdict | None:
    """If the findings permit and the operator agrees, fly the vehicle; otherwise return None."""
    console = messages()
    report = decide(mission, findings, arguments.overrule)
    show(report, console)
    if not report.go:
        if arguments.json:
            emit_json(report)
        return None
    if not arguments.yes and not confirm("Fly?"):
        console.print("cancelled: not flown")
        return None
    lines = FlightLines(console, arguments.verbose > 0, live_line_for(mission, console))
    with live_view(arguments, mission) as live, contextlib.closing(lines):
        return fly_vehicle(mission, url, arguments.log_dir, lines, lease, live)


def _flight_summary(mission: Mission, url: str) -> str:
    lock = mission.vehicle.lock
    by = "" if lock is None else f", lock by {lock.driver.value}"
    lines = [f"{mission.name} on {url}{by}"]
    x, y = mission.start
    lines.append(f"  take off to {mission.altitude_m:g} m, fly to ({x:g}, {y:g})")
    stops = [(w.after, _stop(w)) for w in mission.waypoints]
    lines += [line for after, line in stops if after == 0]
    for c in mission.collisions:
        if c.approach_m_s is not None:
            normal, tangential = c.approach_m_s
            how = f"at {normal:g} m/s normal, {tangential:g} m/s tangential"
        else:
            how = "at the end of the recovery from the previous collision"
        mode = "" if lock is None else f" {c.mode.value}"
        lines.append(f"  hit {c.wall.name} ({c.wall.material}){mode}, {how}")
        lines += [line for after, line in stops if after == c.index]
    goal = mission.goal.position_m
    lines.append(f"  hold ({goal[0]:g}, {goal[1]:g}) for {mission.goal.hold_s:g} s, land")
    return "\n".join(lines)


def _stop(w: Waypoint) -> str:
    if w.position is None:
        return f"  pause until you press Enter or send SIGUSR1; if you do neither, land after {w.hold_s:g} s"
    x, y, z = w.position
    held = f", hold for {w.hold_s:g} s" if w.hold_s else ""
    return f"  fly to ({x:g}, {y:g}) at {z:g} m at up to {w.speed_m_s:g} m/s{held}"
