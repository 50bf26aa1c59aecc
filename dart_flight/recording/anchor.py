"""The mission frame that the core used in a recorded flight, reconstructed from the flight's records."""

from __future__ import annotations

import math

from dart_flight.base.geometry import MissionFrame
from dart_flight.base.records import FrameAnchor, OdometrySample, Phase, PhaseChange, Record
from dart_flight.config.mission import ESTIMATE_MOVED_M, Mission


class MissionFrameReader:
    """A tracker of the mission frame during a flight; `add` receives the flight's records in order.

    `frame` is in local NED. The frame is None until the mission leaves the phase `READYING`. The frame is
    then anchored at the take-off point. If the position estimate then changes before the climb, the frame is
    anchored again at the start of the climb. In a mission anchored by touch, contacts displace the frame.
    """

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._odometry: OdometrySample | None = None
        self._anchored_at: OdometrySample | None = None
        self._climbs = False
        self.frame: MissionFrame | None = None

    def add(self, record: Record) -> None:
        if type(record) is FrameAnchor and self.frame is not None:
            self.frame = self.frame.displaced(*record.moved_mission)
        if self._climbs:
            return
        if type(record) is OdometrySample:
            self._odometry = record
        elif type(record) is PhaseChange and self._odometry is not None:
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
