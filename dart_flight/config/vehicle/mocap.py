"""Configuration of the motion capture that provides the vehicle's position."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from msgspec import Meta

from dart_flight.base.geometry import RoomFrame
from dart_flight.config.section import Section

_Offset = Annotated[float, Meta(ge=-1.0, le=1.0)]


class MotionCapture(Section, frozen=True):
    """The motion capture that provides PX4's position (docs/motion_capture.md).

    Attributes:
        url: source of the poses, such as optitrack://192.168.1.10/dart; null: another program forwards them.
        rate_hz: rate at which poses are forwarded to PX4.
        up: axis of the room that points up.
        heading_deg: direction of the room's x axis, or of its z axis if y is up, clockwise from PX4's north.
        body_offset_m: position of the vehicle's centre in the axes of the marker body.
        body_yaw_deg: direction of the vehicle's nose in the marker body, counter-clockwise from its x axis.
        delay_ms: age of a pose when it reaches PX4; EKF2_EV_DELAY must have the same value. null: not
            measured.
    """

    url: str | None = None
    rate_hz: Annotated[float, Meta(ge=20.0, le=200.0)] = 50.0
    up: Literal["y", "z"] = "z"
    heading_deg: Annotated[float, Meta(ge=-360.0, le=360.0)] = 0.0
    body_offset_m: tuple[_Offset, _Offset, _Offset] = (0.0, 0.0, 0.0)
    body_yaw_deg: Annotated[float, Meta(ge=-360.0, le=360.0)] = 0.0
    delay_ms: Annotated[float, Meta(ge=0.0, le=300.0)] | None = None

    def measured_parameters(self) -> dict[str, float]:
        """Return the PX4 parameters, by name, that follow from measurements of the motion capture."""
        return {} if self.delay_ms is None else {"EKF2_EV_DELAY": self.delay_ms}

    def room_frame(self) -> RoomFrame:
        """Return the conversion between the room's axes and PX4's local NED."""
        heading, body_yaw = math.radians(self.heading_deg), math.radians(self.body_yaw_deg)
        return RoomFrame(self.up == "y", heading, self.body_offset_m, body_yaw)
