"""`dart-flight dry-run [MISSION]`: fly the mission in simulation."""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Callable
from functools import partial

from dart_flight.base.processes import LATE_S, measure_lateness_s
from dart_flight.base.records import Outcome
from dart_flight.cli import EXIT_INTERRUPTED
from dart_flight.cli.flight_output import (
    TOO_BUSY,
    FlightLines,
    exit_status,
    live_line_for,
    show_end,
    summary_table,
)
from dart_flight.cli.flight_progress import ONLY_NOISE, FlightProgress
from dart_flight.cli.hitl_preflight import prepare_hitl, print_hitl_exit
from dart_flight.cli.live_options import add_live_options, live_view
from dart_flight.cli.options import (
    add_emulated_mocap_option,
    add_flight_options,
    add_set_option,
    add_vary_option,
    number,
    whole_number,
)
from dart_flight.cli.px4_options import add_px4_options, position_source_of, position_warnings
from dart_flight.cli.terminal import emit_json, keep_status, messages, styled, tables
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.packages import install_command
from dart_flight.config.provenance import display_path
from dart_flight.config.vehicle import packaged
from dart_flight.planning.envelope import impact_warnings
from dart_flight.planning.positioning import effective_source
from dart_flight.recording.verdict import Verdict
from dart_flight.run.embedded import fly_embedded
from dart_flight.run.fast import fly_fast
from dart_flight.run.many_flights import RunsInterruptedError, fly_fast_many, fly_one_by_one, summarise
from dart_flight.run.prepare import as_rehearsal, load_flyable, with_driver, with_simulated_mocap
from dart_flight.run.px4_flight import fly_px4
from dart_flight.sim.draws import parse_vary
from dart_flight.sim.faults.fault_table import FaultSite, parse_mission_fault
from dart_flight.sim.pipe import FULL_SPEED, has_mavlink, require_mavlink


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "mission", nargs="?", metavar="MISSION", help="mission file (default: the packaged dual collision)"
    )
    add_flight_options(parser)
    add_px4_options(parser)
    parser.add_argument(
        "--speed",
        type=simulation_speed,
        metavar="X",
        help="limit the simulation to X times real time, 0.1 to 10, or max for no limit "
        "(default: 1, or max with --runs); not with --fast",
    )
    parser.add_argument(
        "--realtime",
        action="store_true",
        help="simulated time does not wait for this program; on a busy computer, the flight may fail "
        "(docs/time.md)",
    )
    parser.add_argument(
        "--fast", action="store_true", help="in one process, in simulated time, without MAVLink"
    )
    parser.add_argument("--seed", type=whole_number(0, 2**31 - 1), default=1, help="random seed (default 1)")
    parser.add_argument(
        "--runs",
        type=whole_number(1, 100_000),
        metavar="N",
        help="number of flights, with consecutive seeds starting at --seed",
    )
    parser.add_argument(
        "--fault",
        type=str,
        metavar="NAME[=VALUE][@PHASE]",
        help="inject a fault; with @PHASE, the fault starts with that phase (docs/faults.md)",
    )
    add_live_options(parser)
    add_set_option(parser)
    add_vary_option(parser)
    add_emulated_mocap_option(parser)


def simulation_speed(text: str) -> float:
    """Parse the value of `--speed`: a number, or `FULL_SPEED` for `max`."""
    return FULL_SPEED if text == "max" else number(0.1, 10.0)(text)


