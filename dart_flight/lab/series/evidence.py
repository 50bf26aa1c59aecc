"""The evidence of a series: the hits in its flights, each used, held out, or set aside with a reason."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import msgspec

from dart_flight.base.records import Mode, StatusSample
from dart_flight.config.document import InputError
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.body_fit import BodyImpact, fit_bodies
from dart_flight.lab.identify.flight_trials import trials_of
from dart_flight.lab.identify.measured_impacts import MeasuredImpact, measure_impact
from dart_flight.lab.identify.problem import LawProblem
from dart_flight.lab.identify.trial_readers import read_trials
from dart_flight.lab.identify.trials import TrialReading
from dart_flight.lab.series.series_file import DropTrial, SeriesFolder, SeriesSettings
from dart_flight.recording.about import flown_mission
from dart_flight.recording.flown_impact import CollisionVerdict, Velocities
from dart_flight.recording.reader import Log, read_log
from dart_flight.recording.verdict import verdict_of

_DIFFERS = 0.25  # difference of the logarithm of k above which a hit is on another wall or in another mode
_SDS = 5.0
_FEWEST = 3  # hits from which a group can be told from an outlier
_OTHER_VEHICLE = 0.15  # relative difference of the masses; other batteries differ by less


@dataclass
class SeriesHit:
    """One planned hit that was flown.

    Attributes:
        number: number of the hit in its flight.
        measured: the hit as measured, or None if it could not be measured.
        body: the fit of its force readings.
        held_out: whether the hit only checks the prediction.
        aside: the reason why the hit is not used, or "".
    """

    flight: str
    number: int
    mode: Mode
    verdict: CollisionVerdict
    measured: MeasuredImpact | None = None
    body: BodyImpact | None = None
    held_out: bool = False
    aside: str = ""

    @property
    def name(self) -> str:
        return f"{self.flight}:{self.number}"

    @property
    def used(self) -> bool:
        return not self.aside and not self.held_out


class SeriesFlight(msgspec.Struct):
    """One flight of a series.

    Attributes:
        problem: the reason why the log is unreadable or incomplete, or "".
        began: time of the flight's beginning; None if unknown.
        battery_v: first voltage of the battery.
    """

    name: str
    path: Path
    problem: str = ""
    began: datetime | None = None
    vehicle: VehicleConfig | None = None
    battery_v: float | None = None
    outcome: str = ""


@dataclass
class Evidence:
    """All flights and hits of a series, in the order flown."""

    flights: list[SeriesFlight] = field(default_factory=list)
    hits: list[SeriesHit] = field(default_factory=list)

    def used(self, mode: Mode) -> list[SeriesHit]:
        return [hit for hit in self.hits if hit.mode is mode and hit.used]

    def held_out(self, mode: Mode) -> list[SeriesHit]:
        return [hit for hit in self.hits if hit.mode is mode and hit.held_out and not hit.aside]


def read_evidence(folder: SeriesFolder) -> Evidence:
    """Read the flights of a series; an unreadable log is named, and does not stop the others."""
    found, settings = Evidence(), folder.settings
    for name, path in folder.logs().items():
        flight = SeriesFlight(name, path)
        found.flights.append(flight)
        try:
            found.hits += read_flight(read_log(path), flight, settings)
        except InputError as error:
            flight.problem = error.message
    for name, (path, trial) in folder.drop_files().items():
        flight = SeriesFlight(name, path, outcome="completed")
        found.flights.append(flight)
        try:
            found.hits.append(read_drop(path, name, trial, folder))
        except InputError as error:
            flight.problem = error.message
    sort_hits(found, settings)
    return found


def read_drop(path: Path, name: str, drop: DropTrial, folder: SeriesFolder) -> SeriesHit:
    """Measure the impact of a recorded drop."""
    mass_kg, settings = folder.mission().vehicle.airframe.mass_kg, folder.settings
    reading = TrialReading(
        mode=drop.mode.value,
        drop=True,
        contact_distance_m=drop.contact_distance_m,
        mass_kg=mass_kg,
        height_m=drop.height_m,
    )
    trials = read_trials(path, reading)
    if len(trials) != 1:
        raise InputError(f"the file has {len(trials)} drops, expected one", source=str(path))
    measured = measure_impact(trials[0], mass_kg)
    speeds = Velocities(
        -measured.normal_in_m_s, peak_force_n=measured.peak_force_n, normal_out_m_s=measured.normal_out_m_s
    )
    verdict = CollisionVerdict(1, settings.wall, drop.mode.value, 0, measured=speeds)
    hit = SeriesHit(name, 1, drop.mode, verdict, measured)
    excluded = [one.why for one in settings.excluded if (one.flight, one.hit) == (name, 1)]
    hit.aside = f"excluded: {excluded[0]}" if excluded else ""
    return hit


def refuse_foreign(log: Log, folder: SeriesFolder) -> None:
    """Raise InputError if a flight has no hit on the wall of the series, or is of another vehicle."""
    wall, mission = folder.settings.wall, flown_mission(log.about, log.source)
    if not any(one.wall == wall for one in verdict_of(log).collisions):
        raise InputError(f"the flight has no hit on wall {wall}", source=log.source)
    refuse_other_vehicle(mission.vehicle, folder.mission().vehicle, log.source)


def refuse_other_vehicle(vehicle: VehicleConfig, own: VehicleConfig, source: str) -> None:
    """Raise InputError if the masses of two configurations are not those of the same vehicle."""
    mass_kg, own_kg = vehicle.airframe.mass_kg, own.airframe.mass_kg
    if abs(mass_kg / own_kg - 1.0) > _OTHER_VEHICLE:
        text = f"is another vehicle: its mass is {mass_kg:g} kg, that of the series' vehicle {own_kg:g} kg"
        raise InputError(text, source=source)


def sort_hits(evidence: Evidence, settings: SeriesSettings) -> None:
    """Decide which hits are held out, and set outliers aside."""
    for mode in settings.modes:
        hits = [hit for hit in evidence.hits if hit.mode is mode]
        _hold_out(hits, settings.held_out)
        _set_outliers_aside(hits)


def read_flight(log: Log, flight: SeriesFlight, settings: SeriesSettings) -> list[SeriesHit]:
    """Return the planned hits of a flight, and complete the description of the flight."""
    mission = flown_mission(log.about, log.source)
    verdict = verdict_of(log)
    flight.vehicle, flight.outcome = mission.vehicle, verdict.reason or verdict.outcome.value
    began = log.about.get("started_utc")
    flight.began = None if began is None else datetime.fromisoformat(began)
    voltages = (e.record.battery_v for e in log.entries if isinstance(e.record, StatusSample))
    flight.battery_v = next((v for v in voltages if v), None)
    if not log.complete:
        flight.problem = "the log is cut off; the hits before the cut are used"
    excluded = {one.hit: one.why for one in settings.excluded if one.flight == flight.name}
    trials = {
        trial.contact.onset.t_us: trial
        for of_material in trials_of(log).values()
        for trial in of_material
        if trial.contact is not None
    }
    mass_kg, onset = mission.vehicle.airframe.mass_kg, mission.vehicle.onset
    found = []
    for one in verdict.collisions:
        hit = SeriesHit(flight.name, one.index, Mode(one.mode), one)
        found.append(hit)
        trial = trials.get(one.t_us)
        hit.aside = _reason(one, settings) or (
            f"excluded: {excluded[one.index]}" if one.index in excluded else ""
        )
        if hit.aside:
            continue
        if trial is None:
            hit.aside = "the log has no force readings of the contact"
            continue
        try:
            hit.measured = measure_impact(trial, mass_kg)
        except InputError as error:
            hit.aside = error.message
            continue
        bodies, notes = fit_bodies(LawProblem([hit.measured], mass_kg, Onset(onset)))
        hit.body = bodies.get(hit.measured)
        hit.aside = "" if hit.body is not None else "; ".join(notes).partition(": ")[2]
    return found


def _reason(one: CollisionVerdict, settings: SeriesSettings) -> str:
    """Return the reason why a hit is not of this series, by the verdict alone."""
    if one.wall != settings.wall:
        return f"a hit on wall {one.wall}, not {settings.wall}"
    if one.mode not in settings.modes:
        return f"mode {one.mode} is not part of the series"
    if one.mode_felt is not None and one.mode_felt != one.mode:
        return f"the contact indicates {one.mode_felt.value} arms: the lock did not move to {one.mode}"
    if one.measured.peak_force_n is None:
        return "no peak force was measured"
    return ""


def _hold_out(hits: Sequence[SeriesHit], share: float) -> None:
    """Hold out every n-th hit of a mode; hits that are set aside count, so that the choice never changes."""
    if share > 0.0:
        every = round(1.0 / share)
        for i, hit in enumerate(hits):
            hit.held_out = i % every == every // 2


def _set_outliers_aside(hits: Sequence[SeriesHit]) -> None:
    """Set hits aside whose stiffness differs from that of the largest group: another wall, or another mode.

    Of two groups of the same size, the one that began earlier counts.
    """
    fitted = [(hit, hit.body.belief) for hit in hits if hit.body is not None and not hit.aside]
    if len(fitted) < _FEWEST:
        return
    logs = [math.log(belief.k) for _, belief in fitted]
    centre = max(logs, key=lambda one: sum(abs(other - one) < _DIFFERS for other in logs))
    for hit, belief in fitted:
        off = math.log(belief.k) - centre
        if abs(off) > max(_DIFFERS, _SDS * belief.k_sd):
            times = math.exp(off)
            hit.aside = f"k is {times:.2f} times that of most hits: another wall, or the lock did not move"
