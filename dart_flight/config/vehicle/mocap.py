"""Configuration of the motion capture that provides the vehicle's position."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from dart_flight.config.section import Section


class MotionCapture(Section, frozen=True):
    """The motion capture that provides PX4's position.

    Attributes:
        delay_ms: age of a pose when it reaches PX4; EKF2_EV_DELAY must match it; null: not measured.
    """

    delay_ms: Annotated[float, Meta(ge=0.0, le=300.0)] | None = None
