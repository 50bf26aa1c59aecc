"""Walls, and the frame of a collision with one.

* collision frame of a wall: X outward normal, Y to the right when looking along X in a z-up frame,
  Z = X x Y (it points down at a wall).
"""

from __future__ import annotations

import math
from typing import Any

import msgspec

from dart_flight.base.geometry import Vec2, Vec3, distance_to_segment, wrap_angle


class Post(msgspec.Struct, frozen=True):
    """An upright cylinder that stands by itself.

    Attributes:
        name: as in the mission file.
        centre: of its face's circle, mission frame, metres.
        radius_m: of its face.
        material: key of the materials table.
    """

    name: str
    centre: Vec2
    radius_m: float
    material: str

    def distance_to_segment(self, a: Vec2, b: Vec2) -> float:
        """Smallest distance in metres of the axis to the straight line from one place to another."""
        return distance_to_segment(self.centre, a, b)


class Wall(msgspec.Struct, frozen=True):
    """A finite vertical wall, as the plane where the vehicle's *centre* is at first touch.

    Attributes:
        name: as in the mission file.
        point: a point of that plane, the middle of the wall, mission frame, metres.
        normal: outward unit normal, from the wall into free space, mission frame.
        length_m: extent along the tangent, centred on `point`.
        material: key of the materials table.
        position_sd_m: standard deviation of the plane's place along the normal; None: not told.
        yaw_sd_rad: of its direction, about `point`; None: not told.
        half_vehicle_m: from the vehicle's centre to its side, which must fit on the wall, or past its end.
        post_radius_m: of the post whose tangent plane this is, where it is to be hit; 0: it is a wall.
        sought: nobody knows where it stands: a probe looks for it, and this is its plane at the probe's end.
        material_known: else the material is the stiffest there is, until a contact tells.
    """

    name: str
    point: Vec2
    normal: Vec2
    length_m: float
    material: str
    position_sd_m: float | None = None
    yaw_sd_rad: float | None = None
    half_vehicle_m: float = 0.0
    post_radius_m: float = 0.0
    sought: bool = False
    material_known: bool = True

    @property
    def tangent(self) -> Vec2:
        """Y of the collision frame: to the right when looking along the normal, z up."""
        return (self.normal[1], -self.normal[0])

    @property
    def ends(self) -> tuple[Vec2, Vec2]:
        """The left and the right end, looking along the normal."""
        (x, y), (tx, ty), half = self.point, self.tangent, 0.5 * self.length_m
        return (x - half * tx, y - half * ty), (x + half * tx, y + half * ty)

    def signed_distance(self, position: Vec2 | Vec3) -> float:
        """Signed distance in metres of the vehicle's centre to the plane; negative is compression."""
        return (position[0] - self.point[0]) * self.normal[0] + (position[1] - self.point[1]) * self.normal[1]

    def along(self, position: Vec2 | Vec3) -> float:
        """Distance in metres along the tangent from the middle of the wall."""
        tx, ty = self.tangent
        return (position[0] - self.point[0]) * tx + (position[1] - self.point[1]) * ty

    @property
    def is_uncertain(self) -> bool:
        """Whether it may stand elsewhere than it is said to."""
        return bool(self.position_sd_m or self.yaw_sd_rad)

    def moved(self, away_m: float) -> Wall:
        """The wall so far out along its normal."""
        (x, y), (nx, ny) = self.point, self.normal
        return msgspec.structs.replace(self, point=(x + away_m * nx, y + away_m * ny))

    def turned(self, angle_rad: float) -> Wall:
        """The wall turned about its middle, counter-clockwise seen from above."""
        c, s = math.cos(angle_rad), math.sin(angle_rad)
        nx, ny = self.normal
        return msgspec.structs.replace(self, normal=(c * nx - s * ny, s * nx + c * ny))

    def plane_sd_m(self, position: tuple[Any, ...]) -> Any:
        """Standard deviation of the plane's place before a position: the further from the middle, the more.

        Numbers, or arrays of them.
        """
        turned = self.along(position) * math.tan(self.yaw_sd_rad or 0.0)
        return ((self.position_sd_m or 0.0) ** 2 + turned * turned) ** 0.5

    def foot(self, position: Vec2 | Vec3) -> Vec2:
        """The nearest point of the wall's plane within its length."""
        reach = 0.5 * self.length_m
        along = max(-reach, min(reach, self.along(position)))
        return (self.point[0] + along * self.tangent[0], self.point[1] + along * self.tangent[1])

    def end_distance_m(self, position: tuple[Any, ...]) -> Any:
        """How far inside the nearer end a point lies along the wall, metres; negative beyond it.

        Numbers, or arrays of them.
        """
        return 0.5 * self.length_m - abs(self.along(position))

    def spans(self, position: Vec2 | Vec3) -> bool:
        """Whether the point lies before the wall's finite length."""
        return abs(self.along(position)) <= 0.5 * self.length_m

    def to_collision(self, v_mission: Vec3) -> Vec3:
        """A direction from the mission frame to the wall's collision frame (R dagger transposed)."""
        nx, ny = self.normal
        return (v_mission[0] * nx + v_mission[1] * ny, v_mission[0] * ny - v_mission[1] * nx, -v_mission[2])

    def from_collision(self, v_collision: Vec3) -> Vec3:
        """A direction from the wall's collision frame to the mission frame (R dagger)."""
        nx, ny = self.normal
        return (
            v_collision[0] * nx + v_collision[1] * ny,
            v_collision[0] * ny - v_collision[1] * nx,
            -v_collision[2],
        )

    def parallel_yaw(self, yaw_mission_rad: float) -> float:
        """The heading nearest to the given one at which the leading edge is parallel to the wall.

        The vehicle is four-fold symmetric, so every quarter turn will do; two perpendicular walls need
        no turn between them (`docs/concepts.md`, yaw).
        """
        facing = math.atan2(-self.normal[1], -self.normal[0])
        quarter = 0.5 * math.pi
        return wrap_angle(facing + quarter * round((yaw_mission_rad - facing) / quarter))

    def incidence(self, yaw_mission_rad: float) -> float:
        """Angle of incidence in radians, 0 to pi/4: leading edge against the wall's plane."""
        return abs(wrap_angle(yaw_mission_rad - self.parallel_yaw(yaw_mission_rad)))
