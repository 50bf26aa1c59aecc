"""The phases on the ground: from readiness to arming, and from landing to the end."""

from __future__ import annotations

import math
from typing import Final

from dart_flight.base.geometry import yaw_ned_of
from dart_flight.base.records import MissionEnd, Outcome, VehicleAction
from dart_flight.config.mission import ESTIMATE_MOVED_M, Mission
from dart_flight.core.mission.mission_progress import NO_CHANGE, Change, MissionProgress
from dart_flight.core.mission.phases import DOWN_US, PhaseTrigger
from dart_flight.core.mission.proposal import MissionFinding
from dart_flight.core.sense.state import FlightState

_STREAMING_US: Final = 200_000  # PX4 requires setpoints for this time before it accepts offboard mode
_DISARM_AFTER_US: Final = 8_000_000


class GroundPhases:
    """The phases before take-off (readiness, mission frame, offboard, arming) and the landing."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._lock_name = f"the lock is not {mission.transit_mode.value}"

    def ready(self, progress: MissionProgress, state: FlightState) -> Change:
        """Wait for telemetry, the lock and a sufficiently accurate position."""
        # PX4 may not report a standard deviation; this check then passes.
        mode, sd = self._mission.transit_mode, state.position_sd_m or 0.0
        judged = self._mission.collisions and progress.anchors is None
        limit = self._mission.vehicle.guard.position_sd_m if judged else math.inf
        sure = f"standard deviation of the position {sd:.2f} m, limit {limit:.2f} m"
        there = {
            "no IMU samples": state.imu is not None,
            "no attitude": state.attitude is not None,
            "no odometry": state.odometry is not None,
            "no local position": state.status.local_position_ok,
            sure: sd <= limit,
            self._lock_name: state.lock_is_in(mode),
        }
        if all(there.values()):
            return self._lay_frame(progress, state)._replace(phase_trigger=PhaseTrigger.READY)
        finding = None
        if progress.is_late(state):
            missing = [name for name, yes in there.items() if not yes]
            # PX4's texts explain neither an unready lock nor an uncertain position.
            why = "" if {*missing} <= {self._lock_name, sure} else state.reasons()
            finding = MissionFinding("not_ready", ", ".join(missing) + why)
        return Change(mode=mode, finding=finding)

    def _lay_frame(self, progress: MissionProgress, state: FlightState) -> Change:
        """Set the mission frame from the vehicle's position at its take-off point."""
        assert state.odometry is not None
        assert state.attitude is not None
        stood_at_ned = state.odometry.position_ned
        frame = self._mission.frame_at(stood_at_ned)
        x, y, _ = frame.point_from_ned(stood_at_ned)
        yaw = frame.yaw_from_ned(yaw_ned_of(state.attitude.q_frd_to_ned))
        course = progress.course._replace(target=(x, y, 0.0))
        heading = progress.heading._replace(yaw=yaw, yaw_us=state.now_us)
        return Change(course=course, heading=heading, frame=frame, stood_at_ned=stood_at_ned)

    def enter_offboard(self, progress: MissionProgress, state: FlightState) -> Change:
        """Request offboard mode once setpoints are streaming."""
        if state.in_offboard:
            return Change(PhaseTrigger.CONFIRMED)
        action = VehicleAction.OFFBOARD if progress.elapsed_us(state) > _STREAMING_US else None
        finding = None
        if progress.is_late(state):
            detail = "PX4 refused offboard mode" + state.reasons("offboard")
            finding = MissionFinding("offboard_refused", detail)
        return Change(action=action, finding=finding)

    def arm(self, progress: MissionProgress, state: FlightState) -> Change:
        """Request arming; the climb begins at the vehicle's current position."""
        if not state.status.armed:
            finding = None
            if progress.is_late(state):
                finding = MissionFinding("arming_refused", "PX4 refused to arm" + state.reasons("arm"))
            return Change(action=VehicleAction.ARM, finding=finding)
        assert state.odometry is not None
        moved_m = math.dist(state.odometry.position_ned, progress.stood_at_ned)
        change, reason, course = NO_CHANGE, "", progress.course
        if moved_m > ESTIMATE_MOVED_M:
            change = self._lay_frame(progress, state)
            course = change.course or course
            reason = f"confirmed by telemetry; the position estimate moved by {moved_m:.2f} m on the ground"
        climb = course.climb(self._mission.vehicle.flying)
        return change._replace(phase_trigger=PhaseTrigger.CONFIRMED, reason=reason, course=climb)

    def land(self, progress: MissionProgress, state: FlightState) -> Change:
        """Command PX4 to land, and end the mission when the vehicle is down and disarmed."""
        if progress.down_us is not None and state.now_us - progress.down_us >= DOWN_US:
            end = MissionEnd(state.now_us, Outcome.COMPLETED, None, progress.final_error_m)
            return Change(PhaseTrigger.LANDED, end=end)
        if state.on_ground and progress.elapsed_us(state) > _DISARM_AFTER_US:
            return Change(action=VehicleAction.DISARM)
        if state.in_offboard or progress.asked_us is None:
            return Change(action=VehicleAction.LAND)
        return NO_CHANGE
