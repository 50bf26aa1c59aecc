"""Measurements of the manual: specifications NAME.yaml, flown by the engine of `dart-flight campaign`.

    python -m tools.campaigns NAME [--runs N] [--only KEY=VALUE] [--resume]
    python -m tools.campaigns                   # all that need no extra software (`make campaign`)
    python -m tools.campaigns --list            # the measurements of each page of results
    python -m tools.campaigns --estimate [NAME] # how long a campaign would take here

The rows are written to build/campaigns/NAME. A complete campaign writes the tables that NAME.py makes of them
into the pages of docs/results that have a block of this name; with --only or --out, it prints them. An
interrupted campaign continues with --resume.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec
from rich.console import Console

from dart_flight.base.errors import FlightError
from dart_flight.config.document import InputError
from dart_flight.lab.campaign import campaign_folder as campaigns
from dart_flight.lab.campaign.campaign_spec import (
    CampaignSpec,
    campaign_of,
    cases_of,
    items_of,
    load_specification,
    points_of,
)
from dart_flight.lab.campaign.flight_job import ItemFlyer
from dart_flight.run.workers import Interrupt, usable_cores
from dart_flight.sim.px4.installation import ENVIRONMENT
from tools.campaigns import results
from tools.campaigns.results import ROOT

HERE = Path(__file__).parent
NAMES = sorted(path.stem for path in HERE.glob("*.yaml"))
# The others need PX4, or the extra `mutants` and several hours.
USUAL = [name for name in NAMES if not name.startswith(("px4", "mutants"))]
# These need the whole computer for one flight.
ALONE = ("px4", "busy_computer", "deadman")


def load_campaign(options: argparse.Namespace, name: str) -> CampaignSpec:
    """Return the specification of a name, with the changes from the command line.

    Raises:
        InputError: the file is invalid, or no case is left.
    """
    campaign = load_specification(HERE / f"{name}.yaml")
    changes = {key: value for key in ("runs", "seed") if (value := getattr(options, key)) is not None}
    if options.only:
        wanted = dict(pair.split("=", 1) for pair in options.only)
        left = [case for case in cases_of(campaign) if wanted.items() <= case.items()]
        if not left:
            raise InputError(f"--only {' '.join(options.only)}: no such case in {name}.yaml")
        changes["cases"] = tuple(left)
    return msgspec.structs.replace(campaign, **changes)


def measure(options: argparse.Namespace, name: str) -> int:
    """Fly a campaign and write its page; return 1 if a row has a program error, 130 if interrupted.

    Raises:
        InputError, FlightError: as `campaigns.open_campaign` and `campaigns.fly`.
    """
    campaign = load_campaign(options, name)
    pages = [] if options.only or options.out else results.pages_with(name)
    commit = results.current_commit() if pages else ""
    jobs = 1 if name.startswith(ALONE) else options.jobs
    opened = campaigns.open_campaign(
        campaign, options.out or ROOT / "build" / "campaigns" / name, options.resume
    )
    engine = campaigns.fly_locally(jobs)
    if options.scheduler is not None:
        from dart_flight.lab.campaign.cluster import on_cluster  # noqa: PLC0415

        engine = on_cluster(options.scheduler)
    console = Console(stderr=True)

    def show(rows: int, _: int) -> None:
        if rows % 20 == 0:
            console.print(f"{name}: {rows} of {opened.flights}")

    began_s = time.monotonic()
    with Interrupt() as interrupt:
        completed = campaigns.fly(opened, engine, interrupt, show)
    spent_s = _add_session(opened.folder, time.monotonic() - began_s)
    if completed < opened.flights:
        console.print(f"interrupted: {completed} of {opened.flights} flights; continue with --resume")
        return 130
    rows = campaigns.read_rows(opened)
    text = importlib.import_module(f"tools.campaigns.{name}").page([r for r in rows if r.row is not None])
    sentence, faults = results.without_result([row.error for row in rows if row.error], len(rows))
    failed = [
        f"- error: {row.mission} {row.values} seed {row.seed}: {row.error}"
        for row in rows
        if row.error in faults
    ]
    text = "\n".join([text, *([sentence] if sentence else []), *failed])
    (opened.folder / "page.md").write_text(text + "\n", "utf-8")
    print(text)
    if not failed:
        command = f"python -m tools.campaigns {name}{_options_shown(options, name)}"
        for page in pages:
            head = results.measured_line(command, commit, f"{len(rows)} runs", spent_s)
            results.write_block(page, name, f"{head}\n\n{text}")
    return 1 if failed else 0


def _options_shown(options: argparse.Namespace, name: str) -> str:
    """Return the options that a page names, without a folder of this computer."""
    given = [(key, getattr(options, key)) for key in ("runs", "seed")]
    shown = "".join(f" --{key} {value}" for key, value in given if value is not None)
    return f"{shown} --px4 DIR" if name.startswith("px4") else shown


def _add_session(folder: Path, seconds: float) -> float:
    """Add a session's duration to the campaign's folder and return the sum of all sessions, seconds."""
    path = folder / "seconds"
    spent_s = seconds + (float(path.read_text("utf-8")) if path.exists() else 0.0)
    path.write_text(f"{spent_s:.1f}\n", "utf-8")
    return spent_s


def show_list() -> int:
    """Print the measurements of the pages. Return 1 if a page has none of this commit's history."""
    status = 0
    print("page                   date        commit    later  duration  command")
    for found in results.measurements():
        status = max(status, int(found.later is None))
        later = "?" if found.later is None else str(found.later)
        print(
            f"{found.page:22} {found.date:11} {found.commit:9} {later:>5}  {found.duration:9} {found.command}"
        )
    return status


