"""Campaign: coefficients identified from flight logs (docs/results/flight_identification.md)."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from dart_flight.base.records import World
from dart_flight.config.mission import Mission
from dart_flight.contact.law import Onset
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.lab.identify.fit import identify
from dart_flight.lab.identify.flight_trials import trials_of
from dart_flight.recording.reader import IN_MEMORY, Log
from dart_flight.run.fast import FastFlight
from dart_flight.run.flight_record import FlightRecord
from dart_flight.sim.draws import DrawnWorld
from tools.campaigns.results import markdown

_FLIGHTS = 3


class Identified(msgspec.Struct, frozen=True):
    """Coefficients by `material, mode, name`: estimate, interval and truth, or None if not determined."""

    coefficients: dict[str, tuple[float | None, float | None, float | None, float]]


def with_factor(mission: Mission, factor: str) -> Mission:
    """Return the mission with one coefficient of every material multiplied, such as `k=1.2`."""
    if not factor:
        return mission
    name, _, by = factor.partition("=")
    materials = {}
    for material, m in mission.vehicle.materials.items():
        modes = {mode: m.coefficients(mode) for mode in mission.vehicle.modes}
        scaled = {
            mode.value: msgspec.structs.replace(c, **{name: float(by) * getattr(c, name)})
            for mode, c in modes.items()
        }
        materials[material] = msgspec.structs.replace(m, **scaled)
    vehicle = msgspec.structs.replace(mission.vehicle, materials=materials)
    return msgspec.structs.replace(mission, vehicle=vehicle)


def identify_flights(point: Point, seed: int) -> Identified:
    """Fly three times with other walls than the mission's, and identify from the logs alone."""
    mission, real = point.mission, with_factor(point.mission, point.case["walls"])
    logs = [_log_of(mission, real, k) for k in range(_FLIGHTS * (seed - 1) + 1, _FLIGHTS * seed + 1)]
    found: dict[str, tuple[float | None, float | None, float | None, float]] = {}
    for material in dict.fromkeys(c.wall.material for c in mission.collisions):
        trials = [trial for log in logs for trial in trials_of(log, material).get(material, [])]
        result = identify(trials, mission.vehicle.airframe.mass_kg, Onset(mission.vehicle.onset))
        for mode, coefficients in result.coefficients.items():
            for name, estimate in coefficients.items():
                truth = getattr(getattr(real.vehicle.materials[material], mode), name)
                value, low, high = (None, None, None) if estimate is None else estimate
                found[f"{material}, {mode}, {name}"] = (value, low, high, truth)
    return Identified(found)


def _log_of(mission: Mission, real: Mission, seed: int) -> Log:
    record = FlightRecord(mission, World.FAST, seed, IN_MEMORY)
    FastFlight(mission, seed, observe=record, world=DrawnWorld(real, None, {})).run()
    record.close()
    return record.log


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a table with a row for every coefficient, in bold if its interval does not contain the truth."""
    table = []
    for r in rows:
        for name, (value, low, high, true) in r.row.coefficients.items():
            cells = [r.mission, *r.values.values(), name, f"{true:.4g}"]
            if value is None or low is None or high is None:
                table.append([*cells, "unknown"])
            else:
                shown = f"{value:.4g}, {100.0 * (value / true - 1.0):+.1f} %"
                table.append([*cells, shown if low <= true <= high else f"**{shown}**"])
    return markdown(("mission", "body", "walls", "coefficient", "truth", "estimate, error"), table)
