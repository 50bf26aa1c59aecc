"""Decoders for NatNet packets (server information, rigid bodies, frames) of protocol versions 2 to 4.

The layout is from the NatNet SDK's public documentation and headers. All values are little-endian. The
program needs one rigid body and skips all other assets, because an asset that it cannot decode must not hide
the body. Since version 4.1 each description and each list in a frame states its size. In older streams
everything before the rigid body must be decoded. The decoders raise ValueError for a damaged packet.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from dart_flight.base.geometry import Quaternion, Vec3

CONNECT, SERVER_INFO, REQUEST_MODEL, MODEL, FRAME, KEEP_ALIVE = 0, 1, 4, 5, 7, 10
HEADER: Final = struct.Struct("<HH")  # kind, size of the payload
# Name and version of the application, version of NatNet. NatNet 3 adds the clock's ticks per second, the data
# port, whether the server uses multicast, and the group's address.
_SERVER: Final = struct.Struct("<256s4B4B")
_TRANSMISSION: Final = struct.Struct("<QHB4B")
_SIZED: Final = (4, 1)  # first version in which descriptions and lists have a size
_RIGID_BODY: Final = 1  # kind of a description
_POSE: Final = "<I7f"  # id, position, attitude as x, y, z, w
_TRACKED: Final = 1  # this bit of a rigid body's parameters is set if the body is tracked

Version = tuple[int, int]


class ServerInfo(NamedTuple):
    """A server's NatNet version and its use of multicast; the defaults apply to servers before NatNet 3."""

    version: Version = (2, 0)
    ticks_per_s: int = 0
    data_port: int = 1511
    multicast: bool = True
    group: str = "239.255.42.99"


class BodyPose(NamedTuple):
    """The pose of a rigid body in a frame, in metres."""

    position_room: Vec3
    q_body_to_room: Quaternion
    tracked: bool


class Frame(NamedTuple):
    """A frame's number, its stamp, and the body's pose; a stamp or pose that the frame lacks is None."""

    number: int
    stamp_us: int | None
    body: BodyPose | None


def split_packet(data: bytes) -> tuple[int, bytes]:
    """Return the kind of a packet, and its payload."""
    if len(data) < HEADER.size:
        raise ValueError("the packet has no header")
    return int(HEADER.unpack_from(data)[0]), data[HEADER.size :]


def decode_server_info(data: bytes) -> ServerInfo | None:
    """Decode a server's answer to a connection request; return None for other data."""
    start = HEADER.size + _SERVER.size
    if len(data) < start or HEADER.unpack_from(data)[0] != SERVER_INFO:
        return None
    version = (data[start - 4], data[start - 3])
    if len(data) < start + _TRANSMISSION.size:
        return ServerInfo(version)
    ticks, port, multicast, *group = _TRANSMISSION.unpack_from(data, start)
    return ServerInfo(version, ticks, port, bool(multicast), ".".join(map(str, group)))


class _Reader:
    """A position in a packet; reading beyond the packet's end raises ValueError."""

    def __init__(self, data: bytes) -> None:
        self._data, self._place = data, 0

    def skip(self, size: int) -> bytes:
        """Return the next bytes and move past them."""
        part = self._data[self._place : self._place + size]
        if len(part) < size:
            raise ValueError("the packet is too short")
        self._place += size
        return part

    def unpack(self, layout: str) -> tuple[Any, ...]:
        return struct.unpack(layout, self.skip(struct.calcsize(layout)))

    def count(self) -> int:
        return int(self.unpack("<I")[0])

    def text(self) -> str:
        """Read a null-terminated string; Motive sends Latin-1 on Windows systems without UTF-8."""
        end = self._data.find(b"\0", self._place)
        if end < 0:
            raise ValueError("a name is not terminated")
        raw = self.skip(end + 1 - self._place)[:-1]
        try:
            return raw.decode()
        except UnicodeDecodeError:
            return raw.decode("latin-1")

    def skip_items(self, skip_item: Callable[[_Reader], object]) -> None:
        for _ in range(self.count()):
            skip_item(self)


def decode_bodies(payload: bytes, version: Version) -> tuple[dict[str, int], str]:
    """Return name -> streaming id of the rigid bodies, and why the list may be incomplete, or ""."""
    reader, bodies = _Reader(payload), dict[str, int]()
    for place in range(reader.count()):
        kind = reader.count()
        part = _Reader(reader.skip(reader.count())) if version >= _SIZED else reader
        try:
            if kind == _RIGID_BODY:
                name, number = _description(part, version)
                bodies[name] = number
            elif version < _SIZED:
                _SKIP_DESCRIPTION[kind](part, version)
        except (ValueError, KeyError):
            if version < _SIZED:
                return bodies, f"description {place + 1}, of type {kind}, cannot be read: stop streaming it"
    return bodies, ""