def show_estimate(options: argparse.Namespace, names: Sequence[str]) -> int:
    """Run three items of each campaign and print how long the whole would take with `--jobs` processes.

    Raises:
        InputError: as `load_campaign`.
    """
    for name in names:
        campaign = load_campaign(options, name)
        points = points_of(campaign)
        items = list(items_of(msgspec.structs.replace(campaign, runs=1), points))
        sample = items[:: max(1, len(items) // 3)][:3]
        flyer = ItemFlyer(campaign_of(campaign, points), points)
        # Processor time does not depend on what else runs here, but some flights have several processes.
        clock_s = time.monotonic if name.startswith(ALONE) else time.process_time
        began_s = clock_s()
        for item in sample:
            flyer(item)
        each_s = (clock_s() - began_s) / len(sample)
        runs = len(points) * campaign.runs
        jobs = 1 if name.startswith(ALONE) else options.jobs
        print(f"{name}: {runs} runs, about {results.duration(each_s * runs / jobs)}")
    return 0


def main() -> int:
    """Run the campaigns named on the command line and return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("name", nargs="?", choices=NAMES)
    parser.add_argument("--runs", type=int, help="seeds of every case")
    parser.add_argument("--seed", type=int, help="first seed")
    parser.add_argument(
        "--only", action="append", default=[], metavar="KEY=VALUE", help="only matching cases"
    )
    parser.add_argument("--jobs", type=int, default=usable_cores())
    parser.add_argument("--scheduler", metavar="URL", help="Dask scheduler")
    parser.add_argument(
        "--px4", metavar="DIR", nargs="+", help="build of PX4 SITL; px4_versions takes several"
    )
    parser.add_argument("--out", type=lambda text: Path(text).resolve(), metavar="DIR")
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--list", action="store_true", help="the measurements of each page of docs/results")
    parser.add_argument("--estimate", action="store_true", help="how long a campaign would take here")
    options = parser.parse_args()
    if options.px4 is not None:
        os.environ[ENVIRONMENT] = os.pathsep.join(str(Path(folder).resolve()) for folder in options.px4)
    os.chdir(ROOT)
    status, names = 0, [options.name] if options.name else USUAL
    try:
        if options.list:
            return show_list()
        if options.estimate:
            return show_estimate(options, names)
        for name in names:
            status = measure(options, name) or status
    except (InputError, FlightError) as error:
        sys.stderr.write(f"{error.one_line() if isinstance(error, InputError) else error}\n")
        return 2
    return status


if __name__ == "__main__":
    sys.exit(main())
