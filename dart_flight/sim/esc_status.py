"""ESC_STATUS for the embedded autopilot: PX4 and MAVSDK have it, pymavlink's dialects leave it out."""

from __future__ import annotations

import struct
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

MESSAGE_ID = 291
# Of the name and the fields below in MAVLink's wire order (MAVLink's guide, "CRC_EXTRA calculation").
_CRC_EXTRA = 10
_FIELDS = struct.Struct("<Q4i4f4fB")


class EscStatus(mavlink.MAVLink_message):  # type: ignore[misc]
    """Speeds of the first four motors, in the autopilot's order.

    Args:
        time_us: autopilot's time, microseconds.
        rpm: revolutions per minute.
    """

    def __init__(self, time_us: int, rpm: list[int]) -> None:
        super().__init__(MESSAGE_ID, "ESC_STATUS")
        self._payload = _FIELDS.pack(time_us, *rpm, *(0.0,) * 8, 0)

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """The message on the wire."""
        return bytes(self._pack(mav, _CRC_EXTRA, self._payload, force_mavlink1=force_mavlink1))
