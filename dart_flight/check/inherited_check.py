"""The check of the values that a vehicle file inherits from another vehicle's file."""

from __future__ import annotations

from collections.abc import Iterable

from dart_flight.check.findings import CheckFinding
from dart_flight.config.inherited import find_inherited
from dart_flight.config.mission import Mission


def check_inherited(mission: Mission) -> list[CheckFinding]:
    """Return a remark that lists inherited values and contradictions, if there are any."""
    source = mission.vehicle_source
    if source is None:
        return []
    found = find_inherited(mission.vehicle, source.source, source.set)
    if found is None or not (found.keys or found.contradictions):
        return []
    parts = []
    if found.contradictions:
        groups = [f"{', '.join(keys)} (this vehicle has {why})" for why, keys in found.contradictions.items()]
        parts.append(f"{found.file} contradicts values inherited from {found.base}: {'; '.join(groups)}")
    if found.keys:
        parts.append(f"values from {found.base} to measure on this vehicle: {_by_section(found.keys)}")
    wrong = sum(len(keys) for keys in found.contradictions.values())
    figures = {"inherited": float(len(found.keys)), "contradictions": float(wrong)}
    return [CheckFinding("inherited", True, ". ".join(parts), remark=True, figures=figures)]


def _by_section(keys: Iterable[str]) -> str:
    """Return the keys, without values, as text that names each section once."""
    sections: dict[str, list[str]] = {}
    for key in keys:
        section, _, name = key.split()[0].rpartition(".")
        sections.setdefault(section, []).append(name)
    return "; ".join(f"{section} {', '.join(names)}" for section, names in sections.items())
