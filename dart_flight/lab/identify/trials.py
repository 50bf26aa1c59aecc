"""Recorded trials: reading them, refusing what cannot be used, and finding the impact in a long recording.

Readers stand in `READERS`, one per file suffix; each returns `Trial`s. What follows (finding, fitting) takes
`Trial`s only, so that arrays from anywhere serve as well.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.config.document import InputError, read_text
from dart_flight.config.file_kinds import FileKind, refuse_other_kind
from dart_flight.config.provenance import FoundVehicle
from dart_flight.contact.coefficients import Array
from dart_flight.lab.holes import describe_holes, describe_missing_parts
from dart_flight.lab.track import calibration_series_of
from dart_flight.lab.ulog import open_ulog
from dart_flight.recording.reader import read_log

UNLABELLED = "unlabelled"
# Columns of a trial, in the collision frame; `vertical_m` is a height (against Z at a wall). Required first.
COLUMNS = (
    "normal_m",
    "tangential_m",
    "vertical_m",
    "normal_m_s",
    "tangential_m_s",
    "normal_force_n",
    "tangential_force_n",
    "specific_force_m_s2",
    "normal_acceleration_m_s2",
)
# One of these says that there is an impact at all.
_ANY_OF = ("normal_m", "normal_m_s", "specific_force_m_s2", "normal_acceleration_m_s2")
_TIME = "time_s"
_AT_A_WALL = ("vertical_m", "tangential_force_n")  # of a drop not used
_UP = np.array([0.0, 0.0, -1.0])  # in NED

_LONGEST_STEP_S = 0.03  # of sampling: the shortest contacts take 0.05 s
_FARTHEST_M = 50.0
_FASTEST_M_S = 15.0
_DEEPEST_M = 0.4
_SLOWEST_M_S = 0.05
_TURN_M_S2 = 1.2  # least mean acceleration of a turn that is an impact
_NEAREST_M = 0.08  # the turning point of an impact lies at most this far before the assumed plane


class Series(NamedTuple):
    """Samples of one quantity; increasing times in s, values in SI units."""

    time_s: Array
    value: Array


@dataclass(frozen=True)
class Trial:
    """One recording of one impact.

    Attributes:
        name: for messages, usually the file.
        series: by column name (`COLUMNS`); rates may differ. `normal_m` is there unless the trial is an
            accelerometer's: then `specific_force_m_s2` is, along the outward normal (in a drop: up).
        mode: `rigid`, `flexible` or `unlabelled`.
        acceleration_m_s2: along the normal in free flight: 0 at a wall, -9.81 in a drop.
        height_m: of a drop, where it is known.
        position_measured: whether `normal_m` was recorded; if not, it is integrated from `normal_m_s`.
        allowance: coefficient -> share of it by which recordings of this kind are off however many there are;
            the intervals are widened by it.
        flown: the vehicle, where the recording itself says it, as a flight log does.
        turn_rad_s: largest rate about the vertical while it touched; None where that was not recorded.
        notes: one line for each missing part of the recording.
    """

    name: str
    series: dict[str, Series]
    mode: str = UNLABELLED
    acceleration_m_s2: float = 0.0
    height_m: float | None = None
    position_measured: bool = True
    allowance: Mapping[str, float] = field(default_factory=dict)
    flown: FoundVehicle | None = None
    turn_rad_s: float | None = None
    notes: tuple[str, ...] = ()

    @property
    def normal(self) -> Series:
        """The signed distance to the assumed plane of first touch."""
        return self.series["normal_m"]

    def samples_between(self, begin_s: float, end_s: float) -> int:
        """How many samples show the shape of what is between two times: of position or of normal force."""
        shown = [self.series[name].time_s for name in ("normal_m", "normal_force_n") if name in self.series]
        return max(int(np.sum((time >= begin_s) & (time <= end_s))) for time in shown)


@dataclass(frozen=True)
class TrialReading:
    """How files are to be read: the options of `identify`.

    Attributes:
        mode: label for what has none itself; of a flight, its collisions in it.
        surface: of a flight, its collisions with this material; None: there must be only one.
        drop: gravity along the normal.
        contact_distance_m: subtracted from the normal position, for recordings of the centre's height or
            distance from the surface itself.
        columns: our column name -> the header in the file.
        wall: for logs in local NED: north and east of the plane of first touch, and the heading of its
            outward normal in degrees.
        mass_kg: of the vehicle, instead of the configuration's.
        height_m: of drops, where it is known.
    """

    mode: str = UNLABELLED
    surface: str | None = None
    drop: bool = False
    contact_distance_m: float = 0.0
    columns: dict[str, str] = field(default_factory=dict)
    wall: tuple[float, float, float] | None = None
    mass_kg: float | None = None
    height_m: float | None = None

    @property
    def kg(self) -> float:
        """What turns measured acceleration into force; DART's mass where none is given."""
        return 1.3 if self.mass_kg is None else self.mass_kg


