"""Export of a flight log as CSV files, one per kind of record, for spreadsheets and PlotJuggler."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.base.records import Record
from dart_flight.config.document import report_write_errors
from dart_flight.lab.csv_text import csv_text
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
        path.write_text(csv_text(_rows(rows, first_us)), encoding="utf-8", newline="")
        for name, value in schema(kind)["properties"].items():
            descriptions.append((path.name, name, value.get("description", "")))
        paths.append(path)
    columns = folder / "columns.csv"
    text = csv_text([("file", "column", "meaning"), *descriptions])
    columns.write_text(text, encoding="utf-8", newline="")
    return [*paths, columns]


def _rows(records: list[tuple[int, int, Record]], first_us: int) -> Iterator[list[Any]]:
    """Yield the header and the rows of the records of one kind."""
    found = [(t_us, number, _cells(record)) for t_us, number, record in records]
    names = list(dict.fromkeys(name for *_, values in found for name in values))
    yield ["time_s", "number", *names]
    for t_us, number, values in found:
        yield [f"{(t_us - first_us) * 1e-6:.6f}", number, *map(values.get, names)]


def _cells(record: Record) -> dict[str, Any]:
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
