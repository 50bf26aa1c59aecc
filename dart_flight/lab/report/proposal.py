"""What the material table should learn from flights: coefficients where prediction and measurement disagree.

First the cheap question: does the measured peak of normal or friction force differ from the law's, at the
measured velocity, by more than its own spread over the trials? Only then, or when asked to, are coefficients
identified.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from dart_flight.config.document import InputError
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.estimates import Estimate, Identification, mean_half_width
from dart_flight.lab.identify.fit import identify
from dart_flight.lab.identify.flight_trials import trials_of
from dart_flight.lab.identify.materials_entry import materials_entry
from dart_flight.lab.identify.trials import Trial
from dart_flight.lab.report.flight import Flight

# Peak forces that agree to this teach nothing: a fifth of k would be twice as much. One flight alone has no
# spread; its measured velocity, on which the prediction stands, is off by up to 4 %.
AGREES = 0.05
ALONE = 0.1
_MOST_TRIALS = 5  # per mode: more narrow the interval little and take long


class Suggestion(msgspec.Struct):
    """One coefficient: as configured, as identified, and whether it should be changed."""

    mode: str
    name: str
    configured: float
    identified: Estimate | None
    change: bool


class Proposal(msgspec.Struct):
    """What is proposed for one material.

    Attributes:
        material: which.
        disagreement: per mode and force (`rigid, normal`), mean of measured over predicted peak minus one,
            and its 95 % half width.
        suggestions: empty where nothing was identified.
        entry: the YAML to put under `materials`, "" where nothing should change.
        note: why there is nothing, or what limits it.
    """

    material: str
    disagreement: dict[str, tuple[float, float]]
    suggestions: list[Suggestion]
    entry: str
    note: str


def propose(flights: Sequence[Flight], always: bool = False) -> list[Proposal]:
    """A proposal for every material that was hit.

    Args:
        flights: of vehicles with the same materials.
        always: identify also where prediction and measurement agree.
    """
    by_material: dict[str, dict[str, list[float]]] = {}
    for flight in flights:
        for impact in flight.impacts:
            modes = by_material.setdefault(impact.material, {})
            for force, value in (("normal", impact.disagreement), ("friction", impact.friction_disagreement)):
                if value is not None:
                    modes.setdefault(f"{impact.verdict.mode}, {force}", []).append(value)
    return [_of_material(m, modes, flights, always) for m, modes in by_material.items()]


def _of_material(
    material: str, modes: dict[str, list[float]], flights: Sequence[Flight], always: bool
) -> Proposal:
    disagreement = {mode: _mean(values) for mode, values in modes.items() if values}
    beyond = [m for m, (mean, half) in disagreement.items() if abs(mean) > max(half, AGREES)]
    if not beyond and not always:
        note = "prediction and measurement agree; nothing was identified"
        return Proposal(material, disagreement, [], "", note if disagreement else "no peak force to compare")
    trials = _trials(material, flights)
    vehicle = flights[0].mission.vehicle
    try:
        found = identify(trials, vehicle.airframe.mass_kg, Onset(vehicle.onset), compare_laws=False)
        suggestions = _suggest(found, material, flights[0])
        changes = any(s.change for s in suggestions)
        entry = materials_entry(found, material, vehicle).text if changes else ""
    except InputError as error:
        return Proposal(material, disagreement, [], "", f"could not be identified: {error.message}")
    note = "; ".join(found.notes)
    return Proposal(material, disagreement, suggestions, entry, note)


def _mean(values: list[float]) -> tuple[float, float]:
    half = mean_half_width(values)
    return sum(values) / len(values), ALONE if half is None else half


def _trials(material: str, flights: Sequence[Flight]) -> list[Trial]:
    kept: list[Trial] = []
    for flight in flights:
        for trial in trials_of(flight.log, material).get(material, []):
            if sum(t.mode == trial.mode for t in kept) < _MOST_TRIALS:
                kept.append(trial)
    return kept


def _suggest(found: Identification, material: str, flight: Flight) -> list[Suggestion]:
    table = flight.mission.vehicle.materials[material]
    suggestions = []
    for mode in flight.mission.vehicle.modes:
        for name, estimate in found.coefficients.get(mode.value, {}).items():
            configured = float(getattr(table.of(mode), name))
            suggestions.append(
                Suggestion(mode.value, name, configured, estimate, _differs(configured, estimate))
            )
    return suggestions


def _differs(configured: float, estimate: Estimate | None) -> bool:
    return estimate is not None and not estimate.low <= configured <= estimate.high
