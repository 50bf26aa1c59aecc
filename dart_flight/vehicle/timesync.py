"""TIMESYNC requests: the program sends its time; the answer contains this time and the autopilot's time."""

from __future__ import annotations

import msgspec
from mavsdk.plugins.mavlink_direct import MavlinkMessage


def make_request(now_us: int) -> MavlinkMessage:
    """Return a request with the host time of sending."""
    fields = {"tc1": 0, "ts1": 1000 * now_us, "target_system": 0, "target_component": 0}
    return MavlinkMessage("TIMESYNC", 0, 0, 0, 0, msgspec.json.encode(fields).decode())
