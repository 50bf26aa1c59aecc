"""The flight space of a mission or scenario: walls, posts, bounds, and the vehicle.

If parts contradict each other, a method raises an `InputError` that names the key in the document.
"""

from __future__ import annotations

import math
from typing import Protocol

import msgspec

from dart_flight.base.geometry import Vec2
from dart_flight.base.records import Mode
from dart_flight.base.walls import FRONT, Post, Wall
from dart_flight.config.document import Document, InputError, Key, unknown_name
from dart_flight.config.mission_file import BoundsSpec, GoalSpec, Limits, PostSpec, StartSpec, WallSpec
from dart_flight.config.vehicle import VehicleConfig

_AXIS_TOLERANCE = 1e-6
_UNIT_TOLERANCE = 1e-15
_ON_POST_M = 0.01  # tolerance for the position of an impact point on a post
_LIKE_CONTACT_DISTANCE_M = 0.03  # a distance counts as the contact distance within this tolerance
LIMITED_KEYS = ("acceleration_m_s2", "transit_speed_m_s", "jerk_m_s3")  # the mission's limits replace them


class SpaceFile(Protocol):
    """The keys of the flight space in a mission file or scenario file."""

    @property
    def start(self) -> StartSpec: ...
    @property
    def goal(self) -> GoalSpec: ...
    @property
    def bounds_m(self) -> BoundsSpec: ...
    @property
    def limits(self) -> Limits: ...
    @property
    def walls(self) -> dict[str, WallSpec]: ...
    @property
    def posts(self) -> dict[str, PostSpec]: ...


def apply_limits(vehicle: VehicleConfig, limits: Limits) -> VehicleConfig:
    """Return the vehicle with the mission's limits of acceleration and jerk, if the mission sets any."""
    if limits.acceleration_m_s2 is None and limits.jerk_m_s3 is None:
        return vehicle
    flying = vehicle.flying
    if limits.acceleration_m_s2 is not None:
        flying = msgspec.structs.replace(
            flying, acceleration_m_s2=limits.acceleration_m_s2, transit_speed_m_s=limits.speed_m_s
        )
    if limits.jerk_m_s3 is not None:
        flying = msgspec.structs.replace(flying, jerk_m_s3=limits.jerk_m_s3)
    return msgspec.structs.replace(vehicle, flying=flying)


def resolve_walls(
    specs: dict[str, WallSpec], vehicle: VehicleConfig, document: Document, section: str
) -> dict[str, Wall]:
    """Return the walls of a section of the file by name."""
    contact_m = vehicle.airframe.contact_distance_m
    walls: dict[str, Wall] = {}
    for name, spec in specs.items():
        key: Key = (section, name)
        length = math.hypot(*spec.normal)
        if not length > 1e-9:
            raise document.error((*key, "normal"), "the normal has length 0")
        normal = spec.normal
        if abs(length - 1.0) > _UNIT_TOLERANCE:  # do not change a unit vector by rounding
            normal = (spec.normal[0] / length, spec.normal[1] / length)
        if spec.material not in vehicle.materials:
            raise document.error((*key, "material"), unknown_name(spec.material, list(vehicle.materials)))
        if spec.thickness_m is not None and spec.given_at is None:
            text = (
                "a partition needs given_at: surface (point_m is on the front face) or centre (point_m is "
                f"the vehicle's centre at first touch, {contact_m:g} m before the front face)"
            )
            raise document.error(key, text)
        offset = contact_m if spec.given_at == "surface" else 0.0
        wall = Wall(
            name,
            (spec.point_m[0] + offset * normal[0], spec.point_m[1] + offset * normal[1]),
            normal,
            spec.length_m,
            spec.material,
            spec.position_sd_m,
            None if spec.yaw_sd_deg is None else math.radians(spec.yaw_sd_deg),
            contact_m,
        )
        faces = [wall]
        if spec.thickness_m is not None:
            front = msgspec.structs.replace(wall, name=name + FRONT, thickness_m=spec.thickness_m)
            faces = [front, front.back()]
        for face in faces:
            if face.name in walls:
                raise document.error(key, f"another wall already has the name {face.name}")
            walls[face.name] = face
    return walls


