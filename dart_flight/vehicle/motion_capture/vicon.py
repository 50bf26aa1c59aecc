"""A pose source for Vicon Tracker's UDP object stream (Tracker: Local Vicon System, UDP Object Stream).

The layout is from public readers of the stream, not from Tracker's user guide. A datagram is one
little-endian block: frame number (u32), number of items (u8), and the items. Each item has an id (u8, 0 for
an object), the size of its data (u16) and the data. An object's data are its name (24 bytes, padded with
zeros), translation (3 doubles, millimetres) and Euler angles XYZ (3 doubles, radians). A frame with many
objects takes several datagrams. An object that is missing in one of them may therefore be tracked. If all
values of an object are zero, the object is not tracked.
"""

from __future__ import annotations

import math
import struct
from typing import Final

from dart_flight.base.geometry import quaternion_from_intrinsic_xyz
from dart_flight.vehicle.motion_capture.datagram_source import DatagramSource
from dart_flight.vehicle.motion_capture.source import PoseAddress, RawPose, in_quotes, lost_pose

_BLOCK: Final = struct.Struct("<IB")
_ITEM: Final = struct.Struct("<BH")
_OBJECT: Final = struct.Struct("<24s6d")
_OBJECT_ID: Final = 0
_NO_ATTITUDE: Final = (math.nan,) * 4


def decode(data: bytes, body: str, sender: str) -> RawPose | str:
    """Return the pose of a body in a block, or the reason why the block contains no such pose."""
    if len(data) < _BLOCK.size:
        return "the datagram is shorter than a block of Vicon's object stream"
    frame_number, items = _BLOCK.unpack_from(data)
    place, names = _BLOCK.size, []
    for _ in range(items):
        if place + _ITEM.size > len(data):
            return "a block of Vicon's object stream has fewer items than its header specifies"
        item, size = _ITEM.unpack_from(data, place)
        place += _ITEM.size
        if place + size > len(data) or (item == _OBJECT_ID and size != _OBJECT.size):
            return "an item of Vicon's object stream has a wrong size"
        if item == _OBJECT_ID:
            raw_name, *values = _OBJECT.unpack_from(data, place)
            name = raw_name.partition(b"\0")[0].decode("utf-8", "replace")
            if name == body:
                return _pose(body, values, frame_number, sender)
            names.append(name)
        place += size
    return f'no object "{body}", only {in_quotes(names)}'


def _pose(body: str, values: list[float], frame_number: int, sender: str) -> RawPose:
    if not any(values):
        return lost_pose(body, frame_number, None, sender)
    x, y, z = (1e-3 * value for value in values[:3])
    angles = values[3:]
    attitude = quaternion_from_intrinsic_xyz(*angles) if all(map(math.isfinite, angles)) else _NO_ATTITUDE
    return RawPose(body, True, (x, y, z), attitude, frame_number, None, sender)


def open_source(address: PoseAddress) -> DatagramSource:
    return DatagramSource(address, decode)
