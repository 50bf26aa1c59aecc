"""Simulated motion capture for the fast world. Poses go through the bridge to the autopilot in one thread."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from dart_flight.base.geometry import Quaternion, Vec3
from dart_flight.base.records import PoseSample
from dart_flight.config.mission import Mission
from dart_flight.sim.embedded_autopilot import Autopilot
from dart_flight.sim.faults.fault_table import Fault
from dart_flight.sim.motion_capture import BODY
from dart_flight.sim.pose_feed import PoseFeed
from dart_flight.vehicle.clock import Clock
from dart_flight.vehicle.motion_capture.pose_bridge import MotionCaptureBridge, forwarded_pose
from dart_flight.vehicle.motion_capture.source import RawPose, lost_pose

_SENDER = "simulated"


class _PlantPoses:
    """Pose source of simulated frames: it delivers the poses that the caller passes to `publish`."""

    problem: str | None = None
    place, remedy = "the simulated world", "end the fault"

    def __init__(self) -> None:
        self._deliver: Callable[[RawPose], None] = lambda raw: None
        self._frame = 0

    def start(self, deliver: Callable[[RawPose], None]) -> None:
        self._deliver = deliver

    def stop(self) -> None:
        self._deliver = lambda raw: None

    def publish(self, t_us: int, position_room: Vec3, q_body_to_room: Quaternion, tracked: bool) -> None:
        """Deliver one frame in room axes."""
        frame, self._frame = self._frame, self._frame + 1
        if tracked:
            self._deliver(RawPose(BODY, True, position_room, q_body_to_room, frame, t_us, _SENDER))
        else:
            self._deliver(lost_pose(BODY, frame, t_us, _SENDER))


class FastPoses:
    """Motion capture of one fast flight: the bridge passes the plant's poses to core and autopilot."""

    def __init__(
        self, mission: Mission, autopilot: Autopilot, clock: Clock, deliver: Callable[[PoseSample], None]
    ) -> None:
        autopilot.use_external_poses()
        self._autopilot = autopilot
        source = _PlantPoses()
        mocap = mission.vehicle.mocap
        self._feed = PoseFeed(mocap, source.publish, autopilot.plant.position)
        self._bridge = MotionCaptureBridge(mocap, source, self._send, clock, deliver)
        self._bridge.start()

    def tick(self) -> None:
        """Deliver and forward the pose that is due at this time."""
        self._feed.tick(self._autopilot.now_s, self._autopilot.pose)

    def withhold(self, *, attitude_only: bool) -> None:
        """Stop forwarding poses, or only their attitudes if `attitude_only`."""
        self._bridge.withhold(attitude_only=attitude_only)

    def begin_fault(self, fault: Fault) -> None:
        self._feed.begin_fault(fault, self._autopilot.now_s)

    def _send(self, message: Any) -> None:
        pose = forwarded_pose(message)
        self._autopilot.fuse_external_pose((pose.x, pose.y, pose.z), pose.attitude)
