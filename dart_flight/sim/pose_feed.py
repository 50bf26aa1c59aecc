"""Frames of the simulated motion capture, with injected faults, for a pose source or an emulated server."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from dart_flight.base.geometry import (
    Quaternion,
    Vec3,
    add,
    quaternion_from_rotation_vector,
    quaternion_multiply,
)
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle.mocap import MotionCapture
from dart_flight.sim.faults.fault_table import Fault
from dart_flight.sim.motion_capture import BODY, make_server
from dart_flight.sim.plant import Plant

Pose = tuple[float, Vec3, Quaternion]  # time of measurement (s), position NED (m), attitude FRD to NED


class PoseFeed:
    """A converter of the pose sensor's output to frames in the room's axes.

    Args:
        mocap: defines the axes of the room and of the marker body.
        publish: `PoseServer.publish` of an emulated server, or the same function of a pose source in this
            process.
        other_ned: position of another vehicle's marker body for the fault `mocap-other-body`, metres.

    Attributes:
        frames: number of frames published.
        tracked: whether the newest frame contains the body.
    """

    def __init__(
        self,
        mocap: MotionCapture,
        publish: Callable[[int, Vec3, Quaternion, bool], object],
        other_ned: Vec3,
    ) -> None:
        self._room, self._publish, self._other = mocap.room_frame(), publish, other_ned
        self.frames, self.tracked = 0, True
        self._fault: Fault | None = None
        self._began_s = 0.0
        self._waiting: deque[tuple[float, Pose]] = deque()  # due time (s) and pose
        self._sent_s = -math.inf

    def begin_fault(self, fault: Fault, now_s: float) -> None:
        self._fault, self._began_s = fault, now_s

    def tick(self, now_s: float, pose: Pose | None) -> bool:
        """Advance to `now_s` with the sensor's output in this tick; return whether a frame was published."""
        name, value = ("", 0.0) if self._fault is None else (self._fault.name, self._fault.value)
        if pose is not None:
            self._waiting.append((now_s + (1e-3 * value if name == "mocap-late" else 0.0), pose))
        if not self._waiting or self._waiting[0][0] > now_s:
            return False
        _, (t_s, position, attitude) = self._waiting.popleft()
        if name == "mocap-slow" and now_s - self._sent_s < 1.0 / value - 1e-6:
            return False
        self._sent_s = now_s
        if name == "mocap-other-body":
            position, attitude = add(self._other, (value, 0.0, 0.0)), (1.0, 0.0, 0.0, 0.0)
        elif name == "mocap-flip":
            turn = quaternion_from_rotation_vector((0.0, 0.0, math.radians(value)))
            attitude = quaternion_multiply(attitude, turn)
        self.tracked = name != "mocap-lost" or now_s - self._began_s > value
        self.frames += 1
        room_pose = self._room.pose_from_ned(position, attitude)
        self._publish(round(1e6 * t_s), *room_pose, self.tracked)
        return True


class EmulatedMotionCapture:
    """An emulated server that sends the poses of a world in a separate process.

    Args:
        kind: key of `motion_capture.KINDS`.
        plant: the tracked body.

    Attributes:
        url: URL of the pose source for this server.
    """

    def __init__(self, kind: str, mission: Mission, plant: Plant) -> None:
        self._server = make_server(kind, BODY)
        self.url = self._server.url
        self.feed = PoseFeed(mission.vehicle.mocap, self._server.publish, plant.position)
        self._published_s = -math.inf
        self._heard = False
        self._sends_lost = kind != "vrpn"  # VRPN has no message for a lost body

    def publish(self, now_s: float, pose: Pose | None) -> int | None:
        """Publish a frame if one is due, and return its number.

        The result is None if no frame is due or no client has connected so far. It is also None if the body
        is lost and the protocol cannot report this (VRPN).
        """
        if now_s <= self._published_s:
            return None  # time has not advanced
        self._published_s = now_s
        self._heard = self._heard or self._server.clients > 0
        sent = self.feed.tick(now_s, pose) and (self.feed.tracked or self._sends_lost)
        return self.feed.frames - 1 if sent and self._heard else None

    def close(self) -> None:
        self._server.close()