# --- reading --------------------------------------------------------------------------------------------


def read_trials(path: str | Path, how: TrialReading) -> list[Trial]:
    """The trials of a file.

    Args:
        path: the file; its suffix chooses the reader.
        how: how to read it.

    Raises:
        InputError: the file cannot be read, its kind is unknown, or its content cannot be used.
    """
    reader = READERS.get(Path(path).suffix.lower())
    if reader is None:
        refuse_other_kind(path, FileKind.TRIAL, FileKind.ULOG, FileKind.FLIGHT_LOG)
        raise InputError(f"unknown kind of trial, known: {', '.join(READERS)}", source=str(path))
    trials = reader(Path(path), how)
    for trial in trials:
        _check(trial)
        if reader is read_csv:
            _refuse_millimetres(trial)
    shift = how.contact_distance_m
    return [
        replace(
            trial,
            series=trial.series | {"normal_m": Series(trial.normal.time_s, trial.normal.value - shift)},
        )
        if shift and "normal_m" in trial.series
        else trial
        for trial in trials
    ]


def _acceleration(how: TrialReading) -> float:
    return -GRAVITY_M_S2 if how.drop else 0.0


def read_csv(path: Path, how: TrialReading) -> list[Trial]:
    """A CSV with a header: `time_s`, `normal_m`, and any of `COLUMNS`; an empty cell is no sample.

    Raises:
        InputError: with file, line and column of what is wrong.
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
        wanted = how.columns.get(name, name)
        if wanted in header:
            places[name] = header.index(wanted)
        elif name in how.columns:
            raise InputError(f"no column {wanted!r}, there are: {', '.join(header)}", source=source, line=1)
    if not any(name in places for name in _ANY_OF) or _TIME not in places:
        name = "normal_m" if _TIME in places else _TIME
        raise InputError(
            f"missing column {name} (map others with --columns {name}=...), there are: {', '.join(header)}",
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
    return [_trial(source, series, how)]


def _trial(source: str, series: dict[str, Series], how: TrialReading) -> Trial:
    """A trial whose series are in the form the fits take.

    Acceleration becomes specific force (what an accelerometer feels: gravity is not in it), and beside
    positions specific force becomes force. Velocity alone is integrated to a position that finds the impact.
    """
    series = dict(series)
    acceleration = series.pop("normal_acceleration_m_s2", None)
    if acceleration is not None and "specific_force_m_s2" not in series:
        series["specific_force_m_s2"] = Series(acceleration.time_s, acceleration.value - _acceleration(how))
    measured = "normal_m" in series
    if not measured and "normal_m_s" in series:
        time, speed = series["normal_m_s"]
        way = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time))))
        series["normal_m"] = Series(time, way)
        turns = np.flatnonzero((speed[:-1] < 0.0) & (speed[1:] >= 0.0))
        if turns.size:  # the plane is where the fastest turn is
            jumps = [speed[i + 1 : i + 8].max() - speed[max(i - 7, 0) : i + 1].min() for i in turns]
            series["normal_m"] = Series(time, way - way[turns[int(np.argmax(jumps))]])
    if "normal_m" in series and "specific_force_m_s2" in series and "normal_force_n" not in series:
        time, felt = series.pop("specific_force_m_s2")
        series["normal_force_n"] = Series(time, how.kg * felt)
    height = how.height_m if how.drop else None
    notes = [
        f"{source}: {line}"
        for name in ("normal_m", "normal_force_n", "specific_force_m_s2")
        if name in series
        for line in describe_holes(series[name].time_s, name)
    ]
    shown = measured or "normal_m" not in series
    return Trial(source, series, how.mode, _acceleration(how), height, shown, notes=tuple(notes))


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


def read_ulog(path: Path, how: TrialReading) -> list[Trial]:
    """A PX4 ULog: local position and velocity, and the force along the normal from the IMU.

    The force is mass times the horizontal specific force, less its mean before the impact: what thrust and
    tilt give in steady approach. In a drop it is the specific force itself.

    Raises:
        InputError: pyulog is missing, the file is not a ULog, or topics are missing; no wall was given.
    """
    source = str(path)
    if how.wall is None and not how.drop:
        raise InputError(
            "a flight log does not say where the wall is: give --wall NORTH EAST HEADING, or have inspect -o "
            "write every impact as a trial",
            source=source,
        )
    track = calibration_series_of(
        open_ulog(path, ("vehicle_local_position", "vehicle_attitude", "sensor_combined"))
    )
    felt = track.imu_s.size > 0 and track.attitude_s.size > 0
    normal, tangent = _axes(how)
    series: dict[str, Series] = {}
    if track.position_s.size:
        origin = np.array([how.wall[0], how.wall[1], 0.0]) if how.wall else np.zeros(3)
        moved = track.position - origin
        # The estimator's velocity is not used: it filters the same measurements as its position.
        for name, axis in (("normal_m", normal), ("tangential_m", tangent), ("vertical_m", _UP)):
            series[name] = _increasing(track.position_s, moved @ axis)
    elif not how.drop or not felt:
        raise InputError("has no vehicle_local_position", source=source)
    if felt:
        force = how.kg * track.to_ned(track.specific_force)
        series["normal_force_n"] = _increasing(track.imu_s, force @ normal)
        series["tangential_force_n"] = _increasing(track.imu_s, force @ tangent)
        if "normal_m" not in series:
            time, along = series["normal_force_n"]
            series = {"specific_force_m_s2": Series(time, along / how.kg)}
    if how.wall is None:
        series = {name: one for name, one in series.items() if name not in _AT_A_WALL}
    return [_trial(source, series, how)]


def _axes(how: TrialReading) -> tuple[Array, Array]:
    """Outward normal and tangent (Y of the collision frame) in NED."""
    if how.wall is None:
        return _UP, np.array([0.0, 1.0, 0.0])
    heading = math.radians(how.wall[2])
    normal = np.array([math.cos(heading), math.sin(heading), 0.0])
    # To the right when looking along the normal: clockwise seen from above, as headings turn.
    return normal, np.array([-normal[1], normal[0], 0.0])


def _increasing(time: Array, value: Array) -> Series:
    keep = np.concatenate(([True], np.diff(np.maximum.accumulate(time)) > 0.0)) & np.isfinite(value)
    return Series(time[keep], value[keep])


def read_flight(path: Path, how: TrialReading) -> list[Trial]:
    """The collisions of a flight log.

    Raises:
        InputError: as `trials_at_one`, or a drop is wanted, which no mission has.
    """
    from dart_flight.lab.identify.flight_trials import trials_at_one  # noqa: PLC0415  stands on this module

    if how.drop:
        raise InputError(
            "a flight log has wall collisions and no drops: leave --drop away",
            source=str(path),
            key=("drop",),
        )
    log = read_log(path)
    trials = trials_at_one(log, how.surface, how.mode)
    notes = (f"{path}: {line}" for line in describe_missing_parts(log))
    return [replace(trials[0], notes=(*trials[0].notes, *notes)), *trials[1:]]


# Suffix -> reader. A further kind of recording is one function more.
READERS: dict[str, Callable[[Path, TrialReading], list[Trial]]] = {
    ".csv": read_csv,
    ".ulg": read_ulog,
    ".ulog": read_ulog,
    ".mcap": read_flight,
}


# --- finding the impact ---------------------------------------------------------------------------------


class TrialImpact(NamedTuple):
    """Where the impact is in a recording, roughly: what a fit starts from.

    Attributes:
        turn_s: the normal velocity changes its sign.
        approach_m_s: normal velocity before it (negative).
        rebound_m_s: normal velocity after it.
        deepest_m: position at the turn.
        noise_m: standard deviation of the position samples.
    """

    turn_s: float
    approach_m_s: float
    rebound_m_s: float
    deepest_m: float
    noise_m: float


def _refuse_millimetres(trial: Trial) -> None:
    """Of numbers that a person has written; a log's are in metres, however far the flight led."""
    far = float(np.abs(trial.normal.value).max()) if "normal_m" in trial.series else 0.0
    if far > _FARTHEST_M:
        says = f"positions up to {far:.0f} m: millimetres? the column is in metres"
        raise InputError(says, source=trial.name, key=("normal_m",))


