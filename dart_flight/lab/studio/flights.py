"""A flight of the studio in the fast world, in a worker process: its outcome and its thinned true path."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dart_flight.base.geometry import Vec3
from dart_flight.base.records import Record, TruthSample
from dart_flight.config.mission import Mission
from dart_flight.lab.studio.engine import FlownOne
from dart_flight.recording.verdict import Verdict
from dart_flight.run.fast import fly_fast
from dart_flight.sim.faults.fault_table import Fault

_PATH_STEP_US = 100_000  # interval of the points of a flight's line
_IN_THE_AIR_M = 0.1


def fly_one(
    mission: Mission, spreads: Mapping[str, float], fault: Fault | None, log_dir: Path | None, seed: int
) -> FlownOne:
    """Fly one seed in this process, and return the outcome with the true path."""
    line = _TruePath()
    verdict = fly_fast(mission, seed, log_dir, line, fault=fault, spreads=spreads)
    return FlownOne(
        seed,
        verdict.outcome.value,
        "; ".join(verdict.uncontrolled) or verdict.reason,
        np.array(line.points).reshape(-1, 3),
        line.hits,
        verdict.log,
        verdict.goal_miss_m,
        _peak_force_n(verdict),
    )


def _peak_force_n(verdict: Verdict) -> float | None:
    peaks = [c.measured.peak_force_n for c in verdict.collisions if c.measured.peak_force_n is not None]
    return max(peaks, default=None)


class _TruePath:
    """The true path of a flight, thinned, and the places where its contacts begin."""

    def __init__(self) -> None:
        self.points, self.hits = list[Vec3](), list[Vec3]()
        self._next_us, self._touches = 0, False

    def __call__(self, record: Record) -> None:
        if not isinstance(record, TruthSample):
            return
        touches = record.position_mission[2] > _IN_THE_AIR_M and any(record.contact_force_mission[:2])
        begins = touches and not self._touches
        self._touches = touches
        if begins:
            self.hits.append(record.position_mission)
        if begins or record.t_us >= self._next_us:
            self._next_us = record.t_us + _PATH_STEP_US
            self.points.append(record.position_mission)
