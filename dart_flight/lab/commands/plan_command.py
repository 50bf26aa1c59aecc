"""`dart-flight plan SCENARIO -o MISSION`: choose modes and pre-collision velocities."""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

from rich.progress import Progress

from dart_flight.cli import EXIT_INTERRUPTED
from dart_flight.cli.mission_picture import add_plot_option, write_picture
from dart_flight.cli.options import add_set_option, link_of, whole_number
from dart_flight.cli.terminal import emit_json, messages, print_status, tables
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError
from dart_flight.lab.search.flown_plan import (
    Done,
    OfferedPlan,
    choose_flown,
    fly_mission,
)
from dart_flight.lab.search.limited_sight import plan_limited_sight
from dart_flight.lab.search.mission_writer import planned_mission, write_mission
from dart_flight.lab.search.plan_table import (
    describe_quickest,
    plan_summary,
    plan_table,
    quickest_summary,
    quickest_table,
    refusal_table,
    with_objective,
)
from dart_flight.lab.search.quickest import plan_quickest
from dart_flight.lab.search.scenario import Objective, Scenario, load_scenario
from dart_flight.lab.search.search import search
from dart_flight.planning.predicted_flight import describe_goal_miss
from dart_flight.recording.verdict import Verdict
from dart_flight.run.many_flights import RunsInterruptedError

NOT_VERIFIED = "not flown in simulation (--no-verify): the plan may not be flyable"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("scenario", metavar="SCENARIO", help="scenario file, see missions/scenarios/")
    parser.add_argument("-o", "--output", type=Path, metavar="MISSION", help="mission file to write")
    parser.add_argument(
        "--objective",
        type=Objective,
        choices=list(Objective),
        metavar="OBJECTIVE",
        help="objective that replaces the objective of the scenario: " + ", ".join(Objective),
    )
    parser.add_argument(
        "--top", type=whole_number(1, 1000), default=10, metavar="N", help="plans to list (10)"
    )
    parser.add_argument(
        "--rank", type=whole_number(1, 1000), default=1, metavar="R", help="plan to write (1)"
    )
    parser.add_argument(
        "--within",
        type=float,
        default=60.0,
        metavar="S",
        help="for the objective quickest: stop the search after S seconds and return the best plan "
        "(default 60)",
    )
    parser.add_argument(
        "--free",
        action="store_true",
        help="for the objective quickest: write and draw the plan without a collision",
    )
    parser.add_argument(
        "--seed",
        type=whole_number(0, 2**31 - 1),
        default=1,
        help="random seed of the objective robust (default 1)",
    )
    parser.add_argument(
        "--no-verify",
        dest="verify",
        action="store_false",
        help="do not fly the plan in simulation first",
    )
    add_plot_option(parser)
    parser.add_argument(
        "--connection",
        metavar="URL",
        help="read PX4's parameters from the vehicle instead of the configuration",
    )
    add_set_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return the exit status."""
    try:
        return _plan(arguments)
    except RunsInterruptedError:
        print_status("interrupted during the simulated flights; nothing was written")
        return EXIT_INTERRUPTED


def _plan(arguments: argparse.Namespace) -> int:
    console = messages()
    scenario = load_scenario(arguments.scenario, arguments.config, settings=arguments.set)
    if arguments.connection is not None:
        from dart_flight.lab.search.scenario import with_vehicle_parameters
        from dart_flight.vehicle.link import LinkLease

        url = link_of(arguments, scenario.vehicle.connection)
        with LinkLease(url, "plan"):
            scenario = with_vehicle_parameters(scenario, url)
    if arguments.objective is not None:
        scenario = with_objective(scenario, arguments.objective)
    if scenario.objective is Objective.QUICKEST:
        return _plan_quickest(scenario, arguments)
    if arguments.free:
        raise InputError("--free needs the objective quickest", source=scenario.source)
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("trajectories", total=None)
        top = max(arguments.top, arguments.rank)
        result = search(
            scenario, top, arguments.seed, lambda done, of: bar.update(task, completed=done, total=of)
        )
    print_vehicle(scenario.vehicle_source, arguments)
    plan = result.plans[min(arguments.rank, len(result.plans)) - 1]
    record = None
    if arguments.output is not None and arguments.verify:
        with Progress(console=console, transient=True) as bar:
            record = fly_mission(planned_mission(scenario, plan), _show_flights(bar)).record
    if arguments.output is not None:
        write_mission(scenario, plan, arguments.output, record)
        console.print(f"plan {plan.rank} written to {arguments.output}", soft_wrap=True)
        _warn_about_settings(arguments)
    if arguments.plot is not None:
        write_picture(planned_mission(scenario, plan), arguments.plot)
    if arguments.json:
        emit_json({**plan_summary(result), "flown": record})
    else:
        for table in (plan_table(result), refusal_table(result)):
            tables().print(table)
        tables().print(f"plan {plan.rank} {describe_goal_miss(plan.goal_miss_m, scenario.spec.goal)}")
        if record is not None and record.failure is not None:
            print_status(f"plan {plan.rank} fails in simulation: {record.failure}")
        elif record is not None:
            tables().print(f"plan {plan.rank} in simulation: {record.summary}", soft_wrap=True)
        elif arguments.output is not None:
            print_status(NOT_VERIFIED)
    return 0


def _warn_about_settings(arguments: argparse.Namespace) -> None:
    if arguments.set:
        messages().print(
            "[yellow]the mission file does not contain the --set values: give the same --set when you fly "
            "the mission[/]",
            soft_wrap=True,
        )


def _show_flights(bar: Progress) -> Done:
    """Announce the simulated flights and return a callback that counts them."""
    print_status("flying the plan in simulation, nominally and in 20 drawn worlds (--no-verify skips this)")
    task, flown = bar.add_task("simulated flights", total=None), itertools.count(1)

    def done(_: Verdict) -> None:
        bar.update(task, advance=1, description=f"simulated flights: {next(flown)}")

    return done


def _plan_quickest(scenario: Scenario, arguments: argparse.Namespace) -> int:
    """Search for the quickest flight, fly it in simulation and write it; return the exit status."""
    console = messages()
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("sequences", total=None)

        def progress(done: int, of: int) -> None:
            bar.update(task, completed=done, total=of)

        if scenario.sight is not None:
            result = plan_limited_sight(scenario, progress)
        else:
            result = plan_quickest(scenario, arguments.within, progress)
    print_vehicle(scenario.vehicle_source, arguments)
    if arguments.free and result.free is None:
        raise InputError("the goal cannot be reached without a collision", source=scenario.source)
    offered = OfferedPlan(result.free if arguments.free else result.best, scenario, None, [NOT_VERIFIED], {})
    if arguments.verify:
        with Progress(console=console, transient=True) as bar:
            offered = choose_flown(result, arguments.free, _show_flights(bar))
    if offered.plan is not None:
        if arguments.output is not None:
            write_mission(offered.scenario, offered.plan, arguments.output, offered.record)
            console.print(f"plan written to {arguments.output}", soft_wrap=True)
            _warn_about_settings(arguments)
        if arguments.plot is not None:
            write_picture(planned_mission(offered.scenario, offered.plan), arguments.plot)
    if arguments.json:
        emit_json({**quickest_summary(result), "flown": offered.flown, "says": offered.says})
    else:
        tables().print(quickest_table(result))
        tables().print(describe_quickest(result), soft_wrap=True)
        for line in offered.says:
            tables().print(line, soft_wrap=True)
    return 0 if offered.plan is not None else 1
