"""A recorded flight as arrays in the mission frame: what reports and identification work on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from dart_flight.base.geometry import MissionFrame
from dart_flight.base.records import ForceEstimate, OdometrySample, Record, TruthSample
from dart_flight.config.mission import Mission
from dart_flight.recording.anchor import Anchor
from dart_flight.recording.flight_time import zero_of
from dart_flight.recording.reader import Log

Array = NDArray[np.float64]
R = TypeVar("R", bound=Record)


class Motion(NamedTuple):
    """Positions (m) and velocities (m/s) in the mission frame; times in s, arrays (n,), (n, 3), (n, 3)."""

    time_s: Array
    position: Array
    velocity: Array


class Force(NamedTuple):
    """Force on the vehicle, newton, mission frame: times (n,) in s, force (n, 3)."""

    time_s: Array
    force: Array


class FlightArrays:
    """The arrays of one flight.

    Times are seconds since the zero that every output has (`flight_time`); `time_of` converts autopilot
    stamps.

    Attributes:
        start_us: the autopilot's time that is 0 s here.
        frame: the mission frame in local NED; None where the flight did not get ready.
        estimated: by PX4's estimator; empty without a frame.
        true: of the simulated vehicle; empty on the drone.
        estimated_force, true_force: likewise. An estimate stands for the mean over the IMU's tick, behind
            the accelerometer's own filter: its time here is the middle of that, not the stamp at its end.
    """

    def __init__(self, log: Log, mission: Mission) -> None:
        self.records: list[Record] = [entry.record for entry in log.entries]
        self._by_kind: dict[type[Record], list[Record]] = {}
        for record in self.records:
            self._by_kind.setdefault(type(record), []).append(record)
        self.start_us = zero_of(self.records)
        self.frame = _frame(self.records, mission)
        self.estimated = self._estimated()
        truth = self.all(TruthSample)
        time_s = self._times(truth)
        self.true = Motion(
            time_s,
            _rows(r.position_mission for r in truth),
            _rows(r.velocity_mission for r in truth),
        )
        self.true_force = Force(time_s, _rows(r.contact_force_mission for r in truth))
        estimates = self.all(ForceEstimate)
        middle_s = self._times(estimates) - mission.vehicle.imu.reading_lag_s
        self.estimated_force = Force(middle_s, _rows(r.force_mission for r in estimates))

    def all(self, kind: type[R]) -> list[R]:
        """Every record of a kind, in the order written."""
        return list(self._by_kind.get(kind, ()))  # type: ignore[arg-type]

    def time_of(self, t_us: int) -> float:
        """Seconds since the start."""
        return (t_us - self.start_us) * 1e-6

    def _times(self, records: Sequence[Any]) -> Array:
        return np.array([self.time_of(r.t_us) for r in records], dtype=float)

    def _estimated(self) -> Motion:
        frame = self.frame
        samples = self.all(OdometrySample) if frame is not None else []
        assert frame is not None or not samples
        return Motion(
            self._times(samples),
            _rows(frame.point_from_ned(s.position_ned) for s in samples if frame),
            _rows(frame.vector_from_ned(s.velocity_ned) for s in samples if frame),
        )


def _rows(vectors: Any) -> Array:
    rows = list(vectors)
    return np.array(rows, dtype=float) if rows else np.empty((0, 3))


def _frame(records: Sequence[Record], mission: Mission) -> MissionFrame | None:
    anchor = Anchor(mission)
    for record in records:
        anchor.take(record)
        if anchor.frame is not None:
            break
    return anchor.frame
