"""`dart-flight survey MISSION`: touch the walls and write the mission with the measured walls."""

from __future__ import annotations

import argparse
import contextlib
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import yaml
from rich.table import Table

from dart_flight.check.checks import FlightContext, Stage, run_checks
from dart_flight.cli.dry_run_command import flight_function, with_emulated_mocap
from dart_flight.cli.flight_output import FlightLines, exit_status, figure_or_dash, live_line_for, show_end
from dart_flight.cli.fly_command import fly_if_go
from dart_flight.cli.options import (
    add_driver_option,
    add_log_dir_option,
    add_overrule_option,
    add_position_option,
    add_set_option,
    add_vary_option,
    link_of,
    number,
    whole_number,
)
from dart_flight.cli.px4_options import add_px4_options
from dart_flight.cli.terminal import emit_json, keep_status, messages, tables
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError, report_write_errors
from dart_flight.config.file_kinds import FileKind, load_document
from dart_flight.config.mission import Mission, load_mission
from dart_flight.core.mission.approach import NoApproachError, check_segments_clear
from dart_flight.lab_entries import ROOM_PICTURE, load_entry
from dart_flight.planning.room import RoomContact, RoomFit, contacts_from_walls, plan_star, room_keys
from dart_flight.planning.survey import plan_survey, surveyed_collisions, surveyed_walls
from dart_flight.recording.measured_walls import MeasuredWall
from dart_flight.recording.verdict import Verdict
from dart_flight.run.prepare import load_flyable, refuse_unflyable, with_driver, with_mocap
from dart_flight.sim.motion_capture import KINDS
from dart_flight.vehicle.link import LinkLease

_SPEED_M_S = 0.5
_DIRECTIONS, _MOST_FLIGHTS = 16, 4  # for an unknown room: probes in each flight, maximum number of flights


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("mission", metavar="MISSION", help="mission file, see missions/")
    add_log_dir_option(parser)
    add_driver_option(parser)
    add_px4_options(parser, with_hitl=False)
    parser.set_defaults(fault=None, runs=None, speed=None, realtime=False)
    parser.set_defaults(live=False, live_port=None, live_host=None)
    parser.add_argument(
        "--fast", action="store_true", help="in one process, in simulated time, without MAVLink"
    )
    parser.add_argument("--connection", metavar="URL", help="link of the vehicle that touches the walls")
    add_overrule_option(parser)
    parser.add_argument("--yes", action="store_true", help="do not ask before flying")
    parser.add_argument("--seed", type=whole_number(0, 2**31 - 1), default=1, help="random seed (default 1)")
    parser.add_argument(
        "--touch-speed",
        type=number(0.3, 2.0),
        default=_SPEED_M_S,
        metavar="M_S",
        help=f"speed of the touches (default {_SPEED_M_S:g} m/s)",
    )
    parser.add_argument("--plot", type=Path, metavar="FILE", help="map of a room found by touch")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="mission file to write, with the measured walls"
    )
    add_position_option(parser)
    parser.add_argument(
        "--mocap",
        metavar="URL",
        help="with --connection: motion capture whose poses are forwarded to PX4, or none "
        f"(default: mocap.url); in simulation: kind to emulate, {', '.join(KINDS)} (docs/motion_capture.md)",
    )
    add_set_option(parser)
    add_vary_option(parser)


def run(arguments: argparse.Namespace) -> int:
    document = load_document(arguments.mission, FileKind.MISSION)
    mission = with_driver(load_flyable(arguments.mission, arguments.config, arguments.set), arguments.driver)
    if arguments.connection is not None:
        mission = with_mocap(mission, arguments.mocap)
    else:
        mission = with_emulated_mocap(arguments, mission)
    output = arguments.output
    for path in (output, arguments.plot):
        if path is not None and not path.absolute().parent.is_dir():  # reject a wrong path before the flight
            raise InputError("cannot write: no such folder", source=str(path))
    if not mission.flat_walls:
        return _survey_room(arguments, document.tree, mission)
    survey = plan_survey(mission, arguments.touch_speed)
    console = messages()
    for name, reason in survey.unreachable.items():
        console.print(f"wall {name} skipped: {reason}", style="yellow", soft_wrap=True)
    print_vehicle(mission.flown_vehicle(), arguments)
    verdict = _fly(arguments, survey.mission)
    if verdict is None:
        return 1
    walls = {wall.name: wall for wall in verdict.walls}
    unfit = None
    if output is not None and walls:
        unfit = _write(arguments, document.tree, walls, mission)
    if not arguments.json:
        show_end(verdict, console, False)
    with keep_status(f"{len(walls)} of {len(mission.flat_walls)} walls touched"):
        if arguments.json:
            emit_json(
                {
                    "walls": verdict.walls,
                    "unreachable": survey.unreachable,
                    "flight": verdict,
                    "vehicle": mission.flown_vehicle(),
                }
            )
        else:
            tables().print(_table(verdict.walls))
    missed = [wall.name for wall in mission.flat_walls if wall.name not in walls]
    if missed:
        console.print(f"not touched: {', '.join(missed)}", style="red", soft_wrap=True)
    if unfit is not None:
        text = (
            f"the mission was written, but it cannot be flown with the measured walls; plan it again: {unfit}"
        )
        console.print(text, style="red", soft_wrap=True)
    return exit_status(verdict) or bool(missed or unfit)


