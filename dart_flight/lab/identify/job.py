"""What `dart-flight identify` does: read the files, fit, and say it as JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.base.records import Mode
from dart_flight.config.document import InputError
from dart_flight.config.provenance import FoundVehicle
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.estimates import Estimate, Identification
from dart_flight.lab.identify.fit import PAPER, identify
from dart_flight.lab.identify.held_out import HeldOut
from dart_flight.lab.identify.trials import COLUMNS, UNLABELLED, Readers, Trial, TrialReading, read_trials
from dart_flight.recording.found import from_each, logs_in

FLIGHT_LOG = ".mcap"
UNITS = {"k": "N/m", "f": "N s/m", "mu": "s/m", "nu": "N"}


@dataclass(frozen=True)
class Job:
    """What was asked for; as the options of the command."""

    paths: Sequence[str]
    onset: Onset | None = None
    mode: str | None = None
    drop: bool = False
    height_m: float | None = None
    contact_distance_m: float = 0.0
    columns: str | None = None
    wall: tuple[float, float, float] | None = None
    mass_kg: float | None = None
    law: str = PAPER


class Identified(NamedTuple):
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


def carry_out(
    job: Job, vehicle: VehicleConfig, readers: Readers | None = None, given: Sequence[Trial] = ()
) -> Identified:
    """Read the trials and fit them.

    Mass, modes and rule for the onset are those of the vehicle that flew, where the trials say it: a log's
    forces were worked out with them.

    Args:
        job: what was asked for.
        vehicle: of trials that do not say theirs.
        readers: file suffix -> reader, `trials.READERS` by default.
        given: trials that are read already; they count with those of the files.

    Raises:
        InputError: an option or a trial cannot be used, an option is for a kind of file that is not among
            them, or the trials are of different vehicles; of several logs those without a collision are left
            out with a note.
    """
    if not 0.0 <= job.contact_distance_m <= 1.0:
        raise InputError(f"{job.contact_distance_m:g} m, expected 0 to 1", key=("contact-distance",))
    if job.height_m is not None and not 0.0 < job.height_m <= 10.0:
        raise InputError(f"{job.height_m:g} m, expected a height above 0 and up to 10", key=("drop",))
    mass_kg = _mass(job, vehicle)
    if not 0.01 <= mass_kg <= 100.0:
        raise InputError(f"{mass_kg:g} kg, expected 0.01 to 100", key=("mass",))
    how = TrialReading(
        mode=job.mode or UNLABELLED,
        drop=job.drop,
        contact_distance_m=job.contact_distance_m,
        columns=_columns(job.columns),
        wall=job.wall,
        mass_kg=mass_kg,
        height_m=job.height_m,
    )
    left_out: list[str] = []
    paths = logs_in(job.paths)
    _refuse_idle_options(job, paths)
    if not given and not any(path.suffix.lower() == FLIGHT_LOG for path in paths):
        _refuse_mode(job, vehicle)  # no trial will say another vehicle
    trials = list(given) + list(
        chain.from_iterable(from_each(paths, lambda path: read_trials(path, how, readers), left_out.append))
    )
    flown, at_hand = _flown(trials, vehicle), vehicle
    vehicle = flown.config if flown else at_hand
    mass_kg, onset = _mass(job, vehicle), job.onset or Onset(vehicle.onset)
    left_out += _said_of_mass(trials, mass_kg, at_hand if flown else None)
    _refuse_mode(job, vehicle)
    trials = _labelled(trials, vehicle)
    found = identify(trials, mass_kg, onset, law=job.law)
    found.notes[:0] = left_out
    if job.height_m is not None:
        expected = math.sqrt(2.0 * GRAVITY_M_S2 * job.height_m)
        for trial, read in zip(found.trials, trials, strict=True):
            if "normal_m" in read.series and abs(-trial.normal_m_s / expected - 1.0) > 0.2:
                found.notes.append(
                    f"{trial.name}: arrives at {-trial.normal_m_s:.2f} m/s; a drop from {job.height_m:g} m "
                    f"arrives at {expected:.2f} m/s"
                )
    return Identified(trials, found, vehicle, flown, mass_kg, onset)


def _mass(job: Job, vehicle: VehicleConfig) -> float:
    return vehicle.airframe.mass_kg if job.mass_kg is None else job.mass_kg


def _refuse_mode(job: Job, vehicle: VehicleConfig) -> None:
    """Raises InputError: the mode that was asked for is none of the vehicle's."""
    problem = None if job.mode is None else vehicle.mode_problem(Mode(job.mode))
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


def _said_of_mass(trials: Sequence[Trial], mass_kg: float, passed_over: VehicleConfig | None) -> list[str]:
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


def _refuse_idle_options(job: Job, paths: Sequence[Path]) -> None:
    """Raises InputError: an option tells how to read a kind of file that is not among them."""
    csv, ulogs = (".csv",), (".ulg", ".ulog")
    idle = {"columns": (job.columns, csv), "wall": (job.wall, ulogs)}
    given = {path.suffix.lower() for path in paths}
    for option, (value, suffixes) in idle.items():
        if value and given.isdisjoint(suffixes):
            raise InputError(
                f"is for {' and '.join(suffixes)} files, and none of the trials is one", key=(option,)
            )


def _columns(text: str | None) -> dict[str, str]:
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


def _said(estimate: Estimate | None) -> dict[str, float] | None:
    return None if estimate is None else estimate._asdict()


def _compared(found: HeldOut) -> dict[str, Any]:
    return {
        "held_out": found.held_out,
        "hits": found.hits,
        "laws": {name: errors._asdict() for name, errors in found.laws.items()},
        "baselines": {name: errors._asdict() for name, errors in found.baselines.items()},
        "scatter": found.scatter._asdict(),
        "best": found.best,
        "better_by": found.better_by._asdict(),
        "earned": found.earned,
    }


def as_json(found: Identification) -> dict[str, Any]:
    """The result as the object `--json` prints."""
    return {
        "coefficients": {
            mode: {name: _said(e) for name, e in coefficients.items()}
            for mode, coefficients in found.coefficients.items()
        },
        "restitution": {mode: _said(e) for mode, e in found.restitution.items()},
        "tangential_ratio": {mode: _said(e) for mode, e in found.tangential_ratio.items()},
        "law": {
            "name": found.law,
            "parameters": {
                mode: {name: _said(e) for name, e in parameters.items()}
                for mode, parameters in found.law_parameters.items()
            },
        },
        "held_out": {mode: _compared(h) for mode, h in found.held_out.items()},
        "residuals": found.residuals,
        "plane_m": _said(found.plane_m),
        "vertical_side": found.vertical_side,
        "trials": [trial._asdict() | {"set_aside": trial.set_aside._asdict()} for trial in found.trials],
        "notes": found.notes,
    }