def _check(trial: Trial) -> None:
    for name, series in trial.series.items():
        if series.time_s.size > 1 and not (np.diff(series.time_s) > 0.0).all():
            raise InputError("time does not increase", source=trial.name, key=(name,))
        if not (np.isfinite(series.time_s).all() and np.isfinite(series.value).all()):
            raise InputError("values that are not numbers", source=trial.name, key=(name,))
    if "normal_m" not in trial.series:
        return
    time = trial.normal.time_s
    if time.size < 12:
        raise InputError(f"{time.size} samples are too few for an impact", source=trial.name)
    step = float(np.median(np.diff(time)))
    if step > _LONGEST_STEP_S:
        raise InputError(
            f"one sample every {1e3 * step:.0f} ms, at most {1e3 * _LONGEST_STEP_S:.0f} ms: a contact takes "
            "50 to 180 ms and needs several (seconds in time_s?)",
            source=trial.name,
            key=(_TIME,),
        )


def _slopes(time: Array, value: Array, half_s: float) -> Array:
    """Slope of the straight line through the samples within `half_s` of each sample."""
    first = np.searchsorted(time, time - half_s)
    last = np.searchsorted(time, time + half_s, side="right")
    t, x = time - time.mean(), value - value.mean()
    sums = [np.concatenate(([0.0], np.cumsum(v))) for v in (np.ones_like(t), t, x, t * t, t * x)]
    n, st, sx, stt, stx = (s[last] - s[first] for s in sums)
    spread = stt - st * st / n
    return np.where(spread > 0.0, (stx - st * sx / n) / np.where(spread > 0.0, spread, 1.0), 0.0)


