"""Export of a flight log as CSV files, one per kind of record, for spreadsheets and PlotJuggler."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

import msgspec

from dart_flight.base.records import Record
from dart_flight.config.document import report_write_errors
from dart_flight.recording.flight_time import find_zero
from dart_flight.recording.reader import Log
from dart_flight.recording.schema import schema

_AXES = {2: "xy", 3: "xyz", 4: "wxyz"}
_NUMBERED = frozenset({"motors", "rpm", "blocking", "others"})  # lists whose items are not axes


def export_csv(log: Log, folder: Path) -> list[Path]:
    """Write `<record>.csv` for every kind of record in the log, `about.json`, and `columns.csv`.

    The columns are `time_s`, `number` and the record's fields. `time_s` is the autopilot's time since the
    flight's zero (`recording.flight_time`). `number` is the sequence number of the input. A record that is
    not an input has the number of the input that caused it. Each component of a vector has its own column
    (`position_ned_x`). `columns.csv` lists unit and frame of every column. Floats keep their full precision;
    a missing value is an empty cell.
    """
    with report_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        written = _write_records(log, folder)
        (folder / "about.json").write_bytes(msgspec.json.format(msgspec.json.encode(log.about | log.end)))
    return written


def _write_records(log: Log, folder: Path) -> list[Path]:
    kinds: dict[type[Record], list[tuple[int, int, Record]]] = {}
    t_us, first_us = 0, find_zero(entry.record for entry in log.entries)
    for entry in log.entries:
        t_us = getattr(entry.record, "t_us", t_us) or t_us
        kinds.setdefault(type(entry.record), []).append((t_us, entry.number, entry.record))
    paths = []
    descriptions: list[tuple[str, str, str]] = []
    for kind, rows in kinds.items():
        path = folder / f"{kind.topic.strip('/').replace('/', '_')}.csv"
        with open(path, "w", newline="", encoding="utf-8") as file:
            _write_kind(file, rows, first_us)
        for name, value in schema(kind)["properties"].items():
            descriptions.append((path.name, name, value.get("description", "")))
        paths.append(path)
    with open(folder / "columns.csv", "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([("file", "column", "meaning"), *descriptions])
    return [*paths, folder / "columns.csv"]


def _write_kind(file: TextIO, rows: list[tuple[int, int, Record]], first_us: int) -> None:
    spread = [(t_us, number, _spread(record)) for t_us, number, record in rows]
    names = list(dict.fromkeys(name for *_, values in spread for name in values))
    writer = csv.writer(file)
    writer.writerow(["time_s", "number", *names])
    for t_us, number, values in spread:
        cells = [values.get(name) for name in names]
        writer.writerow([f"{(t_us - first_us) * 1e-6:.6f}", number, *("" if c is None else c for c in cells)])


def _spread(record: Record) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name, value in msgspec.structs.asdict(record).items():
        if isinstance(value, tuple):
            axes = _axes_of(name, len(value))
            values |= {f"{name}_{axis}": part for axis, part in zip(axes, value, strict=True)}
        else:
            values[name] = value
    return values


def _axes_of(name: str, length: int) -> Sequence[str]:
    """Return the column suffixes of a vector's components: `x` in `force_mission_x`, `1` in `motors_1`."""
    if name in _NUMBERED or length not in _AXES:
        return [str(i + 1) for i in range(length)]
    return _AXES[length]
