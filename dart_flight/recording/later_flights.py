"""Compare recorded peak forces with the contact law: do a material's coefficients still hold?"""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Final

from dart_flight.base.records import Mode, World
from dart_flight.base.summary import mean_half_width
from dart_flight.config.document import InputError
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.contact.coefficients import CoefficientArrays
from dart_flight.contact.contact_map import contact_map
from dart_flight.contact.law import Onset
from dart_flight.recording.about import flown_mission
from dart_flight.recording.found import LOG_NAME
from dart_flight.recording.reader import read_log
from dart_flight.recording.verdict import verdict_of

# A smaller excess does not show a wrong k: a 20 % change of k changes the peak by twice this limit. One
# flight has no spread, and its measured velocity, which the prediction uses, has an error of up to 4 %.
AGREES: Final = 0.05
_ALONE: Final = 0.1
_NEWEST: Final = 5  # number of logs to read, the newest first


def mean_excess(values: Sequence[float]) -> tuple[float, float]:
    """Return the mean of (measured peak / predicted peak - 1), and half the width of its 95 % interval."""
    half = mean_half_width(values)
    return fmean(values), _ALONE if half is None else half


def contradicts(mean: float, half: float) -> bool:
    """Return whether the mean excess contradicts the law: its magnitude exceeds `AGREES` and `half`."""
    return abs(mean) > max(half, AGREES)


def later_excesses(
    log_dir: Path, since: datetime.date, vehicle: VehicleConfig, material: str
) -> dict[Mode, list[float]]:
    """Return (measured peak / predicted peak - 1) for each hit on a material, by mode.

    The hits are those of the vehicle's newest flights in `log_dir` that did not begin before the day
    `since`. Simulated flights and unreadable logs do not count.
    """
    found: dict[Mode, list[float]] = {}
    for path in sorted(log_dir.glob(f"*/{LOG_NAME}"), key=lambda one: one.parent.name)[-_NEWEST:]:
        try:
            log = read_log(path)
            mission = flown_mission(log.about, log.source)
            began = log.about.get("started_utc")
        except InputError:
            continue
        if log.world is not World.DRONE or began is None:
            continue
        if datetime.datetime.fromisoformat(began).date() < since:
            continue
        for one in verdict_of(log).collisions:
            speeds, mode = one.measured, Mode(one.mode)
            wall = mission.collisions[one.index - 1].wall
            if wall.material != material or one.clipped or not speeds.peak_force_n or not speeds.normal_m_s:
                continue
            contact = contact_map(
                CoefficientArrays.from_table(vehicle.materials[material].coefficients(mode)),
                mission.vehicle.airframe.mass_kg,
                -abs(speeds.normal_m_s),
                speeds.tangential_m_s or 0.0,
                Onset(vehicle.onset),
            )
            excess = speeds.peak_force_n / float(contact.peak_normal_force_n) - 1.0
            if math.isfinite(excess):
                found.setdefault(mode, []).append(excess)
    return found
