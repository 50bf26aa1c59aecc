"""One flight of a campaign, in any process. The result is a row of the table, and the log if it is kept.

A specification may name the function that flies and the function that evaluates; the default columns come
from `cells_of`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

import msgspec

from dart_flight.base.records import Outcome, Override
from dart_flight.lab.campaign.campaign_spec import (
    Campaign,
    Item,
    Keep,
    Point,
    keys_of,
    named_function,
    row_type,
)
from dart_flight.lab.csv_text import csv_text
from dart_flight.recording.found import LOG_NAME
from dart_flight.recording.plan_versus_flight import out_of_tolerance
from dart_flight.recording.reader import Log
from dart_flight.recording.verdict import Verdict
from dart_flight.recording.writer import LogPart
from dart_flight.run.fast import fly_fast
from dart_flight.run.flight_record import FlightRecord
from dart_flight.run.many_flights import unexplained_modes

ERROR = "error"  # outcome of a flight that has no verdict because of a program error
Cell = str | float | int | bool | None


class Flown(NamedTuple):
    """The result of a flight: its line in the table, whether it completed, and its log if the log is kept."""

    line: bytes
    completed: bool
    log: bytes | None


class FlownFlight(NamedTuple):
    """The input of a judge function: point, seed, verdict and log (with the truth) of a simulated flight."""

    point: Point
    seed: int
    verdict: Verdict
    log: Log


def fly_point(point: Point, seed: int) -> FlownFlight:
    """Fly the mission of a grid point in simulated time; the seed determines the draws."""
    records: list[FlightRecord] = []
    verdict = fly_fast(point.mission, seed, None, spreads=point.spreads, keep_record=records.append)
    return FlownFlight(point, seed, verdict, records[0].log)


class ItemFlyer:
    """A picklable function that flies campaign items locally or on other machines."""

    def __init__(self, campaign: Campaign, points: Sequence[Point]) -> None:
        self._columns, self._keys = campaign.columns, keys_of(campaign.asked, points)
        self._keep = campaign.asked.keep
        self._asked = campaign.asked
        self._points = {point.number: point for point in points}

    def __call__(self, item: Item) -> Flown:
        point = self._points[item.point]
        if self._asked.makes_row:
            fly: Callable[[Point, int], Any] = (
                named_function(self._asked.fly) if self._asked.fly else fly_point
            )
            flown = fly(point, item.seed)
            row = named_function(self._asked.judge)(flown) if self._asked.judge else flown
            return Flown(self._line(item, _judged_cells(row)), True, None)
        records: list[FlightRecord] = []
        keep = None if self._keep is Keep.NONE else records.append
        verdict = fly_fast(point.mission, item.seed, None, spreads=point.spreads, keep_record=keep)
        completed = verdict.outcome is Outcome.COMPLETED
        wanted = self._keep is Keep.ALL or (self._keep is Keep.FAILED and not completed)
        line = self._line(item, cells_of(verdict))
        return Flown(line, completed, _file_of(records[0].log) if wanted else None)

    def failed(self, item: Item, why: str) -> Flown:
        return Flown(self._line(item, {"outcome": ERROR, "reason": why, "error": why}), False, None)

    def _line(self, item: Item, cells: Mapping[str, Cell]) -> bytes:
        point = self._points[item.point]
        known: dict[str, Cell] = {**cells, "mission": point.path, "seed": item.seed}
        known.update(zip(self._keys, point.values, strict=True))
        return line_of([known.get(name) for name in self._columns])


def cells_of(verdict: Verdict) -> dict[str, Cell]:
    cells: dict[str, Cell] = dict(verdict.drawn)
    fired = (event.rule for event in verdict.guard if event.action is not Override.NONE)
    cells |= {
        "outcome": verdict.outcome.value,
        "reason": verdict.reason,
        "guard_rule": next(fired, None),
        "plan_followed": verdict.plan_followed,
        "not_followed": _not_followed(verdict),
        "goal_miss_m": verdict.goal_miss_m,
        "final_error_m": verdict.final_error_m,
        "max_tilt_deg": verdict.max_tilt_deg,
        "flight_time_s": verdict.flight_time_s,
        "unexplained_modes": "; ".join(unexplained_modes(verdict)) or None,
    }
    for c in verdict.collisions:
        cells[f"c{c.index}_normal_m_s"] = c.measured.normal_m_s
        cells[f"c{c.index}_peak_force_n"] = c.measured.peak_force_n
    return cells


def _judged_cells(row: msgspec.Struct) -> dict[str, Cell]:
    """Return the fields of a judge's row as cells; lists and structs become JSON."""
    cells: dict[str, Cell] = {}
    for name in row.__struct_fields__:
        value = getattr(row, name)
        value = value.value if isinstance(value, Enum) else value
        scalar = value is None or isinstance(value, str | float | int)
        cells[name] = value if scalar else msgspec.json.encode(value).decode()
    return cells


class JudgedRow(NamedTuple):
    """A row of a campaign with a judge function; `row` is None if the flight ended with a program error."""

    mission: str
    values: dict[str, str]
    seed: int
    error: str
    row: Any


def judged_rows(campaign: Campaign, rows: Iterable[Mapping[str, str]]) -> Iterator[JudgedRow]:
    """Return the rows of a campaign's table as its judge function returned them."""
    kind = row_type(campaign.asked.makes_row)
    types = get_type_hints(kind)
    keys = campaign.columns[1 : campaign.columns.index("seed")]
    for cells in rows:
        fields = {name: _field(cells[name], types[name]) for name in types}
        row = None if cells["error"] else kind(**fields)
        yield JudgedRow(
            cells["mission"], {k: cells[k] for k in keys}, int(cells["seed"]), cells["error"], row
        )


def _field(text: str, kind: Any) -> Any:
    if kind is str:
        return text
    if not text:
        return None
    if text[0] in "[{" and kind != (str | None):
        return msgspec.json.decode(text, type=kind)
    return msgspec.convert(text, kind, strict=False)


def _not_followed(verdict: Verdict) -> str | None:
    outside = out_of_tolerance(verdict.deviations)
    return msgspec.json.encode(outside).decode() if outside else None


def line_of(cells: Sequence[Cell]) -> bytes:
    """Return a CSV line with numbers in full precision; an unknown value is empty."""
    return csv_text([map(_text, cells)], end="\n").encode()


def _text(cell: Cell) -> str:
    if cell is None:
        return ""
    if isinstance(cell, bool):
        return "true" if cell else "false"
    return " ".join(cell.split()) if isinstance(cell, str) else repr(cell)


def _file_of(log: Log) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / LOG_NAME
        part = LogPart(path, log.about, 1)
        time_us = 0
        for entry in log.entries:
            time_us = getattr(entry.record, "t_us", 0) or time_us
            part.write(entry.record, time_us, entry.number)
        part.finish({**log.end, "lost": "0"})
        part.close()
        return path.read_bytes()
