"""The vehicle as it is drawn, in its own axes: for maps, animation and pictures."""

from __future__ import annotations

from dart_flight.base.geometry import Vec2
from dart_flight.config.vehicle import Airframe

_HUB_SHARE = 0.45  # of the way to the motors: where the drawn arms end at the frame


def arms_m(airframe: Airframe) -> list[tuple[Vec2, Vec2]]:
    """Each arm from the frame to its motor, (forward, left), m."""
    return [
        ((_HUB_SHARE * motor.x_m, -_HUB_SHARE * motor.y_m), (motor.x_m, -motor.y_m))
        for motor in airframe.motors
    ]
