"""A pose source for any other system: one JSON object per datagram (docs/motion_capture.md)."""

from __future__ import annotations

from typing import Annotated, Final

import msgspec
from msgspec import Meta

from dart_flight.base.geometry import Quaternion, Vec3
from dart_flight.vehicle.motion_capture.datagram_source import DatagramSource
from dart_flight.vehicle.motion_capture.source import PoseAddress, RawPose, lost_pose

_MAX_S: Final = 1e11


class _Pose(msgspec.Struct):
    position_m: Vec3 | None = None
    quaternion_wxyz: Quaternion | None = None
    tracked: bool = True
    frame: Annotated[int, Meta(ge=0, le=2**63 - 1)] | None = None
    time_s: float | None = None
    body: str | None = None


_DECODER = msgspec.json.Decoder(_Pose)


def decode(data: bytes, body: str, sender: str) -> RawPose | str:
    """Return the pose in a datagram, or the reason why the datagram contains none."""
    try:
        pose = _DECODER.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        return f"not a pose in JSON ({str(error)[:80]})"
    if pose.body is not None and pose.body != body:
        return "the pose is of another body"
    if pose.time_s is not None and not abs(pose.time_s) < _MAX_S:
        return "time_s is not a time in seconds"
    source_us = round(1e6 * pose.time_s) if pose.time_s is not None else None
    if not pose.tracked:
        return lost_pose(body, pose.frame, source_us, sender)
    if pose.position_m is None or pose.quaternion_wxyz is None:
        return "position_m or quaternion_wxyz is missing"
    return RawPose(body, True, pose.position_m, pose.quaternion_wxyz, pose.frame, source_us, sender)


def open_source(address: PoseAddress) -> DatagramSource:
    return DatagramSource(address, decode)
