"""The samples of recorded trials, and how files of them are to be read.

`trial_readers` makes them of files, `flight_trials` of flight logs, a script of its own arrays; everything
behind takes `Trial`s only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from dart_flight.config.provenance import FoundVehicle
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
_DEAD = 1e-6  # in any unit: a recording that changes by less is not one


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


def without_derived(trials: Sequence[Trial]) -> tuple[list[Trial], list[str]]:
    """Leave out what is no measurement: velocities differenced from the positions, dead channels.

    The former would count twice; the latter seem to have no noise at all and would count for everything.
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