def flight_function(arguments: argparse.Namespace, mission: Mission) -> Callable[..., Verdict]:
    """Return the function that flies a mission in the selected world.

    Its keywords are `seed`, `log_dir`, `progress` and, without --fast, `viewer`.
    """
    position_from = effective_source(mission, position_source_of(arguments))
    fault = None if arguments.fault is None else parse_mission_fault(mission, arguments.fault)
    spreads = parse_vary(arguments.vary, mission.vehicle)
    of_mocap = fault is not None and fault.kind.site is FaultSite.MOCAP
    if fault is not None and (arguments.runs is not None or (arguments.px4 is not None and not of_mocap)):
        raise InputError("--fault needs a single flight, with --fast or the embedded autopilot")
    if arguments.fast and (arguments.speed is not None or arguments.realtime):
        raise InputError("--fast always runs at full speed: omit --speed and --realtime")
    if arguments.realtime and arguments.speed == FULL_SPEED:
        raise InputError("--speed max needs lockstep: omit --realtime, or give --speed a number")
    speed = arguments.speed or (1.0 if arguments.runs is None or arguments.realtime else FULL_SPEED)
    if arguments.live and (arguments.fast or arguments.runs is not None):
        raise InputError(
            "--live needs a single flight in real time; to see any flight afterwards, use `export --foxglove`"
        )
    if arguments.px4 is None and arguments.fast:
        return partial(fly_fast, fault=fault, spreads=spreads)
    require_mavlink()
    if arguments.hitl is not None:
        return prepare_hitl(arguments, mission, position_from, spreads)
    if arguments.px4 is None:
        realtime = is_realtime(arguments, mission)
        return partial(
            fly_embedded, deadman=True, fault=fault, spreads=spreads, speed=speed, realtime=realtime
        )

    from dart_flight.sim.px4.installation import find_install

    find_install(arguments.px4)
    return partial(
        fly_px4,
        directory=arguments.px4,
        position_from=position_from,
        speed=speed,
        realtime=arguments.realtime,
        parameter_files=tuple(arguments.params or ()),
        spreads=spreads,
        fault=fault,
    )


def with_emulated_mocap(arguments: argparse.Namespace, mission: Mission) -> Mission:
    """Return the mission with the emulated motion capture that `--mocap` names, or with none.

    Raises:
        InputError: there is no such motion capture, or it does not fit the other options.
    """
    if arguments.mocap is not None and arguments.hitl is not None:
        raise InputError("--mocap and --hitl exclude each other")
    return with_simulated_mocap(mission, arguments.mocap, position_source_of(arguments))


def is_realtime(arguments: argparse.Namespace, mission: Mission) -> bool:
    """Return whether simulated time advances without waiting for this program."""
    if arguments.hitl is not None or arguments.realtime:
        return True
    if arguments.fault is None or arguments.fast:
        return False
    return parse_mission_fault(mission, arguments.fault).kind.needs_real_time


def _leaves_world_open(arguments: argparse.Namespace) -> bool:
    """Return whether the user has chosen neither a mission nor anything that only one world offers."""
    chosen = (arguments.mission, arguments.fast, arguments.live, arguments.realtime, arguments.speed)
    return not any(chosen) and arguments.px4 is None and arguments.hitl is None


def run(arguments: argparse.Namespace) -> int:
    path = arguments.mission or packaged("missions", "dual_collision.yaml")
    falls_back = not has_mavlink() and _leaves_world_open(arguments)
    arguments.fast = arguments.fast or falls_back
    mission = load_flyable(path, arguments.config, arguments.set)
    mission = as_rehearsal(with_driver(mission, arguments.driver), arguments.standoff)
    mission = with_emulated_mocap(arguments, mission)
    fly = flight_function(arguments, mission)
    console = messages()
    if arguments.mission is None:
        console.print(
            "flying the packaged dual collision; `dart-flight init DIR` copies it and other missions"
        )
    if falls_back:
        console.print(f"flying with --fast, because pymavlink is not installed ({install_command('sim')})")
    print_vehicle(mission.flown_vehicle(), arguments)
    warnings = [
        *impact_warnings(mission),
        *position_warnings(effective_source(mission, position_source_of(arguments))),
    ]
    realtime = is_realtime(arguments, mission)
    if realtime and not arguments.realtime and arguments.hitl is None:
        warnings.append(
            f"the fault {arguments.fault} affects time or link: this flight runs in real time, not in "
            "lockstep"
        )
    late_s = measure_lateness_s() if realtime else 0.0
    if late_s > LATE_S:
        warnings.append(f"this program lags by up to {late_s * 1e3:.0f} ms: {TOO_BUSY}")
    for line in warnings:
        console.print(line, style="yellow", soft_wrap=True)
    return _fly_one(arguments, mission, fly) if arguments.runs is None else _fly_many(arguments, mission, fly)


