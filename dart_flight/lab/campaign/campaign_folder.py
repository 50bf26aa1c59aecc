"""A campaign from its first flight to its last, also in several goes."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import NamedTuple

import msgspec

from dart_flight.base.errors import FlightError
from dart_flight.config.document import InputError, read_text
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

# Flies items side by side wherever, results as they land; begins no further one after an interrupt.
Landings = Generator[FinishedItem[Item, Flown], None, None]
Engine = Callable[[ItemFlyer, Iterable[Item], Interrupt], Landings]


class CampaignFolder(NamedTuple):
    """A campaign and its folder."""

    folder: Path
    campaign: Campaign
    points: list[Point]

    @property
    def flights(self) -> int:
        """How many there are in all."""
        return self.campaign.asked.runs * len(self.points)

    def log_of(self, item: Item) -> Path:
        """Where a flight's log is, if it is kept."""
        return self.folder / LOGS / log_name(self.points[item.point - 1], item.seed) / LOG_NAME


def open_campaign(asked: CampaignSpec | None, folder: Path, resume: bool) -> CampaignFolder:
    """Begin a campaign, or find the one that is to go on.

    Args:
        asked: what is to be flown; None: what the folder's campaign was asked.
        folder: of the campaign.
        resume: go on with what is there.

    Raises:
        InputError: in what is asked; there is a campaign already and it is not to go on, or it is another.
        FlightError: the folder cannot be written.
    """
    path = folder / ASKED
    if not path.exists():
        if asked is None:
            raise InputError("no campaign to resume here; give mission files", source=str(folder))
        return _begin(asked, folder)
    if not resume:
        raise InputError("a campaign exists here already; use --resume to continue it", source=str(path))
    kept = _read(path)
    taken = asked or kept.asked
    points = points_of(taken)
    wanted = campaign_of(taken, points)
    problem = difference(kept, wanted)
    if problem is not None:
        raise InputError(f"is a different campaign: {problem}", source=str(path))
    if wanted.asked.runs > kept.asked.runs:
        _write(path, wanted)
    return CampaignFolder(folder, wanted, points)


def _begin(asked: CampaignSpec, folder: Path) -> CampaignFolder:
    points = points_of(asked)
    campaign = campaign_of(asked, points)
    if (folder / TABLE).exists():
        raise InputError(
            "results table without its campaign.json; choose another folder", source=str(folder / TABLE)
        )
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError("folder is not empty; choose a new one", source=str(folder), key=("--out",))
    _write(folder / ASKED, campaign)
    return CampaignFolder(folder, campaign, points)


def _read(path: Path) -> Campaign:
    try:
        return msgspec.json.decode(read_text(path), type=Campaign)
    except msgspec.MsgspecError as error:
        raise InputError(f"is no campaign: {error}", source=str(path)) from None


def _write(path: Path, campaign: Campaign) -> None:
    write_atomically(path, msgspec.json.format(msgspec.json.encode(campaign), indent=2) + b"\n")


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file, whole or not at all, and force it to the disk; its folder is made where there is none.

    Raises:
        FlightError: it cannot be written.
    """
    part = path.with_name(f"{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(part, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink()
        raise FlightError(f"cannot write {path}: {error.strerror}") from None


def rows_of(opened: CampaignFolder) -> list[JudgedRow]:
    """Return the rows that the judge of a campaign has made so far.

    Raises:
        InputError: the table cannot be read.
    """
    return list(judged_rows(opened.campaign, rows_in(opened.folder / TABLE)))


def fly_locally(jobs: int) -> Engine:
    """Flights in processes of this machine (`run.workers`)."""
    return lambda flyer, items, interrupt: work(flyer, items, jobs, interrupt)


def fly(
    opened: CampaignFolder,
    engine: Engine,
    interrupt: Interrupt,
    progress: Callable[[int, int], None] = lambda flown, failed: None,
) -> int:
    """Fly what has no row yet; returns how many rows there are.

    Args:
        opened: the campaign.
        engine: flies.
        interrupt: ends it early; the rows that are there stay.
        progress: called with the rows so far, and how many of this call's flights did not complete.

    Raises:
        FlightError: the disk is full, the table is being written by another process, or no process can fly.
        InputError: the table is not this campaign's.
    """
    campaign = opened.campaign
    flyer = ItemFlyer(campaign, opened.points)
    with Table(opened.folder / TABLE, campaign.columns) as table:
        have = flown_in(table.path, keys_of(campaign.asked, opened.points), opened.points)
        rows, failed = len(have), 0
        progress(rows, failed)
        missing = (item for item in items_of(campaign.asked, opened.points) if item not in have)
        # However it ends, the processes end with it.
        with contextlib.closing(engine(flyer, missing, interrupt)) as landings:
            for item, result in landings:
                flown = flyer.failed(item, result.what) if isinstance(result, Failure) else result
                if flown.log is not None:
                    # Before its row, so that a row never promises a log that is not there.
                    write_atomically(opened.log_of(item), flown.log)
                table.append(flown.line)
                rows, failed = rows + 1, failed + (not flown.completed)
                progress(rows, failed)
        table.sync()
    return rows
