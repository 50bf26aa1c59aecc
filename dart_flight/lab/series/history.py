"""Application of a series: the materials entry in the vehicle's file, and the dated history beside it."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.config.document import Document, InputError, read_text, replace_file, report_write_errors
from dart_flight.config.edit import update_text
from dart_flight.config.material_history import (
    AppliedCoefficient,
    HistoryEntry,
    HistoryFile,
    history_path,
    read_history,
)
from dart_flight.config.provenance import find_vehicle
from dart_flight.config.vehicle import load_vehicle
from dart_flight.lab.series.evidence import Evidence
from dart_flight.lab.series.status import SeriesStatus
from dart_flight.recording.about import software_version

_DIGITS = 6


def apply_status(status: SeriesStatus, evidence: Evidence, config: Path, series: Path) -> list[HistoryEntry]:
    """Write the coefficients into a vehicle's configuration and its history; return the new entries.

    Other values, comments and order of the file stay. A mode without used hits is not changed.

    Raises:
        InputError: no mode has used hits, or the changed configuration would not be valid.
    """
    known = {mode: one for mode, one in status.modes.items() if one.used}
    if not known:
        raise InputError("the series has no usable hits yet", source=str(series))
    vehicle = find_vehicle(config).config
    text = read_text(config)
    tree = Document(text, str(config)).tree
    entry: dict[str, Any] = {}
    if status.material in vehicle.materials:
        entry = vehicle.to_dict()["materials"][status.material]
    for mode, one in known.items():
        entry[mode] = {
            name: float(f"{c.statistical.value:.{_DIGITS}g}") for name, c in one.coefficients.items()
        }
    day = last_day(evidence)
    hits = ", ".join(f"{one.used} hits {mode}" for mode, one in known.items())
    kept = sorted({n for one in known.values() for n, c in one.coefficients.items() if c.prior_share == 1.0})
    unmeasured = f"; {', '.join(kept)} not measured" if kept else ""
    entry["source"] = f"identified {day}: {hits} (dart-flight series){unmeasured}"
    wanted = {**tree, "materials": {**tree.get("materials", {}), status.material: entry}}
    changed = update_text(text, wanted, str(config))
    load_vehicle(Document(changed, str(config)))  # refuse an invalid result before a file is replaced
    version = software_version()
    entries = [
        HistoryEntry(
            date=day,
            material=status.material,
            mode=mode,
            hits=one.used,
            coefficients={
                name: AppliedCoefficient(*(float(f"{v:.{_DIGITS}g}") for v in c.whole))
                for name, c in one.coefficients.items()
            },
            software=version,
            series=str(series),
        )
        for mode, one in known.items()
    ]
    path = history_path(config)
    old = read_text(path) if path.exists() else "{}\n"
    history = msgspec.to_builtins(HistoryFile(1, (*read_history(config), *entries)))
    # Write the history first. An entry without its change is harmless, but a change must have a date.
    with report_write_errors(path):
        replace_file(path, update_text(old, history, str(path)).encode("utf-8"))
    with report_write_errors(config):
        replace_file(config, changed.encode("utf-8"))
    return entries


def last_day(evidence: Evidence) -> str:
    """Return the day of the last flight, or today if no log has a date."""
    days = [flight.began for flight in evidence.flights if flight.began is not None]
    return (max(days) if days else datetime.now(UTC)).date().isoformat()