def _description(reader: _Reader, version: Version) -> tuple[str, int]:
    name = reader.text()
    number = reader.count()
    reader.skip(4 + 12 + (16 if version >= (4, 2) else 0))  # parent, position, attitude
    if version >= (3, 0):
        markers = reader.count()
        reader.skip(16 * markers)  # positions and labels
        if version >= (4, 0):
            for _ in range(markers):
                reader.text()
    return name, number


def _skip_marker_set(reader: _Reader, _: Version) -> None:
    reader.text()
    reader.skip_items(_Reader.text)


def _skip_skeleton(reader: _Reader, version: Version) -> None:
    reader.text()
    reader.skip(4)
    reader.skip_items(lambda part: _description(part, version))


def _skip_force_plate(reader: _Reader, _: Version) -> None:
    reader.skip(4)
    reader.text()
    reader.skip(4 * (2 + 3 + 12 * 12 + 4 * 3))  # size, origin, calibration, corners
    reader.skip(8)
    reader.skip_items(_Reader.text)


def _skip_device(reader: _Reader, _: Version) -> None:
    reader.skip(4)
    reader.text()
    reader.text()
    reader.skip(8)
    reader.skip_items(_Reader.text)


def _skip_camera(reader: _Reader, _: Version) -> None:
    reader.text()
    reader.skip(4 * 7)


_SKIP_DESCRIPTION: Final[dict[int, Callable[[_Reader, Version], None]]] = {
    0: _skip_marker_set,
    2: _skip_skeleton,
    3: _skip_force_plate,
    4: _skip_device,
    5: _skip_camera,
}


def decode_frame(payload: bytes, server: ServerInfo, wanted: int | None) -> Frame:
    """Decode a frame, including the pose of the body whose streaming id is `wanted`."""
    reader, version = _Reader(payload), server.version
    number = reader.count()
    _skip_list(reader, version, _skip_marker_positions)
    _skip_list(reader, version, lambda part: part.skip(12))  # unlabelled markers
    body = _find_body(reader, version, wanted)
    if version >= (2, 1):  # skeletons
        _skip_list(reader, version, lambda part: _skip_skeleton_poses(part, version))
    if version >= _SIZED:  # trained markersets
        _skip_list(reader, version, _skip_nothing)
    if version >= (2, 3):
        labelled = 20 + (2 if version >= (2, 6) else 0) + (4 if version >= (3, 0) else 0)
        _skip_list(reader, version, lambda part: part.skip(labelled))
    if version >= (2, 9):  # force plates
        _skip_list(reader, version, _skip_channels)
    if version >= (2, 11):  # devices
        _skip_list(reader, version, _skip_channels)
    return Frame(number, _stamp_us(reader, server), body)


def _skip_list(reader: _Reader, version: Version, skip_item: Callable[[_Reader], object]) -> None:
    if version >= _SIZED:
        reader.count()
        reader.skip(reader.count())
    else:
        reader.skip_items(skip_item)


def _skip_nothing(reader: _Reader) -> None:
    """Do nothing: a list of such items always states its size, so its items are never read."""


def _skip_marker_positions(reader: _Reader) -> None:
    reader.text()
    reader.skip(12 * reader.count())


def _skip_skeleton_poses(reader: _Reader, version: Version) -> None:
    reader.skip(4)
    reader.skip_items(lambda part: _pose(part, version))


def _skip_channels(reader: _Reader) -> None:
    reader.skip(4)
    reader.skip_items(lambda part: part.skip(4 * part.count()))


def _find_body(reader: _Reader, version: Version, wanted: int | None) -> BodyPose | None:
    found = None
    count = reader.count()
    size = reader.count() if version >= _SIZED else 0
    data = _Reader(reader.skip(size)) if version >= _SIZED else reader
    for _ in range(count):
        part = _Reader(data.skip(size // count)) if version >= _SIZED else data
        number, pose = _pose(part, version)
        if number == wanted and found is None:
            found = pose
    return found


def _pose(reader: _Reader, version: Version) -> tuple[int, BodyPose]:
    number, px, py, pz, x, y, z, w = reader.unpack(_POSE)
    if version < (3, 0):
        reader.skip(20 * reader.count())  # positions, ids and sizes of the markers
    reader.skip(4)  # mean error of the markers
    tracked = bool(reader.unpack("<H")[0] & _TRACKED) if version >= (2, 6) else any((x, y, z, w))
    return number, BodyPose((px, py, pz), (w, x, y, z), tracked)


def _stamp_us(reader: _Reader, server: ServerInfo) -> int | None:
    reader.skip(8)  # timecode
    (seconds,) = reader.unpack("<d" if server.version >= (2, 7) else "<f")
    ticks = reader.unpack("<3Q")[0] if server.version >= (3, 0) else 0  # time of the middle of the exposure
    if ticks and server.ticks_per_s:
        return int(ticks) * 1_000_000 // server.ticks_per_s
    return round(1e6 * seconds) if math.isfinite(1e6 * seconds) else None
