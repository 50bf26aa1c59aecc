"""The phases on the ground: from waiting for the vehicle to arming, and from landing to the end."""

from __future__ import annotations

import math
from typing import Final

from dart_flight.base.geometry import Vec3, yaw_ned_of
from dart_flight.base.records import MissionEnd, Outcome, VehicleAction
from dart_flight.config.mission import ESTIMATE_MOVED_M, Mission
from dart_flight.core.mission.anchors import FrameAnchors
from dart_flight.core.mission.lock_orders import LockOrders
from dart_flight.core.mission.mission_progress import MissionProgress
from dart_flight.core.mission.phases import DOWN_US, PhaseTrigger
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.mission.setpoint_generator import SetpointGenerator
from dart_flight.core.sense.senses import Sensed
from dart_flight.core.sense.state import FlightState

_STREAMING_US: Final = 200_000  # PX4 accepts offboard only with setpoints already streaming
_DISARM_AFTER_US: Final = 8_000_000


class GroundPhases:
    """Ready the vehicle, lay the mission frame, take offboard mode, arm; at the end land and disarm.

    Attributes:
        final_error_m: distance from the goal when it had been held; None: it was not.
    """

    def __init__(
        self,
        mission: Mission,
        progress: MissionProgress,
        lock: LockOrders,
        references: SetpointGenerator,
        anchors: FrameAnchors | None,
    ) -> None:
        self._mission, self._progress, self._lock = mission, progress, lock
        self._references, self._anchors = references, anchors
        self._lock_name = f"lock {mission.transit_mode.value}"
        self._stood_at_ned: Vec3 = (0.0, 0.0, 0.0)
        self._down_us: int | None = None  # since when landed and disarmed
        self.final_error_m: float | None = None

    def ready(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        """Wait for telemetry, lock and a position that is known well enough."""
        locked = self._lock.move_to(self._mission.transit_mode, state, p)
        sd = state.position_sd_m or 0.0  # what is not told is not judged
        judged = self._mission.collisions and self._anchors is None
        limit = self._mission.vehicle.guard.position_sd_m if judged else math.inf
        sure = f"position to {limit:.2f} m (its standard deviation by PX4 is {sd:.2f} m)"
        there = {
            "imu": state.imu is not None,
            "attitude": state.attitude is not None,
            "odometry": state.odometry is not None,
            "local position": state.status.local_position_ok,
            sure: sd <= limit,
            self._lock_name: locked,
        }
        if all(there.values()):
            self._anchor_frame(state, p)
            self._progress.go(PhaseTrigger.READY, state, p)
        elif self._progress.is_late(state):
            missing = [name for name, yes in there.items() if not yes]
            # What keeps the lock is not PX4's to say, and of its uncertainty it says nothing more.
            why = "" if {*missing} <= {self._lock_name, sure} else state.reasons()
            p.add_finding("not_ready", "no " + ", no ".join(missing) + why)

    def _anchor_frame(self, state: FlightState, p: Proposal) -> None:
        """The vehicle stands at its take-off point."""
        assert state.odometry is not None
        assert state.attitude is not None
        self._stood_at_ned = state.odometry.position_ned
        p.frame = frame = self._mission.frame_at(self._stood_at_ned)
        position = frame.point_from_ned(self._stood_at_ned)
        yaw = frame.yaw_from_ned(yaw_ned_of(state.attitude.q_frd_to_ned))
        self._references.stand(position, yaw, state.now_us)

    def take_offboard(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        """Ask for offboard mode, once setpoints are streaming."""
        if state.in_offboard:
            self._progress.go(PhaseTrigger.CONFIRMED, state, p)
            return
        if self._progress.elapsed_us(state) > _STREAMING_US:
            self._progress.ask(VehicleAction.OFFBOARD, state, p)
        if self._progress.is_late(state):
            p.add_finding("offboard_refused", "PX4 refused offboard" + state.reasons("offboard"))

    def arm(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        """Ask to arm; the climb begins from where the vehicle then stands."""
        if state.status.armed:
            assert state.odometry is not None
            moved_m = math.dist(state.odometry.position_ned, self._stood_at_ned)
            reason = ""
            if moved_m > ESTIMATE_MOVED_M:
                self._anchor_frame(state, p)
                reason = f"confirmed by telemetry; the position moved by {moved_m:.2f} m on the ground"
            self._references.climb()
            if self._anchors is not None:
                self._anchors.begin(state.now_us)
            self._progress.go(PhaseTrigger.CONFIRMED, state, p, reason)
            return
        self._progress.ask(VehicleAction.ARM, state, p)
        if self._progress.is_late(state):
            p.add_finding("arming_refused", "PX4 refused to arm" + state.reasons("arm"))

    def land(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        """Have PX4 land, and end the mission when the vehicle is down and disarmed."""
        progress = self._progress
        if not (state.on_ground and not state.status.armed):
            self._down_us = None
        elif self._down_us is None:
            self._down_us = state.now_us
        if self._down_us is not None and state.now_us - self._down_us >= DOWN_US:
            progress.go(PhaseTrigger.LANDED, state, p)
            p.end = MissionEnd(state.now_us, Outcome.COMPLETED, None, self.final_error_m)
        elif state.on_ground and progress.elapsed_us(state) > _DISARM_AFTER_US:
            progress.ask(VehicleAction.DISARM, state, p)
        elif state.in_offboard or progress.asked_us is None:
            progress.ask(VehicleAction.LAND, state, p)