def find_impact(trial: Trial) -> TrialImpact:
    """The first strong turn from approaching to leaving in a recording of any length.

    Raises:
        InputError: there is none, or position or speed cannot be those of an impact in metres and seconds.
    """
    _check(trial)
    time, value = trial.normal
    step = float(np.median(np.diff(time)))
    speed = _slopes(time, value, max(0.012, 2.5 * step))
    candidates = np.flatnonzero((speed[:-1] < 0.0) & (speed[1:] >= 0.0)) + 1
    found: list[TrialImpact] = []
    reach = 0.12  # to either side: more than half of the longest contact
    for i in candidates:
        at = float(time[i])
        before = (time >= at - reach) & (time < at)
        after = (time > at) & (time <= at + reach)
        if before.sum() < 3 or after.sum() < 3:
            continue
        turn = TrialImpact(
            at, float(speed[before].min()), float(speed[after].max()), float(value[i]), noise_of(trial.normal)
        )
        quick = (turn.rebound_m_s - turn.approach_m_s) / (2.0 * reach) >= _TURN_M_S2
        if quick and turn.approach_m_s < -_SLOWEST_M_S and turn.rebound_m_s > 0.0:
            found.append(turn)
    if not found:
        raise InputError("no impact found: no quick turn from approaching to leaving", source=trial.name)
    strongest = max(turn.rebound_m_s - turn.approach_m_s for turn in found)
    # The first of the strong ones: later ones are bounces, and noise makes several of one.
    begun = next(t for t in found if t.rebound_m_s - t.approach_m_s >= 0.6 * strongest)
    same = [t for t in found if abs(t.turn_s - begun.turn_s) < 0.04]
    impact = min(same, key=lambda t: t.deepest_m)
    if trial.acceleration_m_s2 == 0.0:
        impact = impact._replace(approach_m_s=_line_slope(time, value, impact))
    if -impact.approach_m_s > _FASTEST_M_S:
        raise InputError(
            f"an approach at {-impact.approach_m_s:.0f} m/s: are positions in metres and times in seconds?",
            source=trial.name,
        )
    if impact.deepest_m < -_DEEPEST_M:
        raise InputError(
            f"turns {-impact.deepest_m:.2f} m behind the plane, at most {_DEEPEST_M:g} m is an impact",
            source=trial.name,
        )
    if impact.deepest_m > _NEAREST_M:
        raise InputError(
            f"turns {impact.deepest_m:.2f} m before the plane of first touch; distances of the centre from "
            "the surface itself need --contact-distance",
            source=trial.name,
        )
    return impact


def _line_slope(time: Array, value: Array, impact: TrialImpact) -> float:
    """Approach velocity as the median slope between samples (Theil and Sen): bears a third of outliers."""
    straight = (time > impact.turn_s - 0.25) & (time < impact.turn_s - 0.07)
    t, x = time[straight][-200:], value[straight][-200:]
    apart = t[None, :] - t[:, None] > 0.03
    if apart.sum() < 10:
        return impact.approach_m_s
    slope = float(np.median(((x[None, :] - x[:, None])[apart]) / ((t[None, :] - t[:, None])[apart])))
    return min(slope, -_SLOWEST_M_S)


def noise_of(series: Series) -> float:
    """Standard deviation of white noise on smooth motion, from third differences (evenly sampled)."""
    if series.value.size < 8:
        return 1e-3
    third = np.diff(series.value, 3)
    return max(float(1.4826 * np.median(np.abs(third - np.median(third))) / math.sqrt(20.0)), 1e-7)
