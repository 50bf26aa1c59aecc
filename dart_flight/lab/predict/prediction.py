"""The predictions of `dart-flight predict`: one hit, one drop, or a file of hits.

Invalid choices, velocities and heights raise `InputError`.
"""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.base.records import Mode
from dart_flight.config.document import InputError, read_text, unknown_name
from dart_flight.config.file_kinds import FileKind, refuse_other_kind
from dart_flight.config.units import split_unit
from dart_flight.config.vehicle import Coefficients, VehicleConfig
from dart_flight.contact.coefficients import Array, CoefficientArrays, Rows
from dart_flight.contact.contact_map import Drop, collide, contact_map, drop
from dart_flight.contact.law import Onset, coefficients_in_force
from dart_flight.lab.csv_text import csv_text
from dart_flight.lab.predict.path import ContactMotion

BATCH_COLUMNS = ("mode", "normal_m_s", "tangential_m_s")
WALL_COLUMNS = (
    "normal_out_m_s",
    "tangential_out_m_s",
    "contact_time_s",
    "penetration_m",
    "peak_normal_force_n",
    "peak_friction_force_n",
    "impulse_n_s",
)
DROP_NAMES = Drop._fields
_FASTEST_M_S = 100.0  # maximum input speed; a larger input probably has a wrong unit


class Condition(NamedTuple):
    """The conditions of a contact to predict, and the coefficients that follow from these conditions."""

    surface: str
    mode: Mode
    onset: Onset
    incidence_deg: float
    coefficients: Coefficients
    mass_kg: float
    vertical_sign: int


def condition(
    vehicle: VehicleConfig, surface: str, mode: str, onset: str | None, incidence_deg: float
) -> Condition:
    if mode not in list(Mode):
        raise InputError(f"{mode!r} is not allowed, only: {', '.join(Mode)}", key=("mode",))
    if surface not in vehicle.materials:
        raise InputError(unknown_name(surface, list(vehicle.materials), "surface"), key=("surface",))
    if not 0.0 <= incidence_deg <= 45.0:
        raise InputError(f"{incidence_deg:g} is not an angle from 0 to 45", key=("incidence-deg",))
    problem = vehicle.mode_problem(Mode(mode))
    if problem is not None:
        raise InputError(problem, key=("mode",))
    c = coefficients_in_force(vehicle, surface, Mode(mode), math.radians(incidence_deg))
    return Condition(
        surface,
        Mode(mode),
        onset_rule(vehicle, onset),
        incidence_deg,
        c,
        vehicle.airframe.mass_kg,
        vehicle.vertical_force_sign,
    )


def onset_rule(vehicle: VehicleConfig, onset: str | None) -> Onset:
    """Return the rule `onset`, or the vehicle's rule if `onset` is None."""
    rule = onset or vehicle.onset
    if rule not in list(Onset):
        raise InputError(f"{rule!r} is not allowed, only: {', '.join(Onset)}", key=("onset",))
    return Onset(rule)


def hit_problem(normal_m_s: float, tangential_m_s: float) -> tuple[str, str] | None:
    """Return (component, reason) if a velocity component cannot occur in a wall hit, otherwise None."""
    for name, value in (("normal", normal_m_s), ("tangential", tangential_m_s)):
        if not abs(value) <= _FASTEST_M_S:
            return name, f"{value:g} m/s, expected at most {_FASTEST_M_S:g}"
    if not normal_m_s < 0.0:
        return "normal", f"{normal_m_s:g} m/s does not approach the wall; it must be negative"
    return None


def refuse_hit(normal_m_s: float, tangential_m_s: float) -> None:
    problem = hit_problem(normal_m_s, tangential_m_s)
    if problem is not None:
        raise InputError(f"{problem[0]} {problem[1]}", key=("velocity",))


def wall_contact(condition: Condition, normal_m_s: float, tangential_m_s: float) -> ContactMotion:
    refuse_hit(normal_m_s, tangential_m_s)
    return ContactMotion(condition.coefficients, condition.mass_kg, normal_m_s, condition.onset)


def predict_wall(condition: Condition, normal_m_s: float, tangential_m_s: float) -> dict[str, float]:
    """Return the quantities of a wall hit, named with their units."""
    contact = wall_contact(condition, normal_m_s, tangential_m_s)
    r = collide(condition.coefficients, condition.mass_kg, normal_m_s, tangential_m_s, condition.onset)
    last = r.contact_time_s if math.isfinite(r.contact_time_s) else 0.0
    lift = condition.coefficients.nu * condition.mass_kg * float(contact.rise(last)) if last else math.nan
    return r._asdict() | {"vertical_impulse_n_s": lift}


class Ratios(NamedTuple):
    """Ratios of outgoing to incoming speed, along the normal and along the wall."""

    restitution: float
    tangential_ratio: float | None

    def checked(self) -> Ratios:
        """Reject ratios above 1, which would create energy, or below 0, which would reverse the motion."""
        for key, value in (("restitution", self.restitution), ("tangential-ratio", self.tangential_ratio)):
            if value is not None and not 0.0 <= value <= 1.0:
                raise InputError(f"{value:g} is not a ratio from 0 to 1", key=(key,))
        return self


def predict_wall_from_ratios(
    ratios: Ratios, normal_m_s: float, tangential_m_s: float
) -> dict[str, float | None]:
    """Return the quantities of `predict_wall`; forces, times and depth are None."""
    ratios.checked()
    refuse_hit(normal_m_s, tangential_m_s)
    numbers: dict[str, float | None] = dict.fromkeys((*WALL_COLUMNS, "vertical_impulse_n_s"))
    numbers["normal_out_m_s"] = -ratios.restitution * normal_m_s
    if ratios.tangential_ratio is not None:
        numbers["tangential_out_m_s"] = ratios.tangential_ratio * tangential_m_s
    return numbers


