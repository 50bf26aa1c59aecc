"""Where the mission frame of a recorded flight lies: found in its records as the core anchored it."""

from __future__ import annotations

from dart_flight.base.geometry import MissionFrame
from dart_flight.base.records import OdometrySample, Phase, PhaseChange, Record
from dart_flight.config.mission import Mission


class MissionFrameReader:
    """Takes the records of a flight in order.

    Attributes:
        frame: the mission frame in local NED, once the mission has left `READYING`: the vehicle then stood at
            its take-off point.
    """

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._odometry: OdometrySample | None = None
        self.frame: MissionFrame | None = None

    def take(self, record: Record) -> None:
        """Take the next record; most kinds do not matter here."""
        if self.frame is not None:
            return
        if isinstance(record, OdometrySample):
            self._odometry = record
        elif (
            isinstance(record, PhaseChange) and record.before is Phase.READYING and self._odometry is not None
        ):
            self.frame = self._mission.frame_at(self._odometry.position_ned)
