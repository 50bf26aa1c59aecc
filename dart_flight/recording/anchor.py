"""Where the mission frame of a recorded flight lies: found in its records as the core anchored it."""

from __future__ import annotations

import math

from dart_flight.base.geometry import MissionFrame
from dart_flight.base.records import FrameAnchor, OdometrySample, Phase, PhaseChange, Record
from dart_flight.config.mission import ESTIMATE_MOVED_M, Mission


class MissionFrameReader:
    """Takes the records of a flight in order.

    Attributes:
        frame: the mission frame in local NED, once the mission has left `READYING`: the vehicle then stood at
            its take-off point. Anchored once more at arming where the estimate had moved meanwhile, and moved
            by contacts where the mission says so.
    """

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._odometry: OdometrySample | None = None
        self._stood_at: OdometrySample | None = None
        self._climbs = False
        self.frame: MissionFrame | None = None

    def take(self, record: Record) -> None:
        """Take the next record; most kinds do not matter here."""
        if isinstance(record, FrameAnchor) and self.frame is not None:
            self.frame = self.frame.moved(*record.moved_mission)
        if self._climbs:
            return
        if isinstance(record, OdometrySample):
            self._odometry = record
        elif isinstance(record, PhaseChange) and self._odometry is not None:
            self._see_phase(record, self._odometry)

    def _see_phase(self, change: PhaseChange, odometry: OdometrySample) -> None:
        if change.before is Phase.READYING:
            self._anchor(odometry)
        self._climbs = change.after is Phase.CLIMB
        stood = self._stood_at
        moved = stood is not None and math.dist(odometry.position_ned, stood.position_ned) > ESTIMATE_MOVED_M
        if self._climbs and moved:
            self._anchor(odometry)

    def _anchor(self, odometry: OdometrySample) -> None:
        self._stood_at, self.frame = odometry, self._mission.frame_at(odometry.position_ned)
