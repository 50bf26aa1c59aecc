"""What `dart-flight identify` does: read the files, fit, and say it as JSON."""

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
from dart_flight.config.provenance import FoundVehicle
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.estimates import Identification
from dart_flight.lab.identify.fit import identify
from dart_flight.lab.identify.trial_readers import read_trials
from dart_flight.lab.identify.trials import COLUMNS, UNLABELLED, Trial, TrialReading
from dart_flight.recording.found import from_each, logs_in

FLIGHT_LOG = ".mcap"


class IdentifyResult(NamedTuple):
    """What came of it.

    Attributes:
        trials: as they were read.
        found: what the fit says.
        vehicle: whose mass, modes and rule for the onset were taken.
        flown: where that is not the given one but the one that flew, with where it came from.
        mass_kg, onset: that were fitted with.
    """

    trials: list[Trial]
    found: Identification
    vehicle: VehicleConfig
    flown: FoundVehicle | None
    mass_kg: float
    onset: Onset


def identify_trials(
    paths: Sequence[str],
    how: TrialReading,
    vehicle: VehicleConfig,
    *,
    onset: Onset | None = None,
    given: Sequence[Trial] = (),
) -> IdentifyResult:
    """Read the trials and fit them.

    Mass, modes and rule for the onset are those of the vehicle that flew, where the trials say it: a log's
    forces were worked out with them.

    Args:
        paths: files, folders of flight logs.
        how: to read them.
        vehicle: of trials that do not say theirs.
        onset: instead of the vehicle's.
        given: trials that are read already; they count with those of the files.

    Raises:
        InputError: an option or a trial cannot be used, an option is for a kind of file that is not among
            them, or the trials are of different vehicles; of several logs those without a collision are left
            out with a note.
    """
    if not 0.0 <= how.contact_distance_m <= 1.0:
        raise InputError(f"{how.contact_distance_m:g} m, expected 0 to 1", key=("contact-distance",))
    if how.height_m is not None and not 0.0 < how.height_m <= 10.0:
        raise InputError(f"{how.height_m:g} m, expected a height above 0 and up to 10", key=("drop",))
    mass_kg = _mass(how, vehicle)
    if not 0.01 <= mass_kg <= 100.0:
        raise InputError(f"{mass_kg:g} kg, expected 0.01 to 100", key=("mass",))
    left_out: list[str] = []
    files = logs_in(paths)
    _refuse_idle_options(how, files)
    if not given and not any(path.suffix.lower() == FLIGHT_LOG for path in files):
        _refuse_mode(how, vehicle)  # no trial will say another vehicle
    weighed = replace(how, mass_kg=mass_kg)
    trials = list(given) + list(
        chain.from_iterable(from_each(files, lambda path: read_trials(path, weighed), left_out.append))
    )
    left_out += [note for trial in trials for note in trial.notes]
    flown, at_hand = _flown(trials, vehicle), vehicle
    vehicle = flown.config if flown else at_hand
    mass_kg, onset = _mass(how, vehicle), onset or Onset(vehicle.onset)
    left_out += _mass_notes(trials, mass_kg, at_hand if flown else None)
    _refuse_mode(how, vehicle)
    trials = _labelled(trials, vehicle)
    found = identify(trials, mass_kg, onset)
    found.notes[:0] = left_out
    if how.height_m is not None:
        expected = math.sqrt(2.0 * GRAVITY_M_S2 * how.height_m)
        for trial, read in zip(found.trials, trials, strict=True):
            if "normal_m" in read.series and abs(-trial.normal_m_s / expected - 1.0) > 0.2:
                found.notes.append(
                    f"{trial.name}: arrives at {-trial.normal_m_s:.2f} m/s; a drop from {how.height_m:g} m "
                    f"arrives at {expected:.2f} m/s"
                )
    return IdentifyResult(trials, found, vehicle, flown, mass_kg, onset)


def _mass(how: TrialReading, vehicle: VehicleConfig) -> float:
    return vehicle.airframe.mass_kg if how.mass_kg is None else how.mass_kg


def _refuse_mode(how: TrialReading, vehicle: VehicleConfig) -> None:
    """Raises InputError: the mode that was asked for is none of the vehicle's."""
    problem = None if how.mode == UNLABELLED else vehicle.mode_problem(Mode(how.mode))
    if problem is not None:
        raise InputError(problem, key=("mode",))


def _labelled(trials: Sequence[Trial], vehicle: VehicleConfig) -> list[Trial]:
    """Trials with their mode; of a vehicle without a lock, which has only one, nothing has to be said."""
    if vehicle.has_lock:
        return list(trials)
    only = vehicle.modes[0].value
    return [replace(trial, mode=only) if trial.mode == UNLABELLED else trial for trial in trials]


def _alike(one: VehicleConfig, other: VehicleConfig) -> bool:
    """Whether trials of both are trials of one vehicle, as far as a fit is concerned."""
    return (one.airframe.mass_kg, one.modes, one.onset) == (other.airframe.mass_kg, other.modes, other.onset)


def _flown(trials: Sequence[Trial], vehicle: VehicleConfig) -> FoundVehicle | None:
    """The vehicle that flew, where it is another than the given one.

    Raises:
        InputError: the trials are of different vehicles.
    """
    said = [trial for trial in trials if trial.flown is not None]
    others = [trial.flown for trial in said if trial.flown and not _alike(trial.flown.config, vehicle)]
    if not others:
        return None
    first = others[0]
    for trial in trials:
        own = vehicle if trial.flown is None else trial.flown.config
        if not _alike(own, first.config):
            raise InputError(
                f"a trial of another vehicle ({own.airframe.mass_kg:g} kg; the others' have "
                f"{first.config.airframe.mass_kg:g} kg): identify them apart",
                source=trial.name,
            )
    return first


def _mass_notes(trials: Sequence[Trial], mass_kg: float, passed_over: VehicleConfig | None) -> list[str]:
    """What a reader should know of the mass: that it is not the configuration's, or not the logs'."""
    logged = {trial.flown.config.airframe.mass_kg for trial in trials if trial.flown is not None}
    other = sorted(logged - {mass_kg})
    if other:
        return [f"fitted with {mass_kg:g} kg; the forces in the flight logs are of {other[0]:g} kg"]
    if passed_over is None:
        return []
    return [
        f"the vehicle is the one that flew ({mass_kg:g} kg, as its logs say), not the configuration's of "
        f"{passed_over.airframe.mass_kg:g} kg"
    ]


def _refuse_idle_options(how: TrialReading, paths: Sequence[Path]) -> None:
    """Raises InputError: an option tells how to read a kind of file that is not among them."""
    csv, ulogs = (".csv",), (".ulg", ".ulog")
    idle = {"columns": (how.columns, csv), "wall": (how.wall, ulogs)}
    given = {path.suffix.lower() for path in paths}
    for option, (value, suffixes) in idle.items():
        if value and given.isdisjoint(suffixes):
            raise InputError(
                f"is for {' and '.join(suffixes)} files, and none of the trials is one", key=(option,)
            )


def columns_of(text: str | None) -> dict[str, str]:
    """`time_s=t,normal_m=x` as a dictionary.

    Raises:
        InputError: not of this form, or not one of our names.
    """
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
    """A value with its named tuples as objects."""
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    return [_plain(one) for one in value] if isinstance(value, list) else value


def as_json(found: Identification) -> dict[str, Any]:
    """The result as the object `--json` prints."""
    said: dict[str, Any] = _plain(found)
    for compared in said["held_out"].values():
        del compared["mode"], compared["sentence"]
    return said