def predict_drop_from_ratios(ratios: Ratios, height_m: float) -> dict[str, float | None]:
    """Return the quantities of `predict_drop`; all but the rebound speed are None."""
    ratios.checked()
    if not 0.0 < height_m <= 100.0:
        raise InputError(f"{height_m:g} m, expected a height above 0 and up to 100", key=("drop",))
    numbers: dict[str, float | None] = dict.fromkeys(DROP_NAMES)
    numbers["max_rebound_speed_m_s"] = ratios.restitution * math.sqrt(2.0 * GRAVITY_M_S2 * height_m)
    return numbers


def drop_contact(condition: Condition, height_m: float) -> ContactMotion:
    """Return the first contact of a drop; the height must be above 0 and at most 100 m."""
    if not 0.0 < height_m <= 100.0:
        raise InputError(f"{height_m:g} m, expected a height above 0 and up to 100", key=("drop",))
    r = drop(condition.coefficients, condition.mass_kg, height_m, condition.onset)
    return ContactMotion(
        condition.coefficients,
        condition.mass_kg,
        -r.onset_speed_m_s,
        condition.onset,
        acceleration_m_s2=-GRAVITY_M_S2,
    )


def predict_drop(condition: Condition, height_m: float) -> dict[str, float]:
    """Return the quantities of a drop, named with their units."""
    drop_contact(condition, height_m)
    return drop(condition.coefficients, condition.mass_kg, height_m, condition.onset)._asdict()


def predict_batch_rows(
    vehicle: VehicleConfig, surface: str, onset: str | None, incidence_deg: float, *, path: str | Path
) -> list[dict[str, str | float]]:
    """Predict the wall hits of a CSV file with the columns mode, normal_m_s and tangential_m_s.

    Each row becomes a dictionary whose keys are the three input columns and `WALL_COLUMNS`.
    """
    table = [condition(vehicle, surface, mode.value, onset, incidence_deg) for mode in vehicle.modes]
    modes = [mode.value for mode in vehicle.modes]
    which, normal, tangential = _read_batch(path, modes)
    result = contact_map(
        CoefficientArrays.from_table([row.coefficients for row in table]),
        table[0].mass_kg,
        normal,
        tangential,
        table[0].onset,
        rows=which,
    )
    columns = [normal.tolist(), tangential.tolist()]
    columns += [getattr(result, name).tolist() for name in WALL_COLUMNS]
    names = (*BATCH_COLUMNS, *WALL_COLUMNS)
    return [
        dict(zip(names, (modes[row], *values), strict=True))
        for row, *values in zip(which.tolist(), *columns, strict=True)
    ]


def predict_batch(
    vehicle: VehicleConfig, surface: str, onset: str | None, incidence_deg: float, *, path: str | Path
) -> str:
    """Return the rows of `predict_batch_rows` as CSV text in full double precision."""
    columns = (*BATCH_COLUMNS, *WALL_COLUMNS)
    rows = predict_batch_rows(vehicle, surface, onset, incidence_deg, path=path)
    return csv_text([columns, *(map(row.get, columns) for row in rows)], end="\n")


def _read_batch(path: str | Path, modes: list[str]) -> tuple[Rows, Array, Array]:
    source = str(path)
    text = read_text(path)
    reader = csv.DictReader(io.StringIO(text), skipinitialspace=True)
    header = [name.strip() for name in reader.fieldnames or []]
    reader.fieldnames = header
    for name in BATCH_COLUMNS:
        if name not in header:
            refuse_other_kind(path, FileKind.TRIAL)
            raise InputError(
                f"missing column {name}, expected {', '.join(BATCH_COLUMNS)}", source=source, line=1
            )
    which, speeds = [], []
    for row in reader:
        line = reader.line_num
        mode = (row["mode"] or "").strip()
        if mode not in modes:
            raise InputError(
                f"{mode!r} is not allowed, only: {', '.join(modes)}", source=source, line=line, key=("mode",)
            )
        which.append(modes.index(mode))
        pair = []
        for name in BATCH_COLUMNS[1:]:
            try:
                value = float(row[name] or "")
            except ValueError:
                value = math.nan
            if math.isnan(value):
                raise InputError(
                    f"{row[name]!r} is not a speed in m/s", source=source, line=line, key=(name,)
                )
            pair.append(value)
        problem = hit_problem(*pair)
        if problem is not None:
            raise InputError(problem[1], source=source, line=line, key=(f"{problem[0]}_m_s",))
        speeds.append(pair)
    values = np.array(speeds, dtype=float).reshape(-1, 2)
    return np.array(which, dtype=np.intp), values[:, 0], values[:, 1]


def described(name: str, value: float | None) -> tuple[str, str, str]:
    """Return quantity, value and unit of a number as strings. The `name` must end in the unit."""
    stem, unit = split_unit(name)
    words = stem.replace("_", " ")
    if value is None or math.isnan(value):
        return words, "unknown", ""
    if unit == "s" and 0.0 < abs(value) < 1.0:
        return words, f"{1e3 * value:.2f}", "ms"
    if unit == "m" and 0.0 < abs(value) < 1.0:
        return words, f"{1e3 * value:.2f}", "mm"
    text = "never ends" if math.isinf(value) else f"{value:.4f}"
    return words, text, "" if math.isinf(value) else unit
