"""The progress of a bring-up, stored as a record and as a printable page.

From the record, the operator can resume an interrupted bring-up.
"""

from __future__ import annotations

import html
from datetime import datetime
from pathlib import Path

import msgspec

from dart_flight.check.bringup.judgements import Measured, StepFinding, StepOutcome
from dart_flight.check.bringup.steps import STEPS
from dart_flight.config.document import InputError, report_write_errors
from dart_flight.config.provenance import VehicleSource


class StepRecord(msgspec.Struct, frozen=True):
    """The last result of one step; `date` is local time, or empty if the step was never run."""

    name: str
    result: StepOutcome
    message: str
    measured: Measured = {}
    date: str = ""


class BringupRecord(msgspec.Struct):
    """The bring-up of one vehicle, with the last result of every step in order."""

    vehicle: VehicleSource
    connection: str
    steps: list[StepRecord]

    @property
    def failed(self) -> bool:
        return any(step.result is StepOutcome.FAIL for step in self.steps)


def create_record(vehicle: VehicleSource, connection: str) -> BringupRecord:
    steps = [StepRecord(step.name, StepOutcome.NEEDS_OPERATOR, "not done yet") for step in STEPS]
    return BringupRecord(vehicle, connection, steps)


def load_record(folder: Path, vehicle: VehicleSource, connection: str) -> BringupRecord:
    """Return this vehicle's bring-up from a folder, or a new record if the folder has none."""
    path = folder / "bringup.json"
    try:
        found = msgspec.json.decode(path.read_bytes(), type=BringupRecord)
    except FileNotFoundError:
        return create_record(vehicle, connection)
    except OSError as error:
        raise InputError(f"cannot read: {error.strerror}", source=str(path)) from None
    except ValueError as error:
        raise InputError(
            f"not a bring-up record of dart-flight ({error}): move the file away", source=str(path)
        ) from None
    known = {step.name: step for step in found.steps} if found.vehicle.source == vehicle.source else {}
    begun = create_record(vehicle, connection)
    begun.steps = [known.get(step.name, step) for step in begun.steps]
    return begun


def store_finding(record: BringupRecord, name: str, finding: StepFinding) -> None:
    date = datetime.now().astimezone().isoformat(timespec="seconds")
    done = StepRecord(name, finding.result, finding.message, finding.measured, date)
    record.steps = [done if step.name == name else step for step in record.steps]


def save_record(record: BringupRecord, folder: Path) -> tuple[Path, Path]:
    """Write `bringup.json`, today's record and today's page; return the paths of today's two files."""
    today = datetime.now().astimezone().date().isoformat()
    text = msgspec.json.format(msgspec.json.encode(record), indent=2)
    paths = folder / "bringup.json", folder / f"bringup-{today}.json", folder / f"bringup-{today}.html"
    with report_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for path, content in zip(paths, (text, text, format_page(record, today).encode()), strict=True):
            path.write_bytes(content)
    return paths[1], paths[2]


def format_page(record: BringupRecord, date: str) -> str:
    """Return the record as an HTML page that prints on one sheet."""
    rows, what = [], {step.name: step.subject for step in STEPS}
    for step in record.steps:
        figures = ", ".join(f"{name} {value}" for name, value in step.measured.items())
        cells = (what[step.name], step.result.value, step.message, figures, step.date)
        rows.append("<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in cells) + "</tr>")
    vehicle = f"{record.vehicle.source}, {record.vehicle.mass_kg:g} kg, {record.connection}"
    return (
        "<!doctype html><meta charset=utf-8><title>Bring-up</title>"
        "<style>body{font:11pt sans-serif;margin:2em}td,th{border:1px solid #999;padding:.4em;"
        "text-align:left;vertical-align:top}table{border-collapse:collapse}</style>"
        f"<h1>Bring-up, {date}</h1><p>{html.escape(vehicle)}</p><table>"
        "<tr><th>step<th>result<th>finding<th>measured<th>when</tr>" + "".join(rows) + "</table>"
        "<p>Operator, signature:</p>"
    )