def _fly_one(arguments: argparse.Namespace, mission: Mission, fly: Callable[..., Verdict]) -> int:
    console = messages()
    live_line = None if arguments.fast else live_line_for(mission, console)
    lines = FlightLines(console, arguments.verbose > 0, live_line)
    with live_view(arguments, mission) as live, contextlib.closing(lines):
        seen = {} if live is None else {"viewer": live}
        began_s = time.monotonic()
        verdict = fly(mission, seed=arguments.seed, log_dir=arguments.log_dir, progress=lines, **seen)
        if verdict.speed is None and verdict.flight_time_s is not None:
            # Host time includes the start of the simulated vehicle.
            verdict.speed = verdict.flight_time_s / (time.monotonic() - began_s)
    show_end(verdict, console, arguments.json)
    if arguments.hitl is not None:
        print_hitl_exit()
    return exit_status(verdict)


def _fly_many(arguments: argparse.Namespace, mission: Mission, fly: Callable[..., Verdict]) -> int:
    """Fly all seeds and show the summary; after an interrupt, summarize the flights so far."""
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    landed: list[Verdict] = []
    if not arguments.vary:
        messages().print(ONLY_NOISE, soft_wrap=True)
    with FlightProgress(messages(), arguments.runs) as progress:
        progress(0, 0)

        def done(verdict: Verdict) -> None:
            landed.append(verdict)
            progress(len(landed), sum(v.outcome is not Outcome.COMPLETED for v in landed))

        try:
            if arguments.fast:
                spreads = parse_vary(arguments.vary, mission.vehicle)
                verdicts = fly_fast_many(
                    mission, seeds, arguments.log_dir, done, spreads, progress.interrupted
                )
            else:
                verdicts = fly_one_by_one(
                    lambda seed, look: fly(mission, seed=seed, log_dir=arguments.log_dir, progress=look),
                    seeds,
                    done,
                )
        except RunsInterruptedError as stopped:
            return _show_runs(arguments, mission, stopped.verdicts, interrupted=True)
    return _show_runs(arguments, mission, verdicts, interrupted=False)


def _show_runs(
    arguments: argparse.Namespace, mission: Mission, verdicts: list[Verdict], interrupted: bool
) -> int:
    console = messages()
    summary = summarise(verdicts)
    if interrupted:
        console.print(
            styled(("interrupted", "red"), f": {len(verdicts)} of {arguments.runs} flights were flown")
        )
    with keep_status(f"{summary.completed} of {summary.runs} completed"):
        if arguments.json:
            emit_json(
                {
                    "runs": verdicts,
                    "summary": summary,
                    "interrupted": interrupted,
                    "log_dir": display_path(arguments.log_dir),
                    "vehicle": mission.flown_vehicle(),
                }
            )
        else:
            tables().print(summary_table(summary))
    if verdicts:
        console.print(f"logs: {len(verdicts)} flights in {display_path(arguments.log_dir)}", soft_wrap=True)
    cut = [verdict for verdict in verdicts if verdict.log_failure is not None]
    if cut:
        line = styled((f"{len(cut)} logs are incomplete", "red"), f": {cut[0].log_failure}")
        console.print(line, soft_wrap=True)
    if interrupted:
        return EXIT_INTERRUPTED
    for seed, found in summary.unexplained_modes.items():
        console.print(
            f"seed {seed}: {'; '.join(found)}; no fault of the lock was simulated",
            style="red",
            soft_wrap=True,
        )
    return 0 if summary.completed == summary.runs and not (summary.unexplained_modes or cut) else 1
