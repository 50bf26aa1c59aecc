"""`dart-flight plan SCENARIO -o MISSION`: choose modes and pre-collision velocities."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator
from pathlib import Path

import rich.progress

from dart_flight.cli import EXIT_INTERRUPTED
from dart_flight.cli.flight_progress import FlightProgress
from dart_flight.cli.mission_picture import add_plot_option, write_picture
from dart_flight.cli.options import add_set_option, link_of, whole_number
from dart_flight.cli.terminal import emit_json, messages, print_status, tables
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.mission_file import FlownRecord
from dart_flight.lab.search import flown_plan
from dart_flight.lab.search.flown_plan import Done, FlightWatch, PlanChoice, fly_mission, fly_on_all_cores
from dart_flight.lab.search.mission_writer import RefusedPlanError, planned_mission, write_mission
from dart_flight.lab.search.plan import Plan, SearchResult
from dart_flight.lab.search.plan_table import (
    describe_quickest,
    plan_summary,
    plan_table,
    quickest_table,
    refusal_table,
    with_objective,
)
from dart_flight.lab.search.quickest import plan_quickest
from dart_flight.lab.search.scenario import Objective, Scenario, load_scenario
from dart_flight.lab.search.search import Progress, search
from dart_flight.planning.predicted_flight import describe_goal_miss
from dart_flight.recording.verdict import Verdict
from dart_flight.run.many_flights import RunsInterruptedError

_LINE_EVERY_S = 5.0  # interval between progress lines if the output is not a terminal
NOT_VERIFIED = "not flown in simulation (--no-verify): the plan may not be flyable"


def configure(parser: argparse.ArgumentParser) -> None:
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
    top = max(arguments.top, arguments.rank)
    with _search_bar() as progress:
        result = search(scenario, top, arguments.seed, progress)
    print_vehicle(scenario.vehicle_source, arguments)
    if not arguments.json:
        for table in (plan_table(result), refusal_table(result)):
            tables().print(table)
    plan, mission, refused = _first_flyable(result, min(arguments.rank, len(result.plans)))
    print_status(*(f"plan {rank} is refused: {reason}" for rank, reason in refused.items()))
    if not arguments.json:
        tables().print(f"plan {plan.rank} {describe_goal_miss(plan.goal_miss_m, scenario.spec.goal)}")
    record, status = None, 0
    if arguments.output is not None and arguments.verify:
        with _Watch(not arguments.json) as watch:
            try:
                record = fly_mission(mission, watch, watch.fly, f"plan {plan.rank}").record
            except RunsInterruptedError:
                status = watch.end(arguments.output)
    if record is not None and record.failure is not None:
        print_status(
            f"plan {plan.rank} fails in simulation: {record.failure}", *_ways_out(plan, result, record)
        )
    elif record is not None and not arguments.json:
        tables().print(f"plan {plan.rank} in simulation: {record.summary}", soft_wrap=True)
    elif arguments.output is not None and not arguments.verify and not arguments.json:
        print_status(NOT_VERIFIED)
    if record is not None and record.danger is not None:
        status = 1
    if status == 0 and arguments.output is not None:
        write_mission(scenario, plan, arguments.output, record)
        console.print(f"plan {plan.rank} written to {arguments.output}", soft_wrap=True)
        _warn_about_settings(arguments)
    if status == 0 and arguments.plot is not None:
        write_picture(mission, arguments.plot)
    if arguments.json:
        emit_json({**plan_summary(result, refused), "flown": record})
    return status


def _ways_out(plan: Plan, result: SearchResult, record: FlownRecord) -> Iterator[str]:
    """Yield advice on a plan that fails in simulation."""
    drawn = record.drawn
    if drawn is not None and drawn.flights < flown_plan.DRAWN:
        yield f"{flown_plan.DRAWN - drawn.flights} flights were not flown: they cannot change the result"
    ways = [f"--rank {plan.rank + 1}"] if plan.rank < len(result.plans) else []
    others = {Objective.ROBUST, Objective.QUICKEST} - {result.scenario.objective}
    ways += [f"--objective {other}" for other in sorted(others)]
    kept = "" if record.danger is None else "; no mission was written (--no-verify writes it)"
    yield f"try {', '.join(ways)}, or slower approaches in `search`{kept}"


def _first_flyable(result: SearchResult, rank: int) -> tuple[Plan, Mission, dict[int, str]]:
    """Return the first plan from `rank` on that has an accepted mission, and the refused ranks."""
    refused: dict[int, str] = {}
    for plan in result.plans[rank - 1 :]:
        try:
            return plan, planned_mission(result.scenario, plan), refused
        except RefusedPlanError as error:
            refused[plan.rank] = error.reason
            last = error
    raise last


@contextlib.contextmanager
def _search_bar() -> Iterator[Progress]:
    """Yield the search's progress callback, which moves a progress bar if the output is a terminal."""
    console = messages()
    with rich.progress.Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("searching", total=None)
        yield lambda done, of: bar.update(task, completed=done, total=of)


