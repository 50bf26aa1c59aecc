"""The folder of a campaign: creation, continuation, and the loop that flies the missing flights."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import NamedTuple

import msgspec

from dart_flight.base.errors import FlightError
from dart_flight.config.document import InputError, read_text, replace_file, write_problem
from dart_flight.lab.campaign.campaign_spec import (
    Campaign,
    CampaignSpec,
    Item,
    Point,
    campaign_of,
    difference,
    items_of,
    keys_of,
    log_name,
    points_of,
)
from dart_flight.lab.campaign.flight_job import Flown, ItemFlyer, JudgedRow, judged_rows
from dart_flight.lab.campaign.table import Table, flown_in, rows_in
from dart_flight.recording.found import LOG_NAME
from dart_flight.run.workers import Failure, FinishedItem, Interrupt, work

ASKED, TABLE, SUMMARY, PAGE, LOGS = "campaign.json", "flights.csv", "summary.json", "index.html", "logs"

# An engine flies items in parallel, yields results as flights finish and starts no flight after an interrupt.
Landings = Generator[FinishedItem[Item, Flown], None, None]
Engine = Callable[[ItemFlyer, Iterable[Item], Interrupt], Landings]


class CampaignFolder(NamedTuple):
    """An open campaign: the folder of its files, its specification and its loaded missions."""

    folder: Path
    campaign: Campaign
    points: list[Point]

    @property
    def flights(self) -> int:
        return self.campaign.asked.runs * len(self.points)

    def log_of(self, item: Item) -> Path:
        """Return the path of a flight's log, whether the log is kept or not."""
        return self.folder / LOGS / log_name(self.points[item.point - 1], item.seed) / LOG_NAME


def open_campaign(asked: CampaignSpec | None, folder: Path, resume: bool) -> CampaignFolder:
    """Create a campaign, or open an existing one to continue it if `resume` is set.

    A continued campaign must have the specification `asked`; None accepts any specification.
    """
    path = folder / ASKED
    if not path.exists():
        if asked is None:
            raise InputError("no campaign to resume here; give mission files", source=str(folder))
        return _begin(asked, folder)
    if not resume:
        raise InputError("a campaign exists here already; use --resume to continue it", source=str(path))
    kept = _read(path)
    specification = asked or kept.asked
    points = points_of(specification)
    wanted = campaign_of(specification, points)
    problem = difference(kept, wanted)
    if problem is not None:
        raise InputError(f"cannot resume this campaign: {problem}", source=str(path))
    if wanted.asked.runs > kept.asked.runs:
        _write(path, wanted)
    return CampaignFolder(folder, wanted, points)


def _begin(asked: CampaignSpec, folder: Path) -> CampaignFolder:
    points = points_of(asked)
    campaign = campaign_of(asked, points)
    if (folder / TABLE).exists():
        raise InputError(
            "the folder has a results table but no campaign.json; choose another folder",
            source=str(folder / TABLE),
        )
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError("the folder is not empty; choose a new folder", source=str(folder), key=("--out",))
    _write(folder / ASKED, campaign)
    return CampaignFolder(folder, campaign, points)


def _read(path: Path) -> Campaign:
    try:
        return msgspec.json.decode(read_text(path), type=Campaign)
    except msgspec.MsgspecError as error:
        raise InputError(f"is not a campaign file: {error}", source=str(path)) from None


def _write(path: Path, campaign: Campaign) -> None:
    write_atomically(path, msgspec.json.format(msgspec.json.encode(campaign), indent=2) + b"\n")


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file completely or not at all, flush it to the disk and create its folder if necessary."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, data)
    except OSError as error:
        raise FlightError(f"cannot write {path}: {write_problem(path, error)}") from None


def read_rows(opened: CampaignFolder) -> list[JudgedRow]:
    """Return the existing rows of a campaign with a judge function."""
    return list(judged_rows(opened.campaign, rows_in(opened.folder / TABLE)))


def fly_locally(jobs: int) -> Engine:
    """Return an engine that flies in local processes (`run.workers`)."""
    return lambda flyer, items, interrupt: work(flyer, items, jobs, interrupt)


def fly(
    opened: CampaignFolder,
    engine: Engine,
    interrupt: Interrupt,
    progress: Callable[[int, int], None] = lambda flown, failed: None,
) -> int:
    """Fly every item that has no row, and return the number of rows.

    Args:
        interrupt: the operator's interrupt, which ends the campaign early; existing rows are kept.
        progress: called with the number of rows in the table, and the number of flights of this call that did
            not complete.

    Raises:
        FlightError: the disk is full, another process writes the table, or no process can fly.
        InputError: the table belongs to another campaign.
    """
    campaign = opened.campaign
    flyer = ItemFlyer(campaign, opened.points)
    with Table(opened.folder / TABLE, campaign.columns) as table:
        have = flown_in(table.path, keys_of(campaign.asked, opened.points), opened.points)
        rows, failed = len(have), 0
        progress(rows, failed)
        missing = (item for item in items_of(campaign.asked, opened.points) if item not in have)
        # Closing the engine ends its processes, even after an exception.
        with contextlib.closing(engine(flyer, missing, interrupt)) as landings:
            for item, result in landings:
                flown = flyer.failed(item, result.what) if isinstance(result, Failure) else result
                if flown.log is not None:
                    # Write the log before its row, so that no row lacks its log.
                    write_atomically(opened.log_of(item), flown.log)
                table.append(flown.line)
                rows, failed = rows + 1, failed + (not flown.completed)
                progress(rows, failed)
        table.sync()
    return rows
