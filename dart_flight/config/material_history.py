"""History of the identified coefficients, with dates, in a file beside the vehicle's configuration.

`dart-flight series apply` adds entries, and `check` reports the age of the newest entry of each material.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from dart_flight.config.document import Document
from dart_flight.config.file_kinds import HISTORY
from dart_flight.config.section import Section


class AppliedCoefficient(Section, frozen=True):
    """A coefficient with its 95 % interval, which includes the allowance for systematic errors."""

    value: float
    low: float
    high: float


class HistoryEntry(Section, frozen=True, kw_only=True):
    """The coefficients of one material and mode, as applied on one day.

    Attributes:
        date: day of the last hit, YYYY-MM-DD.
        hits: number of hits used.
        coefficients: k, f, mu and nu.
        software: version that identified them.
        series: folder of the series.
    """

    date: Annotated[str, Meta(pattern=r"^\d{4}-\d\d-\d\d$")]
    material: str
    mode: str
    hits: Annotated[int, Meta(ge=0)]
    coefficients: dict[str, AppliedCoefficient]
    software: str
    series: str = ""

    @property
    def day(self) -> datetime.date:
        return datetime.date.fromisoformat(self.date)


class HistoryFile(Section, frozen=True):
    """The history file; its entries are in the order in which they were applied."""

    version: Literal[1] = 1
    applied: tuple[HistoryEntry, ...] = ()


def history_path(config: Path) -> Path:
    """Return the history's path for a configuration `NAME.yaml`: `NAME.history.yaml` in the same folder."""
    return config.with_name(f"{config.stem}{HISTORY}.yaml")


def read_history(config: Path) -> tuple[HistoryEntry, ...]:
    """Return the entries of a configuration's history; without the file, the result is empty."""
    path = history_path(config)
    return Document.load(path).convert(HistoryFile).applied if path.exists() else ()


def newest_entry(entries: Sequence[HistoryEntry], material: str, mode: str) -> HistoryEntry | None:
    found = [one for one in entries if (one.material, one.mode) == (material, mode)]
    return max(found, key=lambda one: one.date, default=None)
