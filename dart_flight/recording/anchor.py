"""The mission frame of a recorded flight, reconstructed from its records as the core anchored it."""

from __future__ import annotations

import math

from dart_flight.base.geometry import MissionFrame
from dart_flight.base.records import FrameAnchor, OdometrySample, Phase, PhaseChange, Record
from dart_flight.config.mission import ESTIMATE_MOVED_M, Mission


class MissionFrameReader:
    """Tracks the mission frame over a flight's records, which it receives in order.

    Attributes:
        frame: the mission frame in local NED, or None before the mission leaves `READYING`. The frame is
            then anchored at the take-off point, and once more at the start of the climb if the position
            estimate has changed in between. In a mission anchored by touch, contacts displace the frame.
    """

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._odometry: OdometrySample | None = None
        self._anchored_at: OdometrySample | None = None
        self._climbs = False
        self.frame: MissionFrame | None = None

    def add(self, record: Record) -> None:
        """Process the next record; most kinds are ignored."""
        if isinstance(record, FrameAnchor) and self.frame is not None:
            self.frame = self.frame.displaced(*record.moved_mission)
        if self._climbs:
            return
        if isinstance(record, OdometrySample):
            self._odometry = record
        elif isinstance(record, PhaseChange) and self._odometry is not None:
            self._handle_phase(record, self._odometry)

    def _handle_phase(self, change: PhaseChange, odometry: OdometrySample) -> None:
        if change.before is Phase.READYING:
            self._anchor(odometry)
        self._climbs = change.after is Phase.CLIMB
        anchored = self._anchored_at
        moved = (
            anchored is not None
            and math.dist(odometry.position_ned, anchored.position_ned) > ESTIMATE_MOVED_M
        )
        if self._climbs and moved:
            self._anchor(odometry)

    def _anchor(self, odometry: OdometrySample) -> None:
        self._anchored_at, self.frame = odometry, self._mission.frame_at(odometry.position_ned)
