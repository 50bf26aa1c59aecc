"""Recorded trials as arrays, and the options for reading them from files.

`trial_readers` makes trials from files, `flight_trials` makes trials from flight logs, and scripts make
trials from their own arrays. All fits use `Trial` only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from dart_flight.base.records import ContactRequest
from dart_flight.config.provenance import LoadedVehicle
from dart_flight.contact.coefficients import Array

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
_DEAD = 1e-6  # minimum variation of a channel in its unit; a channel that varies less is dead


class Series(NamedTuple):
    """Samples of one quantity with increasing times in s and values in SI units."""

    time_s: Array
    value: Array


@dataclass(frozen=True)
class Trial:
    """One recording of one impact.

    Attributes:
        name: name for messages, usually the file.
        series: series by column name (`COLUMNS`); rates may differ. A trial has the column `normal_m`. If
            only an accelerometer recorded the trial, this column is replaced by `specific_force_m_s2`,
            positive along the outward normal (in a drop: up).
        mode: `rigid`, `flexible` or `unlabelled`.
        acceleration_m_s2: acceleration along the normal in free flight: 0 at a wall, -9.81 in a drop.
        height_m: height of a drop, if known.
        position_measured: whether `normal_m` was recorded. If not, `normal_m` is integrated from
            `normal_m_s`.
        allowance: coefficient -> relative systematic error of this kind of recording. The error is added to
            the coefficient's interval.
        flown: the vehicle that flew. A flight log contains this vehicle; for other recordings `flown` is
            None.
        turn_rad_s: largest yaw rate during the contact; None if not recorded.
        contact: force readings of the contact in a flight log, for a fit that models the guards.
        notes: one line for each missing part of the recording.
    """

    name: str
    series: dict[str, Series]
    mode: str = UNLABELLED
    acceleration_m_s2: float = 0.0
    height_m: float | None = None
    position_measured: bool = True
    allowance: Mapping[str, float] = field(default_factory=dict)
    flown: LoadedVehicle | None = None
    turn_rad_s: float | None = None
    contact: ContactRequest | None = None
    notes: tuple[str, ...] = ()

    @property
    def normal(self) -> Series:
        """The signed distance of the vehicle's centre from its assumed position at first touch, m."""
        return self.series["normal_m"]

    def samples_between(self, begin_s: float, end_s: float) -> int:
        """Return the number of samples of position or of normal force between two times.

        If the trial has both, return the larger of the two numbers.
        """
        shown = [self.series[name].time_s for name in ("normal_m", "normal_force_n") if name in self.series]
        return max(int(np.sum((time >= begin_s) & (time <= end_s))) for time in shown)


@dataclass(frozen=True)
class TrialReading:
    """The options of `identify` for reading files.

    Attributes:
        mode: mode of trials that do not record their mode; for a flight, only collisions in this mode are
            used.
        surface: material; for a flight, only collisions with this material are used. If it is None, all
            collisions must be with one material.
        drop: whether gravity acts along the normal.
        contact_distance_m: distance between the surface and the vehicle's centre at first touch. The readers
            subtract it from the normal positions; 0 if these positions already count from first touch.
        columns: our column name -> header in the file.
        wall: for logs in local NED: north and east (m) of the vehicle's centre when the vehicle touches the
            wall, and the heading of the wall's outward normal, degrees.
        mass_kg: vehicle mass to use instead of the configuration's.
        height_m: height of drops, if known.
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
        """The mass that converts acceleration to force, kg; DART's mass if none is given."""
        return 1.3 if self.mass_kg is None else self.mass_kg


def without_derived(trials: Sequence[Trial]) -> tuple[list[Trial], list[str]]:
    """Remove dead channels, and velocities that were computed from the positions; return notes, too.

    With such velocities, the fit would use the same position data twice. Dead channels seem to have no noise
    and would dominate the fit.
    """
    kept, notes = [], []
    for trial in trials:
        series = dict(trial.series)
        for name in [n for n, (_, value) in series.items() if not value.size or float(np.ptp(value)) < _DEAD]:
            if name != "normal_m":
                del series[name]
                notes.append(f"{trial.name}: {name} never changes and was not used")
        for axis in ("normal", "tangential"):
            position, velocity = series.get(f"{axis}_m"), series.get(f"{axis}_m_s")
            if position is None or velocity is None or position.time_s.size < 20:
                continue
            slope = np.gradient(position.value, position.time_s)
            own = velocity.value - np.interp(velocity.time_s, position.time_s, slope)
            noise = np.std(np.diff(slope, 2)) / math.sqrt(6.0)
            if np.median(np.abs(own)) < 0.2 * noise:
                del series[f"{axis}_m_s"]
                notes.append(f"{trial.name}: {axis}_m_s is the derivative of {axis}_m and was not used")
        kept.append(replace(trial, series=series))
    return kept, notes
