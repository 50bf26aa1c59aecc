"""A flight in progress on this computer, followed through its log; nothing here reaches the vehicle."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.records import (
    AttitudeSample,
    ForceEstimate,
    GuardEvent,
    LockPhase,
    LockState,
    MissionEnd,
    OdometrySample,
    PhaseChange,
    Record,
)
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.lab.flight_arrays import Array, turned
from dart_flight.lab.studio.playback import outcome_line, quaternions
from dart_flight.recording.about import flown_mission
from dart_flight.recording.anchor import MissionFrameReader
from dart_flight.recording.follow import LogFollower
from dart_flight.recording.found import LOG_NAME

_GROWS_S = 5.0  # a log without a new record for so long belongs to no flight in progress
_AXES = np.eye(3) * (1.0, -1.0, -1.0)  # forward, left and up in FRD


class LiveState(NamedTuple):
    """The newest state of a flight, mission frame; None before the mission frame is known."""

    position: Vec3
    quaternion: Array
    speed_m_s: float
    force_n: Vec2
    phase: str
    lock: str
    guard: str


def growing_log(log_dir: Path) -> Path:
    """Return the log that is being written below a folder.

    Raises:
        InputError: no log grows.
    """
    grown = {path: path.stat().st_mtime for path in log_dir.glob(f"*/{Path(LOG_NAME).stem}*.mcap")}
    newest = max(grown, key=grown.__getitem__, default=None)
    if newest is None or time.time() - grown[newest] > _GROWS_S:
        raise InputError("no flight in progress writes its log below this folder", source=str(log_dir))
    return newest.parent / LOG_NAME


class WatchedFlight:
    """The flight of a growing log.

    Attributes:
        mission: the mission that is flown.
        ended: how the flight ended, or None.
    """

    def __init__(self, log: Path) -> None:
        self.log, self.ended = log, None if log.exists() else "the log is gone"
        self._follower = LogFollower(log)
        first = [entry.record for entry in self._follower.read()]
        self.mission: Mission = flown_mission(self._follower.about, str(log))
        self._frame = MissionFrameReader(self.mission)
        self._odometry: OdometrySample | None = None
        self._attitude: AttitudeSample | None = None
        self._force: Vec2 = (0.0, 0.0)
        self._phase = self._lock = self._guard = ""
        for record in first:
            self._add(record)

    def update(self) -> LiveState | None:
        """Read what has been added to the log, and return the newest state."""
        for entry in self._follower.read():
            self._add(entry.record)
        if self._follower.ended and self.ended is None:
            self.ended = "the log has ended"
        frame, odometry, attitude = self._frame.frame, self._odometry, self._attitude
        if frame is None or odometry is None or attitude is None:
            return None
        body = [turned(np.array([attitude.q_frd_to_ned]), axis)[0] for axis in _AXES]
        forward, left, up = (frame.vector_from_ned((v[0], v[1], v[2])) for v in body)
        yaw = math.atan2(forward[1], forward[0])
        pitch, roll = math.asin(max(-1.0, min(1.0, forward[2]))), math.atan2(left[2], up[2])
        angles = (np.array([angle]) for angle in (yaw, pitch, roll))
        return LiveState(
            frame.point_from_ned(odometry.position_ned),
            quaternions(*angles)[0],
            math.hypot(*odometry.velocity_ned),
            self._force,
            self._phase,
            self._lock,
            self._guard,
        )

    def _add(self, record: Record) -> None:
        self._frame.add(record)
        if isinstance(record, OdometrySample):
            self._odometry = record
        elif isinstance(record, AttitudeSample):
            self._attitude = record
        elif isinstance(record, ForceEstimate):
            self._force = record.force_mission[:2]
        elif isinstance(record, PhaseChange):
            self._phase = record.after.value
        elif isinstance(record, LockState):
            mode = record.mode.value if record.mode is not None else "unknown"
            self._lock = mode if record.phase is LockPhase.SETTLED else record.phase.value
        elif isinstance(record, GuardEvent):
            self._guard = f"{record.rule}: {record.action.value}"
        elif isinstance(record, MissionEnd):
            self.ended = outcome_line(record.outcome.value, record.reason)
