"""What `dart-flight identify` does: read the files, fit, and say it as JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

from dart_flight.config.document import InputError
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.contact.law import Onset
from dart_flight.geometry import GRAVITY_M_S2
from dart_flight.identify.fit import Identification, identify
from dart_flight.identify.trials import COLUMNS, UNLABELLED, Readers, Trial, TrialReading, read_trials
from dart_flight.recording.found import from_each, logs_in

UNITS = {"k": "N/m", "f": "N s/m", "mu": "s/m", "nu": "N"}


@dataclass(frozen=True)
class Job:
    """What was asked for; as the options of the command."""

    paths: Sequence[str]
    onset: Onset
    mode: str | None = None
    drop: bool = False
    height_m: float | None = None
    contact_distance_m: float = 0.0
    columns: str | None = None
    wall: tuple[float, float, float] | None = None


def carry_out(
    job: Job, vehicle: VehicleConfig, readers: Readers | None = None
) -> tuple[list[Trial], Identification]:
    """Read the trials and fit them.

    Args:
        job: what was asked for.
        vehicle: its mass counts.
        readers: file suffix -> reader, `trials.READERS` by default.

    Raises:
        InputError: an option or a trial cannot be used; of several logs those without a collision are left
            out with a note.
    """
    if not 0.0 <= job.contact_distance_m <= 1.0:
        raise InputError(f"{job.contact_distance_m:g} m, expected 0 to 1", key=("contact-distance",))
    if job.height_m is not None and not 0.0 < job.height_m <= 10.0:
        raise InputError(f"{job.height_m:g} m, expected a height above 0 and up to 10", key=("drop",))
    how = TrialReading(
        mode=job.mode or UNLABELLED,
        drop=job.drop,
        contact_distance_m=job.contact_distance_m,
        columns=_columns(job.columns),
        wall=job.wall,
        mass_kg=vehicle.airframe.mass_kg,
    )
    left_out: list[str] = []
    paths = logs_in(job.paths)
    trials = list(
        chain.from_iterable(from_each(paths, lambda path: read_trials(path, how, readers), left_out.append))
    )
    found = identify(trials, vehicle.airframe.mass_kg, job.onset)
    found.notes[:0] = left_out
    if job.height_m is not None:
        expected = math.sqrt(2.0 * GRAVITY_M_S2 * job.height_m)
        for trial in found.trials:
            if abs(-trial.normal_m_s / expected - 1.0) > 0.2:
                found.notes.append(
                    f"{trial.name}: arrives at {-trial.normal_m_s:.2f} m/s; a drop from {job.height_m:g} m "
                    f"arrives at {expected:.2f} m/s"
                )
    return trials, found


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


def as_json(found: Identification) -> dict[str, Any]:
    """The result as the object `--json` prints."""
    return {
        "coefficients": {
            mode: {name: None if e is None else e._asdict() for name, e in coefficients.items()}
            for mode, coefficients in found.coefficients.items()
        },
        "residuals": found.residuals,
        "plane_m": found.plane_m._asdict(),
        "vertical_side": found.vertical_side,
        "trials": [trial._asdict() for trial in found.trials],
        "notes": found.notes,
    }
