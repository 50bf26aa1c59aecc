"""Measurements of the manual: specifications NAME.yaml, flown by the engine of `dart-flight campaign`.

    python -m tools.campaigns NAME [--runs N] [--only KEY=VALUE] [--resume]
    python -m tools.campaigns                   # all that need no extra software (`make campaign`)

The table is written to build/campaigns/NAME, with the page that NAME.py makes of it. An interrupted campaign
continues with --resume.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from pathlib import Path

import msgspec
from rich.console import Console

from dart_flight.base.errors import FlightError
from dart_flight.config.document import InputError
from dart_flight.lab.campaign import campaign_folder as campaigns
from dart_flight.lab.campaign.campaign_spec import CampaignSpec, cases_of, load_specification
from dart_flight.run.workers import Interrupt, usable_cores
from dart_flight.sim.px4.installation import ENVIRONMENT
from tools.campaigns.results import ROOT

HERE = Path(__file__).parent
NAMES = sorted(path.stem for path in HERE.glob("*.yaml"))
# Without those that need PX4, or the extra `mutants` and hours.
USUAL = [name for name in NAMES if not name.startswith(("px4", "mutants"))]


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
    opened = campaigns.open_campaign(
        campaign, options.out or ROOT / "build" / "campaigns" / name, options.resume
    )
    engine = campaigns.fly_locally(options.jobs)
    if options.scheduler is not None:
        from dart_flight.lab.campaign.cluster import on_cluster  # noqa: PLC0415

        engine = on_cluster(options.scheduler)
    console = Console(stderr=True)

    def show(rows: int, _: int) -> None:
        if rows % 20 == 0:
            console.print(f"{name}: {rows} of {opened.flights}")

    with Interrupt() as interrupt:
        completed = campaigns.fly(opened, engine, interrupt, show)
    if completed < opened.flights:
        console.print(f"interrupted: {completed} of {opened.flights}; continue with --resume")
        return 130
    rows = campaigns.read_rows(opened)
    text = importlib.import_module(f"tools.campaigns.{name}").page([r for r in rows if r.row is not None])
    failed = [f"- error: {row.values} seed {row.seed}: {row.error}" for row in rows if row.error]
    text = "\n".join([text, *failed])
    (opened.folder / "page.md").write_text(text + "\n", "utf-8")
    print(text)
    return 1 if failed else 0


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
    parser.add_argument("--px4", metavar="DIR", help="build of PX4 SITL")
    parser.add_argument("--out", type=lambda text: Path(text).resolve(), metavar="DIR")
    parser.add_argument("--resume", action="store_true")
    options = parser.parse_args()
    if options.px4 is not None:
        os.environ[ENVIRONMENT] = str(Path(options.px4).resolve())
        options.jobs = 1  # PX4 needs the whole computer
    os.chdir(ROOT)
    status = 0
    try:
        for name in [options.name] if options.name else USUAL:
            status = measure(options, name) or status
    except (InputError, FlightError) as error:
        sys.stderr.write(f"{error.one_line() if isinstance(error, InputError) else error}\n")
        return 2
    return status


if __name__ == "__main__":
    sys.exit(main())
