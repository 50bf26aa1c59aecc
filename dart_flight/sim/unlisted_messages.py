"""CURRENT_MODE and ESC_STATUS for the embedded autopilot: PX4 and MAVSDK support them, pymavlink does not."""

from __future__ import annotations

import struct
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

CURRENT_MODE_ID, ESC_STATUS_ID = 436, 291
# Checksum of name and fields in wire order (MAVLink's guide, "CRC_EXTRA calculation"), and these fields.
_LAYOUTS = {
    CURRENT_MODE_ID: ("CURRENT_MODE", 193, struct.Struct("<IIB")),
    ESC_STATUS_ID: ("ESC_STATUS", 10, struct.Struct("<Q4i4f4fB")),
}
_MOTORS = 4  # per message


class UnlistedMessage(mavlink.MAVLink_message):  # type: ignore[misc]
    """A message that pymavlink's `common` lacks, with its fields in wire order."""

    def __init__(self, number: int, *fields: float) -> None:
        name, self._crc_extra, layout = _LAYOUTS[number]
        super().__init__(number, name)
        self._payload = layout.pack(*fields)

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        return bytes(self._pack(mav, self._crc_extra, self._payload, force_mavlink1=force_mavlink1))


def current_mode(custom_mode: int) -> UnlistedMessage:
    """Return the current mode as PX4's custom mode; the intended mode is the same."""
    return UnlistedMessage(CURRENT_MODE_ID, custom_mode, custom_mode, 0)


class EscStatusMessages:
    """Speeds of all motors (rpm) in the autopilot's order, four per message as in PX4."""

    def __init__(self, time_us: int, rpm: list[int]) -> None:
        self._time_us, self._rpm = time_us, rpm

    def pack(self, mav: Any) -> bytes:
        data = b""
        for first in range(0, len(self._rpm), _MOTORS):
            if first:
                mav.seq = (mav.seq + 1) % 256
            rpm = self._rpm[first : first + _MOTORS]
            rpm += [0] * (_MOTORS - len(rpm))
            data += UnlistedMessage(ESC_STATUS_ID, self._time_us, *rpm, *(0.0,) * 8, first).pack(mav)
        return data
