"""What is known of the motion capture that the vehicle flies by."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from dart_flight.config.section import Section


class MotionCapture(Section, frozen=True):
    """The motion capture that PX4's position comes from.

    Attributes:
        delay_ms: age of a pose when it reaches PX4, which EKF2_EV_DELAY has to match; null: not measured.
    """

    delay_ms: Annotated[float, Meta(ge=0.0, le=300.0)] | None = None