class _Watch(FlightWatch):
    """A display of the simulated flights on standard error: their number, and each result when it is known.

    `on_output` sends the results to standard output, for calls without `--json`.
    """

    def __init__(self, on_output: bool) -> None:
        self._console = tables() if on_output else messages()
        self._progress: FlightProgress | None = None
        self._plan = self._known = ""

    def __enter__(self) -> _Watch:
        print_status(
            f"flying in simulation, nominally and in up to {flown_plan.DRAWN} drawn worlds (--no-verify "
            "skips this)"
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def begin(self, plan: str) -> None:
        self._close()
        self._progress = FlightProgress(messages(), flown_plan.DRAWN, plan, _LINE_EVERY_S)
        self._progress.__enter__()
        self._progress(0, 0)
        self._plan, self._known = plan, ""

    def landed(self, flown: int, failed: int) -> None:
        if self._progress is not None:
            self._progress(flown, failed)
        self._known = f"; {self._plan}: {flown - failed} of {flown} flights in drawn worlds completed"

    def report(self, line: str) -> None:
        self._close()
        self._console.print(line, soft_wrap=True)

    def fly(self, mission: Mission, seeds: list[int], spreads: dict[str, float], done: Done) -> list[Verdict]:
        return fly_on_all_cores(mission, seeds, spreads, done, self._interrupted)

    def end(self, output: Path | None) -> int:
        """Report the results known at an interrupt, and return the exit status."""
        self._close()
        kept = "" if output is None else f"; {output} was not written"
        print_status(f"interrupted during the simulated flights{self._known}{kept}")
        return EXIT_INTERRUPTED

    def _interrupted(self, under_way: int) -> None:
        (self._progress or FlightProgress(messages(), 1)).interrupted(under_way)

    def _close(self) -> None:
        if self._progress is not None:
            self._progress.__exit__()
            self._progress = None


def _warn_about_settings(arguments: argparse.Namespace) -> None:
    if arguments.set:
        messages().print(
            "the mission file does not contain the --set values: give the same --set when you fly",
            style="yellow",
            soft_wrap=True,
        )


def _plan_quickest(scenario: Scenario, arguments: argparse.Namespace) -> int:
    console = messages()
    with _search_bar() as progress:
        result = plan_quickest(scenario, arguments.within, progress)
    print_vehicle(scenario.vehicle_source, arguments)
    if arguments.free and result.free is None:
        raise InputError("the goal cannot be reached without a collision", source=scenario.source)
    if not arguments.json:
        tables().print(quickest_table(result))
        tables().print(describe_quickest(result), soft_wrap=True)
    watch = _Watch(not arguments.json)
    choice = PlanChoice(result, arguments.free, watch)
    status = 0
    if arguments.verify:
        with watch:
            try:
                offered = choice.run(watch.fly)
            except RunsInterruptedError:
                status = watch.end(arguments.output)
    else:
        offered = choice.skip(NOT_VERIFIED)
    if status == 0 and offered.plan is not None:
        if arguments.output is not None:
            write_mission(offered.scenario, offered.plan, arguments.output, offered.record)
            console.print(f"plan written to {arguments.output}", soft_wrap=True)
            _warn_about_settings(arguments)
        if arguments.plot is not None:
            write_picture(planned_mission(offered.scenario, offered.plan), arguments.plot)
    if arguments.json:
        found = {"flown": choice.flown, "messages": choice.messages, "refused": choice.refused}
        emit_json({**plan_summary(result), **found})
    return status or (0 if offered.plan is not None else 1)
