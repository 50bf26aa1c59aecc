"""An emulated Vicon Tracker, which sends a UDP object stream with the vehicle and a second object."""

from __future__ import annotations

import math
import struct
from typing import Final

from dart_flight.base.geometry import Quaternion, Vec3, rotate
from dart_flight.sim.motion_capture.datagram_sender import DatagramSender

_BLOCK: Final = struct.Struct("<IB")
_OBJECT: Final = struct.Struct("<BH24s6d")
_DATA_SIZE: Final = 72  # name, translation and rotation
_OTHER: Final = ("wand", (1000.0, -500.0, 20.0, 0.0, 0.0, 0.3))


def euler_xyz(q: Quaternion) -> Vec3:
    """Return the Euler angles of an attitude, rad: rotations about x, then the new y, then the new z."""
    forward, left, up = (rotate(q, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    y = math.asin(max(-1.0, min(1.0, up[0])))
    return (math.atan2(-up[1], up[2]), y, math.atan2(-left[0], forward[0]))


class ViconSender(DatagramSender):
    """Sender of Tracker's object stream."""

    def __init__(self, body: str) -> None:
        super().__init__("vicon", body)
        self._body, self._frame = body, 0

    def publish(
        self, t_us: int, position_room: Vec3, q_body_to_room: Quaternion, tracked: bool = True
    ) -> None:
        """Send one frame with both objects; the stream has no time stamp."""
        values: tuple[float, ...] = (0.0,) * 6
        if tracked:
            values = (*(1e3 * x for x in position_room), *euler_xyz(q_body_to_room))
        data = _BLOCK.pack(self._frame % 2**32, 2)
        for name, numbers in (_OTHER, (self._body, values)):
            data += _OBJECT.pack(0, _DATA_SIZE, name.encode()[:23], *numbers)
        self._frame += 1
        self.send(data)
