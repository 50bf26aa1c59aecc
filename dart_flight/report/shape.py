"""The vehicle's outline from its configuration, in its own axes: for maps, animation and pictures."""

from __future__ import annotations

from dart_flight.config.vehicle import Airframe
from dart_flight.geometry import Vec2, Wall

_HUB_SHARE = 0.45  # of the way to the motors: where the drawn arms end at the frame


def outline_m(airframe: Airframe) -> list[Vec2]:
    """Corners of the guards seen from above, (forward, left), m, around from the front's left one.

    Each side has two points that touch a wall first, `guard_along_m` from its middle and
    `contact_distance_m` from the centre of mass.
    """
    out, along = airframe.contact_distance_m, airframe.guard_along_m
    first: list[Vec2] = [(out, along), (along, out)]
    corners: list[Vec2] = []
    for _ in range(4):
        corners += first
        first = [(-y, x) for x, y in first]  # the next side, a quarter turn to the left
    return corners


def arms_m(airframe: Airframe) -> list[tuple[Vec2, Vec2]]:
    """Each arm from the frame to its motor, (forward, left), m."""
    return [
        ((_HUB_SHARE * motor.x_m, -_HUB_SHARE * motor.y_m), (motor.x_m, -motor.y_m))
        for motor in airframe.motors
    ]


def surface_point(wall: Wall, airframe: Airframe) -> Vec2:
    """The middle of a wall's own surface: the plane of the centre, less the way to the vehicle's side."""
    out = airframe.contact_distance_m
    return (wall.point[0] - out * wall.normal[0], wall.point[1] - out * wall.normal[1])
