"""TIMESYNC: a request with our time, an answer with the autopilot's beside it."""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec
from mavsdk.plugins.mavlink_direct import MavlinkMessage


class Answer(NamedTuple):
    """What came back: when we asked, host's time, and the autopilot's as it answered; microseconds."""

    sent_us: int
    autopilot_us: int


class _Timesync(msgspec.Struct):
    """TIMESYNC as JSON, nanoseconds; `tc1` is 0 in a request."""

    tc1: int
    ts1: int


_decode = msgspec.json.Decoder(_Timesync).decode


def request(now_us: int) -> MavlinkMessage:
    """To be sent at a host time."""
    fields = {"tc1": 0, "ts1": 1000 * now_us, "target_system": 0, "target_component": 0}
    return MavlinkMessage("TIMESYNC", 0, 0, 0, 0, msgspec.json.encode(fields).decode())


def answer_of(message: Any) -> Answer | None:
    """What a message answers; None: it asks."""
    found = _decode(message.fields_json)
    return Answer(found.ts1 // 1000, found.tc1 // 1000) if found.tc1 else None
