"""TIMESYNC requests: the program sends its time, and the autopilot returns it with its own time."""

from __future__ import annotations

import msgspec
from mavsdk.plugins.mavlink_direct import MavlinkMessage


def request(now_us: int) -> MavlinkMessage:
    """To be sent at a host time."""
    fields = {"tc1": 0, "ts1": 1000 * now_us, "target_system": 0, "target_component": 0}
    return MavlinkMessage("TIMESYNC", 0, 0, 0, 0, msgspec.json.encode(fields).decode())
