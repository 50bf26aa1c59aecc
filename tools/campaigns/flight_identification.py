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
from tools.campaigns.results import grouped, markdown, median_and_most

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


_BODY = "simulation.contact.body"


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for every body and coefficient: errors, and how often the interval holds the truth."""
    table = []
    for (body,), mine in grouped(rows, _BODY).items():
        for wanted in ("k", "f", "mu", "nu"):
            found = [
                c for one in mine for name, c in one.coefficients.items() if name.endswith(f", {wanted}")
            ]
            errors = [100.0 * abs(v / true - 1.0) for v, _, _, true in found if v is not None]
            inside = [
                low <= true <= high for _, low, high, true in found if low is not None and high is not None
            ]
            unknown = sum(v is None for v, *_ in found)
            cells = [median_and_most(errors, 1), f"{sum(inside)} of {len(inside)}", str(unknown)]
            table.append([body, wanted, *cells])
    heads = ("body", "coefficient", "error %: median, largest", "interval holds the truth", "unknown")
    return markdown(heads, table)
