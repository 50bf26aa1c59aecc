"""`dart-flight campaign MISSION... --runs N --out DIR`: many flights and their summary."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.cli import EXIT_INTERRUPTED
from dart_flight.cli.flight_progress import ONLY_NOISE, FlightProgress
from dart_flight.cli.options import add_vary_option, whole_number
from dart_flight.cli.terminal import emit_json, keep_status, messages, styled, tables
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError

_MAX_SHOWN = 5  # maximum number of lines shown of each kind; page and summary contain all lines


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "missions",
        nargs="*",
        metavar="MISSION",
        help="mission files; with --resume, give the same files again, or no file",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the campaign")
    parser.add_argument(
        "--runs",
        type=whole_number(1, 10_000_000),
        metavar="N",
        help="number of seeds for each mission and setting",
    )
    parser.add_argument("--seed", type=whole_number(0, 2**31 - 1), metavar="S", help="first seed (default 1)")
    add_vary_option(parser)
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=V1,V2,...",
        help="configuration key and its values (repeatable); the campaign flies every combination",
    )
    parser.add_argument("--resume", action="store_true", help="resume the campaign in --out")
    parser.add_argument(
        "--keep",
        choices=("failed", "all", "none"),
        help="logs to keep in DIR/logs: those of failed flights (default), all, or none",
    )
    parser.add_argument(
        "--jobs", type=whole_number(1, 1024), metavar="N", help="processes (default: one per core)"
    )
    parser.add_argument(
        "--scheduler", metavar="URL", help="run on the workers of a Dask scheduler, tcp://host:8786"
    )


def run(arguments: argparse.Namespace) -> int:
    from dart_flight.lab.campaign import campaign_folder as campaigns
    from dart_flight.lab.campaign.campaign_summary import summarise
    from dart_flight.lab.report.campaign_page import campaign_page
    from dart_flight.planning.envelope import impact_warnings
    from dart_flight.run.workers import Interrupt, usable_cores

    console = messages()
    if arguments.scheduler is not None and arguments.jobs is not None:
        raise InputError("--jobs applies to this computer; omit it with --scheduler", key=("--jobs",))
    opened = campaigns.open_campaign(_requested_campaign(arguments), arguments.out, arguments.resume)
    if opened.campaign.asked.makes_row:
        raise InputError(
            "a function of another program evaluates these flights: resume the campaign with that program",
            source=str(opened.folder),
        )
    if arguments.scheduler is not None:
        from dart_flight.lab.campaign.cluster import on_cluster

        engine = on_cluster(arguments.scheduler)
    else:
        engine = campaigns.fly_locally(arguments.jobs or usable_cores())
    print_vehicle(opened.points[0].mission.flown_vehicle(), arguments)
    if len(opened.points) > 1:
        console.print(f"the campaign flies {len(opened.points)} combinations of mission and settings")
    if not any(point.spreads for point in opened.points):
        console.print(ONLY_NOISE, soft_wrap=True)
    for line in dict.fromkeys(line for point in opened.points for line in impact_warnings(point.mission)):
        console.print(line, style="yellow", soft_wrap=True)
    with FlightProgress(console, opened.flights) as progress, Interrupt(progress.interrupted) as interrupt:
        flown = campaigns.fly(opened, engine, interrupt, progress)
    summary = summarise(opened)
    campaigns.write_atomically(
        opened.folder / campaigns.SUMMARY, msgspec.json.format(msgspec.json.encode(summary), indent=2) + b"\n"
    )
    try:
        page = f"page: {opened.folder / campaigns.PAGE}"
        campaigns.write_atomically(opened.folder / campaigns.PAGE, campaign_page(summary).encode())
    except InputError as error:  # the table is complete even without the page
        page = f"no page: {error.message}"
    if flown < opened.flights:
        again = shlex.join(["dart-flight", "campaign", "--resume", "--out", str(arguments.out)])
        console.print(
            styled(
                ("interrupted", "red"),
                f": {flown} of {opened.flights} flights are in the table; continue with {again}",
            ),
            soft_wrap=True,
        )
    with keep_status(f"{flown} of {opened.flights} flights are in {opened.folder}"):
        if arguments.json:
            emit_json(summary)
        else:
            tables().print(_table(summary))
    if not arguments.json:
        console.print(page, soft_wrap=True)
    if flown < opened.flights:
        return EXIT_INTERRUPTED
    return 1 if summary.errors or summary.unexplained_modes else 0


def _requested_campaign(arguments: argparse.Namespace) -> Any:
    """Return the specification from the command line; or None if --resume alone continues a campaign."""
    from dart_flight.lab.campaign.campaign_spec import CampaignSpec, Keep, parse_grid

    given = {
        "--config": arguments.config, "--runs": arguments.runs, "--seed": arguments.seed,
        "--vary": arguments.vary, "--set": arguments.set, "--keep": arguments.keep,
    }  # fmt: skip
    if not arguments.missions:
        if not arguments.resume:
            raise InputError("no mission given", key=("MISSION",))
        idle = next((name for name, value in given.items() if value not in (None, [])), None)
        if idle is not None:
            raise InputError(
                f"{idle} needs the mission files; "
                "--resume --out DIR alone continues with the original settings"
            )
        return None
    if arguments.runs is None:
        raise InputError("missing --runs N (number of seeds)", key=("--runs",))
    return CampaignSpec(
        missions=tuple(arguments.missions),
        config=arguments.config,
        settings=parse_grid(arguments.set),
        vary=tuple(arguments.vary),
        runs=arguments.runs,
        seed=1 if arguments.seed is None else arguments.seed,
        keep=Keep(arguments.keep or Keep.FAILED),
    )


def _table(summary: Any) -> Any:
    from rich.table import Table

    rate = summary.completed
    table = Table(title=f"{rate.count} of {rate.of} completed", title_justify="left")
    for column in ("", "flights", "completed", "95 % interval"):
        table.add_column(column, justify="left" if not column else "right")
    for point in summary.points:
        name = " ".join((point.mission, *(f"{key}={value}" for key, value in point.settings.items())))
        table.add_row(name, str(point.completed.of), *point.completed.words("-"))
    if summary.plan_followed.of:
        table.add_row("plan followed", str(summary.plan_followed.of), *summary.plan_followed.words("-"))
    for one in summary.not_followed[:_MAX_SHOWN]:
        flown = "not flown" if one.flown is None else f"{_short(one.flown)} flown"
        planned = f"  off the plan: {one.what}: {_short(one.planned)} planned, {flown}"
        table.add_row(planned, str(one.flights), "", "")
    for rule in summary.rules:
        table.add_row(styled((rule.rule, "red")), str(rule.flights), "", "")
    for flight in summary.unexplained_modes[:_MAX_SHOWN]:
        line = f"{flight.mission}, seed {flight.seed}: {flight.reason}; no fault of the lock was simulated"
        table.add_row(styled((line, "red")), "", "", "")
    return table


def _short(value: float | str) -> str:
    return f"{value:.2f}" if isinstance(value, float) else value
