"""A recorded flight as arrays in the mission frame, for reports and identification."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from dart_flight.base.geometry import MissionFrame, Vec3
from dart_flight.base.records import (
    ForceEstimate,
    FrameAnchor,
    OdometrySample,
    PhaseChange,
    PoseSample,
    Record,
    TruthSample,
    World,
)
from dart_flight.config.mission import Mission
from dart_flight.recording.anchor import MissionFrameReader
from dart_flight.recording.flight_time import find_zero
from dart_flight.recording.reader import Log
from dart_flight.recording.topics import Topic

Array = NDArray[np.float64]
R = TypeVar("R", bound=Record)
_AXES: tuple[Vec3, ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class MotionArrays(NamedTuple):
    """A motion: times (n,) in s, positions (n, 3) in m and velocities (n, 3) in m/s, in the mission frame."""

    time_s: Array
    position: Array
    velocity: Array


class PoseArrays(NamedTuple):
    """Poses as the motion capture measured them, not as PX4's estimator filtered them.

    Attributes:
        time_s: (n,), time of measurement.
        position: (n, 3), m, in the mission frame.
        is_timed: whether the age of a pose is known, so that its time is the receipt minus this age.
    """

    time_s: Array
    position: Array
    is_timed: bool


class ForceArrays(NamedTuple):
    """A force: times (n,) in s and the force on the vehicle (n, 3) in newton, in the mission frame."""

    time_s: Array
    force: Array


class FlightArrays:
    """The arrays of one flight. Times are in seconds since the first IMU sample.

    Attributes:
        records: every record of the log in order.
        start_us: the autopilot's time at 0 s.
        frame: the first mission frame in local NED, or None if the flight never became ready. Contacts may
            move the frame (`frame_at`); each position is converted with the frame valid at its time.
        estimated: the motion estimated by PX4; empty without a frame.
        true: the true motion of a simulated vehicle; empty for a real vehicle.
        estimated_force: the force estimated by the flight core. Its times are corrected for the lag of the
            IMU's reading.
        true_force: the true force of a simulated vehicle; empty for a real vehicle.
    """

    def __init__(self, log: Log, mission: Mission) -> None:
        self.log, self._mission = log, mission
        self.records: list[Record] = [entry.record for entry in log.entries]
        self.start_us = find_zero(self.records)
        self._frames = _frames(self.records, mission)
        self.frame = self._frames[0][1] if self._frames else None
        odometry = self.topic_in_ned(OdometrySample)
        self.estimated = MotionArrays(
            odometry.t_s,
            self.places_from_ned(odometry["position_ned"], odometry.t_s),
            self.from_ned(odometry["velocity_ned"]),
        )
        truth, force = self.topic(TruthSample), self.topic(ForceEstimate)
        self.true = MotionArrays(truth.t_s, truth["position_mission"], truth["velocity_mission"])
        self.true_force = ForceArrays(truth.t_s, truth["contact_force_mission"])
        middle_s = force.t_s - mission.vehicle.imu.reading_lag_s
        self.estimated_force = ForceArrays(middle_s, force["force_mission"])

    @cached_property
    def posed(self) -> PoseArrays:
        """The poses that this program forwarded to PX4; empty without motion capture or mission frame."""
        samples = self.topic_in_ned(PoseSample)
        tracked: list[PoseSample] = [s for s in samples.records if isinstance(s, PoseSample) and s.tracked]
        received = np.array([s.t_us for s in tracked], dtype=float)
        stamps = [s.source_us for s in tracked if s.source_us is not None]
        if stamps and len(stamps) == len(tracked):  # unlike the receipt, these stamps have no jitter
            own = np.array(stamps, dtype=float)
            received = own + (received - own).min()
        rising = np.diff(np.maximum.accumulate(received), prepend=-np.inf) > 0.0
        mocap = self._mission.vehicle.mocap
        delay_s = None if mocap.delay_ms is None else 1e-3 * mocap.delay_ms
        if delay_s is None and self.log.world not in (World.DRONE, None):
            delay_s = self._mission.vehicle.simulation.pose_delay_s
        time_s = (received - self.start_us) * 1e-6 - (delay_s or 0.0)
        room = mocap.room_frame()
        places = [room.pose_to_ned(s.position_room, s.q_body_to_room)[0] for s in tracked]
        position = self.places_from_ned(np.array(places, dtype=float).reshape(-1, 3), time_s)
        return PoseArrays(time_s[rising], position[rising], delay_s is not None)

    def topic(self, kind: type[Record]) -> Topic:
        return self.log[kind.topic]

    def all(self, kind: type[R]) -> list[R]:
        return list(self.topic(kind).records)  # type: ignore[arg-type]

    def time_of(self, t_us: int) -> float:
        """Return the time of an autopilot stamp, in seconds since the first IMU sample."""
        return (t_us - self.start_us) * 1e-6

    def topic_in_ned(self, kind: type[Record]) -> Topic:
        """Return the records of a kind, or an empty topic if the flight has no mission frame."""
        return self.topic(kind) if self.frame is not None else Topic(kind, [], np.empty(0))

    def frame_at(self, t_us: int) -> MissionFrame | None:
        """Return the mission frame valid at a time; before the first frame begins, return the first frame."""
        laid = [frame for from_us, frame in self._frames if from_us <= t_us]
        return laid[-1] if laid else self.frame

    def from_ned(self, vectors: Array) -> Array:
        """Rotate directions (n, 3) from local NED into the mission frame."""
        frame = self.frame or MissionFrame()
        return np.asarray(vectors @ np.array([frame.vector_from_ned(axis) for axis in _AXES]))

    def places_from_ned(self, places: Array, time_s: Array) -> Array:
        """Convert positions (n, 3) from local NED to the mission frame that is valid at their times."""
        if not self._frames:
            return self.from_ned(places)
        begin_s = [self.time_of(t_us) for t_us, _ in self._frames]
        origins = np.array([frame.point_from_ned((0.0, 0.0, 0.0)) for _, frame in self._frames])
        index = np.maximum(0, np.searchsorted(begin_s, time_s, side="right") - 1)
        return np.asarray(self.from_ned(places) + origins[index])


def turned(q_frd_to_ned: Array, body: Array) -> Array:
    """Rotate one vector, or one vector per attitude, from FRD to NED by attitudes (n, 4)."""
    scalar, vector = q_frd_to_ned[:, :1], q_frd_to_ned[:, 1:]
    turn = 2.0 * np.cross(vector, body)
    return np.asarray(body + scalar * turn + np.cross(vector, turn))


def _frames(records: Sequence[Record], mission: Mission) -> list[tuple[int, MissionFrame]]:
    """Return the mission frames of a flight in order, each with the autopilot's time at which it begins."""
    reader = MissionFrameReader(mission)
    found: list[tuple[int, MissionFrame]] = []
    for record in records:
        reader.add(record)
        if not isinstance(record, PhaseChange | FrameAnchor) or reader.frame is None:
            continue
        if not found or reader.frame is not found[-1][1]:
            found.append((record.t_us, reader.frame))
    return found