class FlightSpace:
    """A flight space in which start, goal, bounds, walls and posts agree.

    Attributes:
        vehicle: the vehicle with the file's limits.
        walls: walls by name. A wall is the plane in which the vehicle's centre lies when the vehicle first
            touches the wall.
        posts: posts by name.
    """

    def __init__(self, file: SpaceFile, vehicle: VehicleConfig, document: Document) -> None:
        self._bounds, self._document = file.bounds_m, document
        self.vehicle = apply_limits(vehicle, file.limits)
        self._contact_m = vehicle.airframe.contact_distance_m
        for axis in ("x", "y", "z"):
            low, high = getattr(file.bounds_m, axis)
            if not low < high:
                text = f"[low, high] needs low < high, not [{low:g}, {high:g}]"
                raise self.error(("bounds_m", axis), text)
        self.posts: dict[str, Post] = {}
        self.walls = self.resolve_walls(file.walls, "walls")
        self.check_place(file.start.position_m, file.start.altitude_m, ("start",))
        self.check_place(file.goal.position_m, None, ("goal",))
        for name, spec in file.posts.items():
            if name in self.walls:
                raise self.error(("posts", name), f"a wall already has the name {name}")
            self.check_material(spec.material, ("posts", name, "material"))
            self.posts[name] = Post(name, spec.centre_m, spec.radius_m, spec.material)
        self.check_clear_of_posts(file.start.position_m, ("start",))
        self.check_clear_of_posts(file.goal.position_m, ("goal",))

    def error(self, key: Key, message: str) -> InputError:
        """Return an error at a key of the document, with the line of the key."""
        return self._document.error(key, message)

    # -- walls and posts --

    def resolve_walls(self, specs: dict[str, WallSpec], section: str) -> dict[str, Wall]:
        """Return the walls of a section of the file by name."""
        return resolve_walls(specs, self.vehicle, self._document, section)

    def tangent_wall(self, post: Post, impact: Vec2, key: Key) -> Wall:
        """Return a post's tangent plane as a wall with the post's name.

        The plane contains the vehicle's centre at the first touch of the post, so `impact` must be at that
        distance from the post's axis. The wall's length is the range in which the vehicle's leading side
        touches the post. Beyond this range, the vehicle passes the post or touches it with another part.
        """
        reach = post.radius_m + self._contact_m
        dx, dy = impact[0] - post.centre[0], impact[1] - post.centre[1]
        distance = math.hypot(dx, dy)
        if abs(distance - reach) > _ON_POST_M:
            text = f"is {distance:.3f} m from the axis of post {post.name}, minimum {reach:.3f} m"
            if distance > 0.0:
                x, y = post.centre[0] + dx / distance * reach, post.centre[1] + dy / distance * reach
                text += f"; the nearest possible point is [{x:.3f}, {y:.3f}]"
            raise self.error((*key, "impact_point_m"), text)
        length = 2.0 * (post.radius_m + self.vehicle.airframe.guard_along_m)
        normal = (dx / distance, dy / distance)
        return Wall(post.name, impact, normal, length, post.material, post_radius_m=post.radius_m)

    def hint_at_surface(self, off_m: float) -> str:
        """Return a hint for a message if a distance is the contact distance, otherwise an empty string."""
        if not self._contact_m > 0.0 or abs(off_m - self._contact_m) > _LIKE_CONTACT_DISTANCE_M:
            return ""
        return (
            f"; airframe.contact_distance_m is {self._contact_m:g} m: if point_m is on the wall itself, give "
            "given_at: surface"
        )

    # -- checks --

    def check_place(self, point: Vec2, altitude_m: float | None, key: Key) -> None:
        """Check that a position, with its altitude if given, is within the bounds and not in a wall."""
        self.check_bounds(point, key)
        z = self._bounds.z
        if altitude_m is not None and not z[0] <= altitude_m <= z[1]:
            raise self.error((*key, "altitude_m"), f"must be within bounds_m z [{z[0]:g}, {z[1]:g}]")
        for name, wall in self.walls.items():
            if wall.spans(point) and -min(0.5, wall.behind_m) <= wall.signed_distance(point) <= 0.0:
                raise self.error((*key, "position_m"), f"is in or behind wall {name}")

    def check_bounds(self, point: Vec2, key: Key) -> None:
        if self._bounds.excess2(point) > 0.0:
            (x0, x1), (y0, y1) = self._bounds.x, self._bounds.y
            text = f"({point[0]:g}, {point[1]:g}) is outside bounds_m x [{x0:g}, {x1:g}], y [{y0:g}, {y1:g}]"
            raise self.error((*key, "position_m"), text)

    def check_clear_of_posts(self, point: Vec2, key: Key) -> None:
        """Check that a vehicle at a position neither overlaps nor touches a post."""
        for post in self.posts.values():
            if post.distance_to_segment(point, point) <= post.radius_m + self._contact_m:
                raise self.error((*key, "position_m"), f"is in or at post {post.name}")

    def check_material(self, material: str, key: Key) -> None:
        if material not in self.vehicle.materials:
            raise self.error(key, unknown_name(material, list(self.vehicle.materials)))

    def check_mode(self, mode: Mode, key: Key) -> None:
        problem = self.vehicle.mode_problem(mode)
        if problem is not None:
            raise self.error(key, problem)

    def alphas(
        self, per_axis: tuple[float, float] | None, per_wall: tuple[float, float] | None, wall: Wall, key: Key
    ) -> tuple[float, float]:
        """Return the gains (A_n, A_t) in the wall's axes, m/N, from `alpha_m_per_n` or `alpha_wall_m_per_n`.

        Exactly one of the two keys must be given, and the gain along the normal must be above 0. The two
        gains of `alpha_m_per_n` may differ only for a wall that is parallel to one of the mission's axes.
        """
        if (per_axis is None) == (per_wall is None):
            raise self.error(key, "give exactly one of alpha_m_per_n and alpha_wall_m_per_n")
        alphas = per_wall or (0.0, 0.0)
        if per_axis is not None:
            ax, ay = per_axis
            across = abs(wall.normal[0]) < _AXIS_TOLERANCE
            if ax != ay and not across and abs(wall.normal[1]) >= _AXIS_TOLERANCE:
                raise self.error(
                    (*key, "alpha_m_per_n"),
                    "the wall is oblique to the mission's axes, so different gains per axis could lead the "
                    "recovery into the wall; use alpha_wall_m_per_n: [normal, tangential]",
                )
            alphas = (ay, ax) if across else (ax, ay)
        if not alphas[0] > 0.0:
            raise self.error(key, "the gain along the wall's normal must be above 0")
        return alphas
