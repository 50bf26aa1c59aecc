"""A flight in progress on this computer, followed through its log; nothing here reaches the vehicle."""

from __future__ import annotations

import math
import time
from pathlib import Path

import msgspec

from dart_flight.base.geometry import Quaternion, Vec2, Vec3, attitude_in
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
from dart_flight.lab.studio.playback import outcome_line
from dart_flight.recording.about import flown_mission
from dart_flight.recording.anchor import MissionFrameReader
from dart_flight.recording.follow import LogFollower
from dart_flight.recording.found import LOG_NAME

_GROWS_S = 5.0  # a log without a new record for so long belongs to no flight in progress


class LiveState(msgspec.Struct):
    """The newest state of a flight, mission frame; position and attitude are None before they are known."""

    position: Vec3 | None = None
    quaternion: Quaternion | None = None
    speed_m_s: float = 0.0
    force_n: Vec2 = (0.0, 0.0)
    phase: str = ""
    lock: str = ""
    guard: str = ""


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
        state: its newest state.
        ended: how the flight ended, or None.
    """

    def __init__(self, log: Path) -> None:
        self.log, self.state = log, LiveState()
        self.ended: str | None = None
        self._follower = LogFollower(log)
        first = self._follower.read()
        self.mission: Mission = flown_mission(self._follower.about, str(log))
        self._frame = MissionFrameReader(self.mission)
        for entry in first:
            self._add(entry.record)

    def update(self) -> LiveState:
        """Read what has been added to the log, and return the newest state."""
        for entry in self._follower.read():
            self._add(entry.record)
        if self._follower.ended and self.ended is None:
            self.ended = "the log has ended"
        return self.state

    def _add(self, record: Record) -> None:
        self._frame.add(record)
        state, frame = self.state, self._frame.frame
        if isinstance(record, OdometrySample):
            state.speed_m_s = math.hypot(*record.velocity_ned)
            state.position = None if frame is None else frame.point_from_ned(record.position_ned)
        elif isinstance(record, AttitudeSample):
            state.quaternion = None if frame is None else attitude_in(frame, record.q_frd_to_ned)
        elif isinstance(record, ForceEstimate):
            state.force_n = record.force_mission[:2]
        elif isinstance(record, PhaseChange):
            state.phase = record.after.value
        elif isinstance(record, LockState):
            mode = record.mode.value if record.mode is not None else "unknown"
            state.lock = mode if record.phase is LockPhase.SETTLED else record.phase.value
        elif isinstance(record, GuardEvent):
            state.guard = f"{record.rule}: {record.action.value}"
        elif isinstance(record, MissionEnd):
            self.ended = outcome_line(record.outcome.value, record.reason)
