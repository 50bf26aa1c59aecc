"""The mission frame in PX4's local NED frame: the conversions between the two, and no others.

Everybody imports it from `geometry`; it stands in a module of its own because it is compiled (docs/speed.md),
and is a plain class because a compiled module can have no `msgspec.Struct`.
"""

from __future__ import annotations

import math

from dart_flight.base.rotations import Vec3, wrap_angle


class MissionFrame:
    """Where the mission frame lies in PX4's local NED frame; not to be changed.

    Attributes:
        north_m, east_m: the mission's origin in local NED.
        down_m: local NED height of the mission's z = 0 (the ground under the take-off point).
        heading_rad: direction of the mission's x axis, clockwise from north.
        cos, sin: of the heading: every vector that is converted needs them.
    """

    def __init__(
        self, north_m: float = 0.0, east_m: float = 0.0, down_m: float = 0.0, heading_rad: float = 0.0
    ) -> None:
        self.north_m, self.east_m, self.down_m, self.heading_rad = north_m, east_m, down_m, heading_rad
        self.cos, self.sin = math.cos(heading_rad), math.sin(heading_rad)

    def vector_from_ned(self, v_ned: Vec3) -> Vec3:
        """A direction (velocity, force, acceleration) from NED to the mission frame."""
        c, s = self.cos, self.sin
        n, e, d = v_ned
        return (n * c + e * s, n * s - e * c, -d)

    def vector_to_ned(self, v_mission: Vec3) -> Vec3:
        """A direction from the mission frame to NED."""
        c, s = self.cos, self.sin
        x, y, z = v_mission
        return (x * c + y * s, x * s - y * c, -z)

    def point_from_ned(self, p_ned: Vec3) -> Vec3:
        """A position from local NED to the mission frame."""
        c, s = self.cos, self.sin
        n, e = p_ned[0] - self.north_m, p_ned[1] - self.east_m
        return (n * c + e * s, n * s - e * c, -(p_ned[2] - self.down_m))

    def point_to_ned(self, p_mission: Vec3) -> Vec3:
        """A position from the mission frame to local NED."""
        c, s = self.cos, self.sin
        x, y, z = p_mission
        return (x * c + y * s + self.north_m, x * s - y * c + self.east_m, -z + self.down_m)

    def yaw_from_ned(self, yaw_ned_rad: float) -> float:
        """Heading clockwise from north to mission yaw, counter-clockwise from the mission's x axis."""
        return wrap_angle(self.heading_rad - yaw_ned_rad)

    def yaw_to_ned(self, yaw_mission_rad: float) -> float:
        """Mission yaw, counter-clockwise from x, to heading clockwise from north."""
        return wrap_angle(self.heading_rad - yaw_mission_rad)
