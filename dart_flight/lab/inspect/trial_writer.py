"""Writer of a log's impacts as trials for `identify`."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from dart_flight.lab.csv_text import csv_text
from dart_flight.lab.inspect.impacts import InspectedFlight

_TRIAL_BEFORE_S, _TRIAL_AFTER_S = 0.5, 0.4


def write_trials(flight: InspectedFlight, folder: Path) -> list[Path]:
    """Write every impact of a flight as a CSV trial, in the collision frame given by the impact's force.

    Normal positions count from the vehicle's position at the onset. Without a mass there is no force column.
    """
    series, written = flight.series, []
    if series is None:
        return []
    folder.mkdir(parents=True, exist_ok=True)
    mass = flight.threshold_n / flight.threshold_m_s2 if flight.threshold_n is not None else None
    for number, impact in enumerate((i for i in flight.impacts if i.kind == "impact"), 1):
        heading = math.radians(impact.direction_deg)
        normal = np.array([math.cos(heading), math.sin(heading)])
        tangent = np.array([-normal[1], normal[0]])
        time = series.time_s - impact.t_s
        near = (time > -_TRIAL_BEFORE_S) & (time < _TRIAL_AFTER_S)
        if not near.any() or len(series.position_s) < 2:
            continue
        at = series.time_s[near]
        place = np.stack(
            [np.interp(at, series.position_s, series.position_ned[:, k]) for k in range(3)], axis=1
        )
        touch = [np.interp(impact.t_s, series.position_s, series.position_ned[:, k]) for k in range(3)]
        moved = place - np.array(touch)
        rows = {
            "time_s": time[near],
            "normal_m": moved[:, :2] @ normal,
            "tangential_m": moved[:, :2] @ tangent,
            "vertical_m": -place[:, 2],
        }
        if mass is not None:
            force = mass * series.force_m_s2[near, :2]
            rows["normal_force_n"], rows["tangential_force_n"] = force @ normal, force @ tangent
        path = folder / f"{Path(flight.log).stem}_impact{number}.csv"
        values = zip(*([f"{v:.6f}" for v in column] for column in rows.values()), strict=True)
        path.write_text(csv_text([rows, *values]), encoding="utf-8", newline="")
        written.append(path)
    return written
