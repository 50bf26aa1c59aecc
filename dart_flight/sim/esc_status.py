"""ESC_STATUS for the embedded autopilot: PX4 and MAVSDK support this message, pymavlink does not."""

from __future__ import annotations

import struct
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

MESSAGE_ID = 291
# Checksum of the message's name and fields in wire order (MAVLink's guide, "CRC_EXTRA calculation").
_CRC_EXTRA = 10
_FIELDS = struct.Struct("<Q4i4f4fB")


_MOTORS = 4  # motors per message


class EscStatusMessages:
    """Speeds of all motors (rpm) in the autopilot's order, four per message as in PX4."""

    def __init__(self, time_us: int, rpm: list[int]) -> None:
        self._time_us, self._rpm = time_us, rpm

    def pack(self, mav: Any) -> bytes:
        first, *others = range(0, len(self._rpm), _MOTORS)
        data = self._part(first).pack(mav)
        for index in others:
            mav.seq = (mav.seq + 1) % 256
            data += self._part(index).pack(mav)
        return data

    def _part(self, index: int) -> _EscStatusMessage:
        rpm = self._rpm[index : index + _MOTORS]
        return _EscStatusMessage(self._time_us, index, rpm + [0] * (_MOTORS - len(rpm)))


class _EscStatusMessage(mavlink.MAVLink_message):  # type: ignore[misc]
    """Speeds of four motors, starting with number `index`."""

    def __init__(self, time_us: int, index: int, rpm: list[int]) -> None:
        super().__init__(MESSAGE_ID, "ESC_STATUS")
        self._payload = _FIELDS.pack(time_us, *rpm, *(0.0,) * 8, index)

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        return bytes(self._pack(mav, _CRC_EXTRA, self._payload, force_mavlink1=force_mavlink1))
