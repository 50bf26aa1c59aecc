"""The work of `dart-flight identify`: read the files, fit, and convert the result to JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.base.records import Mode
from dart_flight.config.document import InputError
from dart_flight.config.provenance import LoadedVehicle
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.estimates import Identification
from dart_flight.lab.identify.fit import identify
from dart_flight.lab.identify.trial_readers import read_trials
from dart_flight.lab.identify.trials import COLUMNS, UNLABELLED, Trial, TrialReading
from dart_flight.recording.found import find_logs, read_each

FLIGHT_LOG = ".mcap"


class IdentifyResult(NamedTuple):
    """The trials, the coefficients identified from them, and the vehicle that the fit used.

    Attributes:
        vehicle: the vehicle whose mass, modes and onset rule were used.
        flown: the vehicle in the logs, with its source, if it replaced the given vehicle; otherwise None.
        mass_kg, onset: mass and onset rule used in the fit.
    """

    trials: list[Trial]
    found: Identification
    vehicle: VehicleConfig
    flown: LoadedVehicle | None
    mass_kg: float
    onset: Onset


def identify_trials(
    paths: Sequence[str],
    reading: TrialReading,
    vehicle: VehicleConfig,
    *,
    onset: Onset | None = None,
    given: Sequence[Trial] = (),
) -> IdentifyResult:
    """Read the trials and fit them.

    If the trials contain the vehicle that flew, its mass, modes and onset rule are used, because the forces
    in a log were computed for this vehicle. If there are several logs, a log without a collision is skipped,
    and a note names it. Invalid options and trials, options that apply to no file, and trials of different
    vehicles are rejected.

    Args:
        paths: trial files, and folders of flight logs.
        vehicle: vehicle of the trials that do not contain a vehicle.
        onset: onset rule to use instead of the vehicle's.
        given: trials in memory, used together with the trials of the files.
    """
    if not 0.0 <= reading.contact_distance_m <= 1.0:
        raise InputError(f"{reading.contact_distance_m:g} m, expected 0 to 1", key=("contact-distance",))
    if reading.height_m is not None and not 0.0 < reading.height_m <= 10.0:
        raise InputError(f"{reading.height_m:g} m, expected a height above 0 and up to 10", key=("drop",))
    mass_kg = _mass(reading, vehicle)
    if not 0.01 <= mass_kg <= 100.0:
        raise InputError(f"{mass_kg:g} kg, expected 0.01 to 100", key=("mass",))
    left_out: list[str] = []
    files = find_logs(paths)
    _refuse_idle_options(reading, files)
    if not given and not any(path.suffix.lower() == FLIGHT_LOG for path in files):
        _refuse_mode(reading, vehicle)  # no flight log can replace `vehicle`
    with_mass = replace(reading, mass_kg=mass_kg)
    trials = list(given) + list(
        chain.from_iterable(read_each(files, lambda path: read_trials(path, with_mass), left_out.append))
    )
    left_out += [note for trial in trials for note in trial.notes]
    flown, at_hand = _flown(trials, vehicle), vehicle
    vehicle = flown.config if flown else at_hand
    mass_kg, onset = _mass(reading, vehicle), onset or Onset(vehicle.onset)
    left_out += _mass_notes(trials, mass_kg, at_hand if flown else None)
    _refuse_mode(reading, vehicle)
    trials = _labelled(trials, vehicle)
    found = identify(trials, mass_kg, onset)
    found.notes[:0] = left_out
    if reading.height_m is not None:
        expected = math.sqrt(2.0 * GRAVITY_M_S2 * reading.height_m)
        for trial, read in zip(found.trials, trials, strict=True):
            if "normal_m" in read.series and abs(-trial.normal_m_s / expected - 1.0) > 0.2:
                found.notes.append(
                    f"{trial.name}: touches at {-trial.normal_m_s:.2f} m/s, but a drop from "
                    f"{reading.height_m:g} m touches at {expected:.2f} m/s"
                )
    return IdentifyResult(trials, found, vehicle, flown, mass_kg, onset)


def _mass(reading: TrialReading, vehicle: VehicleConfig) -> float:
    return vehicle.airframe.mass_kg if reading.mass_kg is None else reading.mass_kg


def _refuse_mode(reading: TrialReading, vehicle: VehicleConfig) -> None:
    problem = None if reading.mode == UNLABELLED else vehicle.mode_problem(Mode(reading.mode))
    if problem is not None:
        raise InputError(problem, key=("mode",))


def _labelled(trials: Sequence[Trial], vehicle: VehicleConfig) -> list[Trial]:
    """Return the trials with their mode; a vehicle without a lock has only one mode."""
    if vehicle.has_lock:
        return list(trials)
    only = vehicle.modes[0].value
    return [replace(trial, mode=only) if trial.mode == UNLABELLED else trial for trial in trials]


def _alike(first: VehicleConfig, other: VehicleConfig) -> bool:
    own = (first.airframe.mass_kg, first.modes, first.onset)
    return own == (other.airframe.mass_kg, other.modes, other.onset)


def _flown(trials: Sequence[Trial], vehicle: VehicleConfig) -> LoadedVehicle | None:
    """Return the logged vehicle if its mass, modes or onset rule differ from those of `vehicle`."""
    others = [trial.flown for trial in trials if trial.flown and not _alike(trial.flown.config, vehicle)]
    if not others:
        return None
    first = others[0]
    for trial in trials:
        own = vehicle if trial.flown is None else trial.flown.config
        if not _alike(own, first.config):
            raise InputError(
                f"the trial is of another vehicle ({own.airframe.mass_kg:g} kg, not "
                f"{first.config.airframe.mass_kg:g} kg): identify the vehicles separately",
                source=trial.name,
            )
    return first


def _mass_notes(trials: Sequence[Trial], mass_kg: float, replaced: VehicleConfig | None) -> list[str]:
    logged = {trial.flown.config.airframe.mass_kg for trial in trials if trial.flown is not None}
    other = sorted(logged - {mass_kg})
    if other:
        return [
            f"the fit uses a mass of {mass_kg:g} kg, but the forces in the flight logs assume {other[0]:g} kg"
        ]
    if replaced is None:
        return []
    return [
        f"the fit uses the vehicle of the flight logs ({mass_kg:g} kg), not the vehicle of the configuration "
        f"({replaced.airframe.mass_kg:g} kg)"
    ]


def _refuse_idle_options(reading: TrialReading, paths: Sequence[Path]) -> None:
    """Reject an option if it applies to none of the given files."""
    csv, ulogs = (".csv",), (".ulg", ".ulog")
    idle = {"columns": (reading.columns, csv), "wall": (reading.wall, ulogs)}
    given = {path.suffix.lower() for path in paths}
    for option, (value, suffixes) in idle.items():
        if value and given.isdisjoint(suffixes):
            raise InputError(
                f"applies only to {' and '.join(suffixes)} files; no such file is given", key=(option,)
            )


def columns_of(text: str | None) -> dict[str, str]:
    """Parse `time_s=t,normal_m=x` into a dictionary."""
    names = ("time_s", *COLUMNS)
    columns = {}
    for part in (text or "").split(","):
        name, equals, header = (piece.strip() for piece in part.partition("="))
        if not part.strip():
            continue
        if name not in names or not equals or not header:
            raise InputError(
                f"{part.strip()!r} is not NAME=HEADER with NAME one of {', '.join(names)}", key=("columns",)
            )
        columns[name] = header
    return columns


def _plain(value: Any) -> Any:
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list) else value


def as_json(found: Identification) -> dict[str, Any]:
    plain: dict[str, Any] = _plain(found)
    for compared in plain["held_out"].values():
        del compared["mode"], compared["sentence"]
    return plain