def _survey_room(arguments: argparse.Namespace, written: Any, mission: Mission) -> int:
    """Search for the walls of an unknown room, flight by flight, until the room's outline is closed."""
    console = messages()
    print_vehicle(mission.flown_vehicle(), arguments)
    directions = [2.0 * math.pi * k / _DIRECTIONS for k in range(_DIRECTIONS)]
    touches: list[RoomContact] = []
    flights: list[Verdict] = []
    airframe = mission.vehicle.airframe
    while True:
        verdict = _fly(arguments, plan_star(mission, directions, arguments.touch_speed))
        if verdict is None:
            return 1
        flights.append(verdict)
        touches += contacts_from_walls(verdict.walls, directions)
        room = RoomFit(mission.start, touches, airframe.guard_along_m, airframe.contact_distance_m).fit()
        state = "closed" if room.is_closed else f"open in {len(room.gaps_rad)} directions"
        text = f"flight {len(flights)}: {len(touches)} contacts, {len(room.walls)} walls, outline {state}"
        console.print(text, soft_wrap=True)
        if room.is_closed or exit_status(verdict) or len(flights) == _MOST_FLIGHTS:
            break
        directions = sorted(room.gaps_rad)[:_DIRECTIONS]
    materials = [wall.material for flight in flights for wall in flight.walls if wall.material is not None]
    material = (
        max(set(materials), key=materials.count) if materials else next(iter(mission.vehicle.materials))
    )
    walls = room_keys(room, material) if room.is_closed else {}
    if arguments.plot is not None:
        load_entry(ROOM_PICTURE)(mission, room, touches, arguments.plot)
    if arguments.output is not None and walls:
        _write(arguments, {**written, "walls": walls}, {}, mission)
    with keep_status(f"{len(walls)} walls, outline {state}"):
        if arguments.json:
            named = [{"name": name, **keys} for name, keys in walls.items()]
            flown = {"closed": room.is_closed, "contacts": len(touches), "flights": flights}
            emit_json({"walls": named, **flown})
        else:
            tables().print(_room_table(walls))
    return 0 if room.is_closed else 1


def _room_table(walls: dict[str, dict[str, Any]]) -> Table:
    table = Table("wall", "centre of its surface, m", "normal", "length m", "± m", "± deg")
    for name, keys in walls.items():
        (x, y), (nx, ny) = keys["point_m"], keys["normal"]
        place, normal = f"({x:.3f}, {y:.3f})", f"({nx:.3f}, {ny:.3f})"
        sds = (f"{keys['position_sd_m']:.3f}", f"{keys['yaw_sd_deg']:.2f}")
        table.add_row(name, place, normal, f"{keys['length_m']:.2f}", *sds)
    return table


def _fly(arguments: argparse.Namespace, mission: Mission) -> Verdict | None:
    """Fly the survey with the vehicle or in the selected simulation; return None if there was no flight."""
    console = messages()
    refuse_unflyable(mission)
    if arguments.connection is not None:
        url = link_of(arguments, mission.vehicle.connection)
        with LinkLease(url, "survey") as lease:
            context = FlightContext(mission, url=url, position_from=arguments.position_from)
            findings = run_checks(context, Stage.FILE, Stage.VEHICLE)
            return fly_if_go(arguments, mission, url, lease, findings)
    fly = flight_function(arguments, mission)
    live_line = None if arguments.fast else live_line_for(mission, console)
    with contextlib.closing(FlightLines(console, arguments.verbose > 0, live_line)) as lines:
        return fly(mission, seed=arguments.seed, log_dir=arguments.log_dir, progress=lines)


def _write(
    arguments: argparse.Namespace, written: Any, walls: dict[str, MeasuredWall], mission: Mission
) -> str | None:
    """Write the mission with the measured walls.

    Return None if the new mission can be flown, otherwise the reason, such as a blocked trajectory.
    """
    path, tree = arguments.output, dict(written)
    tree["walls"] = {**tree.get("walls", {}), **surveyed_walls(mission, walls)}
    tree["collisions"] = surveyed_collisions(mission, tree.get("collisions", []), walls)
    if isinstance(tree.get("vehicle"), str):
        vehicle = Path(mission.source).parent / tree["vehicle"]
        tree["vehicle"] = Path(os.path.relpath(vehicle.resolve(), path.resolve().parent)).as_posix()
    head = f"# {Path(mission.source).name} with its walls as measured by `dart-flight survey`.\n"
    head += "".join(f"# {line}\n" for wall in walls.values() for line in _coefficient_lines(wall))
    body = yaml.safe_dump(msgspec.to_builtins(tree), sort_keys=False, default_flow_style=None, width=110)
    with report_write_errors(path):
        path.write_text(head + body, encoding="utf-8")
    try:
        check_segments_clear(load_mission(path, arguments.config, arguments.set))
    except (InputError, NoApproachError) as error:
        return str(error)
    return None


def _coefficient_lines(wall: MeasuredWall) -> Iterator[str]:
    """Yield a wall's estimated coefficients, one line per mode; the user enters them under `materials`."""
    for mode, found in wall.coefficients.items():
        figures = ", ".join(f"{name} {value:.4g} ± {100.0 * sd:.0f} %" for name, (value, sd) in found.items())
        yield f"{wall.name}, {mode}: {figures}"


def _table(walls: list[MeasuredWall]) -> Table:
    table = Table("wall", "centre, m", "normal", "± m", "± deg", "material", "error m", "error deg")
    for wall in walls:
        (x, y), (nx, ny) = wall.point_m, wall.normal
        table.add_row(
            wall.name,
            f"({x:.3f}, {y:.3f})",
            f"({nx:.3f}, {ny:.3f})",
            figure_or_dash(wall.position_sd_m, 3),
            figure_or_dash(wall.yaw_sd_deg, 2),
            wall.material or "none known",
            figure_or_dash(wall.truth_error_m, 3),
            figure_or_dash(wall.truth_error_deg, 2),
        )
    return table
