"""An emulated system that sends poses as JSON objects, in the format of `vehicle.motion_capture.json_udp`."""

from __future__ import annotations

import json

from dart_flight.base.geometry import Quaternion, Vec3
from dart_flight.sim.motion_capture.datagram_sender import DatagramSender


class JsonSender(DatagramSender):
    """Sender of JSON poses of one body."""

    def __init__(self, body: str) -> None:
        super().__init__("udp", body)
        self._body, self._frame = body, 0

    def publish(
        self, t_us: int, position_room: Vec3, q_body_to_room: Quaternion, tracked: bool = True
    ) -> None:
        pose: dict[str, object] = {"body": self._body, "frame": self._frame, "time_s": 1e-6 * t_us}
        if tracked:
            pose |= {"position_m": position_room, "quaternion_wxyz": q_body_to_room}
        self._frame += 1
        self.send(json.dumps(pose | {"tracked": tracked}).encode())
