"""Walls and posts. `base.geometry` defines the collision frame of a wall."""

from __future__ import annotations

import math

import msgspec

from dart_flight.base.arithmetic import Number, where
from dart_flight.base.geometry import Vec2, Vec3, distance_to_segment, wrap_angle

FRONT, BACK = ".front", ".back"  # suffixes in the names of the two faces of a partition


class Post(msgspec.Struct, frozen=True):
    """An upright, free-standing cylinder.

    Attributes:
        centre: mission frame, metres.
        material: key of the materials table.
    """

    name: str
    centre: Vec2
    radius_m: float
    material: str

    def distance_to_segment(self, a: Vec2, b: Vec2) -> float:
        return distance_to_segment(self.centre, a, b)


class Wall(msgspec.Struct, frozen=True):
    """A finite vertical wall, defined by its plane of first touch.

    The vehicle's *centre* lies on this plane when the vehicle first touches the wall.

    Attributes:
        point: the middle of the wall on the plane of first touch, mission frame, metres.
        normal: outward unit normal, from the wall into free space, mission frame.
        length_m: extent along the tangent, centred on `point`.
        material: key of the materials table.
        position_sd_m: standard deviation of the plane's position along the normal; None if not configured.
        yaw_sd_rad: standard deviation of the plane's direction, about `point`; None if not configured.
        half_vehicle_m: distance from the vehicle's centre to its side. Along the wall, an impact is at least
            this far inside the wall's ends, and a path past the wall is at least this far outside the ends.
        post_radius_m: radius of the post, if the wall is the tangent plane of a post; 0 for a flat wall.
        sought: whether a probe searches for the wall, because its position is unknown. The plane is then
            assumed to lie at the end of the probe's path.
        material_known: whether the material is given. If not, `material` is the vehicle's stiffest material
            until a contact identifies the wall's material.
        thickness_m: thickness of the partition, if the wall is one of its two faces; otherwise None.
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
    thickness_m: float | None = None

    @property
    def behind_m(self) -> float:
        """Distance behind the plane to the middle of a partition, metres; infinite without a partition."""
        return math.inf if self.thickness_m is None else self.half_vehicle_m + 0.5 * self.thickness_m

    @property
    def is_back(self) -> bool:
        return self.thickness_m is not None and self.name.endswith(BACK)

    def back(self) -> Wall:
        """Return the back of the partition whose front this wall is."""
        (x, y), (nx, ny), apart_m = self.point, self.normal, 2.0 * self.behind_m
        return msgspec.structs.replace(
            self,
            name=self.name.removesuffix(FRONT) + BACK,
            point=(x - apart_m * nx, y - apart_m * ny),
            normal=(0.0 - nx, 0.0 - ny),
        )

    @property
    def tangent(self) -> Vec2:
        """Y axis of the collision frame: to the right when looking along the normal, z up."""
        return (self.normal[1], -self.normal[0])

    @property
    def ends(self) -> tuple[Vec2, Vec2]:
        """The left and the right end when looking along the normal."""
        (x, y), (tx, ty), half = self.point, self.tangent, 0.5 * self.length_m
        return (x - half * tx, y - half * ty), (x + half * tx, y + half * ty)

    def signed_distance(self, position: Vec2 | Vec3) -> float:
        """Return the distance of the vehicle's centre from the plane, metres; negative is compression."""
        return (position[0] - self.point[0]) * self.normal[0] + (position[1] - self.point[1]) * self.normal[1]

    def crossing(
        self, a: tuple[Number, ...], b: tuple[Number, ...], a_off_m: float = 0.0, b_off_m: float = 0.0
    ) -> tuple[Number, tuple[Number, Number]]:
        """Return whether a segment crosses the wall's infinite plane, and where its line meets it.

        Coordinates may be numbers or arrays. If the line is parallel to the plane, the place is `a`.

        Args:
            a, b: ends of the segment, mission frame, metres.
            a_off_m, b_off_m: displacement of the plane along its normal, at each end.
        """
        here, there = self.signed_distance(a) - a_off_m, self.signed_distance(b) - b_off_m
        gap = here - there
        share = where(gap != 0.0, here / where(gap != 0.0, gap, 1.0), 0.0)
        return here * there < 0.0, (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]))

    def along(self, position: Vec2 | Vec3) -> float:
        """Return the distance from the middle of the wall along the tangent, metres."""
        tx, ty = self.tangent
        return (position[0] - self.point[0]) * tx + (position[1] - self.point[1]) * ty

    @property
    def is_uncertain(self) -> bool:
        return bool(self.position_sd_m or self.yaw_sd_rad)

    def displaced(self, away_m: float) -> Wall:
        """Return the wall displaced along its outward normal."""
        (x, y), (nx, ny) = self.point, self.normal
        return msgspec.structs.replace(self, point=(x + away_m * nx, y + away_m * ny))

    def rotated(self, angle_rad: float) -> Wall:
        """Return the wall rotated about its middle, counter-clockwise seen from above."""
        c, s = math.cos(angle_rad), math.sin(angle_rad)
        nx, ny = self.normal
        return msgspec.structs.replace(self, normal=(c * nx - s * ny, s * nx + c * ny))

    def plane_sd_m(self, position: tuple[Number, ...]) -> Number:
        """Return the standard deviation of the plane's position, metres, at the point nearest to `position`.

        The deviation grows with the distance from the middle of the wall. Coordinates may be numbers or
        arrays.
        """
        turned = self.along(position) * math.tan(self.yaw_sd_rad or 0.0)
        return ((self.position_sd_m or 0.0) ** 2 + turned * turned) ** 0.5

    def foot(self, position: Vec2 | Vec3) -> Vec2:
        """Return the nearest point within the wall's length."""
        reach = 0.5 * self.length_m
        along = max(-reach, min(reach, self.along(position)))
        return (self.point[0] + along * self.tangent[0], self.point[1] + along * self.tangent[1])

    def end_distance_m(self, position: tuple[Number, ...]) -> Number:
        """Return the distance along the wall to the nearer end, metres; negative beyond the end.

        Coordinates may be numbers or arrays.
        """
        return 0.5 * self.length_m - abs(self.along(position))

    def spans(self, position: Vec2 | Vec3) -> bool:
        """Return whether the point, projected onto the wall's plane, lies between the wall's ends."""
        return abs(self.along(position)) <= 0.5 * self.length_m

    def to_collision(self, v_mission: Vec3) -> Vec3:
        """Convert a direction from the mission frame to the collision frame."""
        nx, ny = self.normal
        return (v_mission[0] * nx + v_mission[1] * ny, v_mission[0] * ny - v_mission[1] * nx, -v_mission[2])

    def from_collision(self, v_collision: Vec3) -> Vec3:
        """Convert a direction from the collision frame to the mission frame."""
        nx, ny = self.normal
        return (
            v_collision[0] * nx + v_collision[1] * ny,
            v_collision[0] * ny - v_collision[1] * nx,
            -v_collision[2],
        )

    def parallel_yaw(self, yaw_mission_rad: float) -> float:
        """Return the heading nearest to `yaw_mission_rad` at which a leading edge is parallel to the wall.

        The vehicle is four-fold symmetric, so four headings are suitable. From a wall to a perpendicular
        wall, the vehicle does not need to turn (`docs/concepts.md`, yaw).
        """
        facing = math.atan2(-self.normal[1], -self.normal[0])
        quarter = 0.5 * math.pi
        return wrap_angle(facing + quarter * round((yaw_mission_rad - facing) / quarter))

    def incidence(self, yaw_mission_rad: float) -> float:
        """Return the angle of incidence between leading edge and wall, radians, 0 to pi/4."""
        return abs(wrap_angle(yaw_mission_rad - self.parallel_yaw(yaw_mission_rad)))
