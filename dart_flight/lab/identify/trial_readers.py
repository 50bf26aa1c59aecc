"""Readers of trial files, one per suffix in `READERS`."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.config.document import InputError, read_text
from dart_flight.config.file_kinds import FileKind, refuse_other_kind
from dart_flight.contact.coefficients import Array
from dart_flight.lab.holes import describe_holes, describe_missing_parts
from dart_flight.lab.identify.flight_trials import trials_at_one
from dart_flight.lab.identify.recorded_impact import refuse_unusable
from dart_flight.lab.identify.trials import COLUMNS, Series, Trial, TrialReading
from dart_flight.lab.track import calibration_series_of
from dart_flight.lab.ulog import open_ulog
from dart_flight.recording.reader import read_log

# A trial needs one of these columns, which show the impact.
_ANY_OF = ("normal_m", "normal_m_s", "specific_force_m_s2", "normal_acceleration_m_s2")
_TIME = "time_s"
_AT_A_WALL = ("vertical_m", "tangential_force_n")  # columns that a drop does not use
_UP = np.array([0.0, 0.0, -1.0])  # in NED
_FARTHEST_M = 50.0


def read_trials(path: str | Path, reading: TrialReading) -> list[Trial]:
    """Read the trials of a file; its suffix selects the reader."""
    reader = READERS.get(Path(path).suffix.lower())
    if reader is None:
        refuse_other_kind(path, FileKind.TRIAL, FileKind.ULOG, FileKind.FLIGHT_LOG)
        raise InputError(f"unknown kind of trial; known kinds: {', '.join(READERS)}", source=str(path))
    trials = reader(Path(path), reading)
    for trial in trials:
        refuse_unusable(trial)
        if reader is read_csv:
            _refuse_millimetres(trial)
    shift = reading.contact_distance_m
    return [
        replace(
            trial,
            series=trial.series | {"normal_m": Series(trial.normal.time_s, trial.normal.value - shift)},
        )
        if shift and "normal_m" in trial.series
        else trial
        for trial in trials
    ]


def _refuse_millimetres(trial: Trial) -> None:
    """Reject implausibly large positions in a CSV file; logs are always in metres."""
    far = float(np.abs(trial.normal.value).max()) if "normal_m" in trial.series else 0.0
    if far > _FARTHEST_M:
        problem = f"positions reach {far:.0f} m and seem to be in millimetres: convert the column to metres"
        raise InputError(problem, source=trial.name, key=("normal_m",))


def _acceleration(reading: TrialReading) -> float:
    return -GRAVITY_M_S2 if reading.drop else 0.0


def read_csv(path: Path, reading: TrialReading) -> list[Trial]:
    """Read a CSV file whose header contains `time_s`, one of `_ANY_OF`, and any others of `COLUMNS`.

    An empty cell means that the column has no sample at this time.
    """
    source = str(path)
    text = read_text(path)
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip() and line[0] != "#"]
    if not lines:
        raise InputError("the file is empty", source=source)
    delimiter = max(",;\t", key=lines[0][1].count)
    rows = list(csv.reader(io.StringIO("\n".join(line for _, line in lines)), delimiter=delimiter))
    header = [name.strip() for name in rows[0]]
    places = {}
    for name in (_TIME, *COLUMNS):
        wanted = reading.columns.get(name, name)
        if wanted in header:
            places[name] = header.index(wanted)
        elif name in reading.columns:
            raise InputError(f"no column {wanted!r}; columns are: {', '.join(header)}", source=source, line=1)
    if not any(name in places for name in _ANY_OF) or _TIME not in places:
        name = "normal_m" if _TIME in places else _TIME
        raise InputError(
            f"missing column {name} (map it with --columns {name}=...); columns are: {', '.join(header)}",
            source=source,
            line=lines[0][0],
        )
    values: dict[str, list[float]] = {name: [] for name in places}
    last = -math.inf
    for (number, _), row in zip(lines[1:], rows[1:], strict=True):
        for name, place in places.items():
            cell = row[place].strip() if place < len(row) else ""
            values[name].append(_number(cell, name, source, number))
        now = values[_TIME][-1]
        if not now > last:
            raise InputError(
                f"time does not increase: {now:g} after {last:g}", source=source, line=number, key=(_TIME,)
            )
        last = now
    time = np.array(values.pop(_TIME))
    series = {}
    for name, column in values.items():
        value = np.array(column)
        there = np.isfinite(value)
        if there.any():
            series[name] = Series(time[there], value[there])
    if not any(name in series for name in _ANY_OF):
        raise InputError("the column normal_m is empty", source=source)
    return [_trial(source, series, reading)]


def _trial(source: str, series: dict[str, Series], reading: TrialReading) -> Trial:
    """Return a trial with series in the form that the fits require.

    Acceleration is converted to specific force, which excludes gravity, like an accelerometer's reading. In a
    trial with positions, the specific force is multiplied by the mass to give the force. If only the velocity
    was recorded, it is integrated to a position, because the impact is detected in the position signal.
    """
    series = dict(series)
    acceleration = series.pop("normal_acceleration_m_s2", None)
    if acceleration is not None and "specific_force_m_s2" not in series:
        series["specific_force_m_s2"] = Series(
            acceleration.time_s, acceleration.value - _acceleration(reading)
        )
    measured = "normal_m" in series
    if not measured and "normal_m_s" in series:
        time, speed = series["normal_m_s"]
        position = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time))))
        series["normal_m"] = Series(time, position)
        turns = np.flatnonzero((speed[:-1] < 0.0) & (speed[1:] >= 0.0))
        if turns.size:  # assume the plane at the fastest turn
            jumps = [speed[i + 1 : i + 8].max() - speed[max(i - 7, 0) : i + 1].min() for i in turns]
            series["normal_m"] = Series(time, position - position[turns[int(np.argmax(jumps))]])
    if "normal_m" in series and "specific_force_m_s2" in series and "normal_force_n" not in series:
        time, specific_force = series.pop("specific_force_m_s2")
        series["normal_force_n"] = Series(time, reading.kg * specific_force)
    height = reading.height_m if reading.drop else None
    notes = [
        f"{source}: {line}"
        for name in ("normal_m", "normal_force_n", "specific_force_m_s2")
        if name in series
        for line in describe_holes(series[name].time_s, name)
    ]
    shown = measured or "normal_m" not in series
    return Trial(source, series, reading.mode, _acceleration(reading), height, shown, notes=tuple(notes))


def _number(cell: str, name: str, source: str, line: int) -> float:
    if not cell and name != _TIME:
        return math.nan  # no sample
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{cell!r} is not a number", source=source, line=line, key=(name,))
    return value


def read_ulog(path: Path, reading: TrialReading) -> list[Trial]:
    """Read a PX4 ULog: local position and velocity, and the force along the normal from the IMU.

    At a wall, the mean horizontal specific force before the impact is subtracted, because thrust and tilt
    cause this mean in a steady approach. The force is the mass times the remaining specific force. In a drop,
    nothing is subtracted.
    """
    source = str(path)
    if reading.wall is None and not reading.drop:
        raise InputError(
            "a PX4 log does not contain the wall: give --wall NORTH EAST HEADING, or write every impact as a "
            "trial with inspect -o",
            source=source,
        )
    track = calibration_series_of(
        open_ulog(path, ("vehicle_local_position", "vehicle_attitude", "sensor_combined"))
    )
    has_force = track.imu_s.size > 0 and track.attitude_s.size > 0
    normal, tangent = _axes(reading)
    series: dict[str, Series] = {}
    if track.position_s.size:
        origin = np.array([reading.wall[0], reading.wall[1], 0.0]) if reading.wall else np.zeros(3)
        moved = track.position - origin
        # The estimator's velocity is not used: it filters the same measurements as its position.
        for name, axis in (("normal_m", normal), ("tangential_m", tangent), ("vertical_m", _UP)):
            series[name] = _increasing(track.position_s, moved @ axis)
    elif not reading.drop or not has_force:
        raise InputError("the log has no vehicle_local_position", source=source)
    if has_force:
        force = reading.kg * track.to_ned(track.specific_force)
        series["normal_force_n"] = _increasing(track.imu_s, force @ normal)
        series["tangential_force_n"] = _increasing(track.imu_s, force @ tangent)
        if "normal_m" not in series:
            time, along = series["normal_force_n"]
            series = {"specific_force_m_s2": Series(time, along / reading.kg)}
    if reading.wall is None:
        series = {name: value for name, value in series.items() if name not in _AT_A_WALL}
    return [_trial(source, series, reading)]


def _axes(reading: TrialReading) -> tuple[Array, Array]:
    """Return the outward normal and the tangent (Y of the collision frame) in NED."""
    if reading.wall is None:
        return _UP, np.array([0.0, 1.0, 0.0])
    heading = math.radians(reading.wall[2])
    normal = np.array([math.cos(heading), math.sin(heading), 0.0])
    # The tangent points right when looking along the normal, as headings increase clockwise.
    return normal, np.array([-normal[1], normal[0], 0.0])


def _increasing(time: Array, value: Array) -> Series:
    keep = np.concatenate(([True], np.diff(np.maximum.accumulate(time)) > 0.0)) & np.isfinite(value)
    return Series(time[keep], value[keep])


def read_flight(path: Path, reading: TrialReading) -> list[Trial]:
    """Return the collisions in a flight log as trials; a flight log contains no drops."""
    if reading.drop:
        raise InputError(
            "a flight log contains wall collisions, not drops: omit --drop",
            source=str(path),
            key=("drop",),
        )
    log = read_log(path)
    trials = trials_at_one(log, reading.surface, reading.mode)
    notes = (f"{path}: {line}" for line in describe_missing_parts(log))
    return [replace(trials[0], notes=(*trials[0].notes, *notes)), *trials[1:]]


# Suffix -> reader; a new kind of recording needs one more function.
READERS: dict[str, Callable[[Path, TrialReading], list[Trial]]] = {
    ".csv": read_csv,
    ".ulg": read_ulog,
    ".ulog": read_ulog,
    ".mcap": read_flight,
}
