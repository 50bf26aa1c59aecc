"""CURRENT_MODE for the embedded autopilot: PX4 and MAVSDK support it, pymavlink's `common` does not."""

from __future__ import annotations

import struct
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

MESSAGE_ID = 436
# Checksum of the message's name and fields in wire order (MAVLink's guide, "CRC_EXTRA calculation").
_CRC_EXTRA = 193
_FIELDS = struct.Struct("<IIB")


class CurrentModeMessage(mavlink.MAVLink_message):  # type: ignore[misc]
    """The present mode, which is also the intended one, as PX4's custom mode."""

    def __init__(self, custom_mode: int) -> None:
        super().__init__(MESSAGE_ID, "CURRENT_MODE")
        self._payload = _FIELDS.pack(custom_mode, custom_mode, 0)

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        return bytes(self._pack(mav, _CRC_EXTRA, self._payload, force_mavlink1=force_mavlink1))
