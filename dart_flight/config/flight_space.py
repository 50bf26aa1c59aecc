"""Checks that walls, positions, modes and vehicle agree, for missions and scenarios.

If a check fails, the function raises an `InputError` that names the key in the document.
"""

from __future__ import annotations

import math

import msgspec

from dart_flight.base.geometry import Vec2
from dart_flight.base.records import Mode
from dart_flight.base.walls import FRONT, Post, Wall
from dart_flight.config.document import Document, Key, unknown_name
from dart_flight.config.mission_file import BoundsSpec, GoalSpec, Limits, PostSpec, StartSpec, WallSpec
from dart_flight.config.vehicle import VehicleConfig

_AXIS_TOLERANCE = 1e-6
_UNIT_TOLERANCE = 1e-15
_ON_POST_M = 0.01  # tolerance for the position of an impact point on a post
_LIKE_CONTACT_DISTANCE_M = 0.03  # deviation at which a distance counts as the contact distance
LIMITED_KEYS = ("acceleration_m_s2", "transit_speed_m_s", "jerk_m_s3")  # the mission's limits set these


def resolve_space(
    start: StartSpec,
    goal: GoalSpec,
    bounds: BoundsSpec,
    walls: dict[str, WallSpec],
    vehicle: VehicleConfig,
    document: Document,
) -> dict[str, Wall]:
    """Check start, goal, bounds and walls against each other, and return the walls by name."""
    for axis in ("x", "y", "z"):
        low, high = getattr(bounds, axis)
        if not low < high:
            raise document.error(("bounds_m", axis), f"[low, high] needs low < high, not [{low:g}, {high:g}]")
    planes = resolve_walls(walls, vehicle, document)
    check_place(bounds, planes, start.position_m, start.altitude_m, ("start",), document)
    check_place(bounds, planes, goal.position_m, None, ("goal",), document)
    return planes


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
    specs: dict[str, WallSpec], vehicle: VehicleConfig, document: Document, section: str = "walls"
) -> dict[str, Wall]:
    """Return the walls by name; `section` is their key in the file.

    A wall is the plane in which the vehicle's centre lies when the vehicle first touches the wall.
    """
    walls: dict[str, Wall] = {}
    for name, spec in specs.items():
        key: Key = (section, name)
        length = math.hypot(*spec.normal)
        if not length > 1e-9:
            raise document.error((*key, "normal"), "the normal has length 0")
        normal = spec.normal
        if abs(length - 1.0) > _UNIT_TOLERANCE:  # a unit vector stays bit-equal
            normal = (spec.normal[0] / length, spec.normal[1] / length)
        if spec.material not in vehicle.materials:
            raise document.error((*key, "material"), unknown_name(spec.material, list(vehicle.materials)))
        if spec.thickness_m is not None and spec.given_at is None:
            text = (
                "a partition needs given_at: surface if point_m is on its front face, or centre if point_m "
                f"is the vehicle's centre at first touch, {vehicle.airframe.contact_distance_m:g} m before it"
            )
            raise document.error(key, text)
        offset = vehicle.airframe.contact_distance_m if spec.given_at == "surface" else 0.0
        point = (spec.point_m[0] + offset * normal[0], spec.point_m[1] + offset * normal[1])
        yaw_sd_rad = None if spec.yaw_sd_deg is None else math.radians(spec.yaw_sd_deg)
        half_m = vehicle.airframe.contact_distance_m
        wall = Wall(name, point, normal, spec.length_m, spec.material, spec.position_sd_m, yaw_sd_rad, half_m)
        for face in (wall,) if spec.thickness_m is None else _faces(wall, spec.thickness_m):
            if face.name in walls:
                raise document.error(key, f"another wall already has the name {face.name}")
            walls[face.name] = face
    return walls


def hint_at_surface(off_m: float, contact_distance_m: float) -> str:
    """Return a hint for a message if a distance equals the contact distance, otherwise an empty string."""
    if not contact_distance_m > 0.0 or abs(off_m - contact_distance_m) > _LIKE_CONTACT_DISTANCE_M:
        return ""
    return (
        f"; airframe.contact_distance_m is {contact_distance_m:g} m: if point_m is on the wall itself, give "
        "given_at: surface"
    )


def _faces(wall: Wall, thickness_m: float) -> tuple[Wall, Wall]:
    front = msgspec.structs.replace(wall, name=wall.name + FRONT, thickness_m=thickness_m)
    return front, front.back()


def resolve_posts(
    specs: dict[str, PostSpec], walls: dict[str, Wall], vehicle: VehicleConfig, document: Document
) -> dict[str, Post]:
    for name, spec in specs.items():
        if name in walls:
            raise document.error(("posts", name), f"a wall already has the name {name}")
        if spec.material not in vehicle.materials:
            key: Key = ("posts", name, "material")
            raise document.error(key, unknown_name(spec.material, list(vehicle.materials)))
    return {name: Post(name, spec.centre_m, spec.radius_m, spec.material) for name, spec in specs.items()}


def tangent_wall(post: Post, impact: Vec2, vehicle: VehicleConfig, key: Key, document: Document) -> Wall:
    """Return a post's tangent plane as a wall with the post's name.

    The plane contains the vehicle's centre at the first touch of the post, so `impact` must be at that
    distance from the post's axis. The wall's length is the range in which the vehicle's leading side touches
    the post. Beyond this range the vehicle passes the post, or another part of the vehicle touches it.
    """
    reach = post.radius_m + vehicle.airframe.contact_distance_m
    dx, dy = impact[0] - post.centre[0], impact[1] - post.centre[1]
    distance = math.hypot(dx, dy)
    if abs(distance - reach) > _ON_POST_M:
        text = f"is {distance:.3f} m from the axis of post {post.name}, minimum {reach:.3f} m"
        if distance > 0.0:
            x, y = post.centre[0] + dx / distance * reach, post.centre[1] + dy / distance * reach
            text += f"; the nearest possible point is [{x:.3f}, {y:.3f}]"
        raise document.error((*key, "impact_point_m"), text)
    length = 2.0 * (post.radius_m + vehicle.airframe.guard_along_m)
    normal = (dx / distance, dy / distance)
    return Wall(post.name, impact, normal, length, post.material, post_radius_m=post.radius_m)


def check_clear_of_posts(
    posts: dict[str, Post], point: Vec2, vehicle: VehicleConfig, key: Key, document: Document
) -> None:
    """Check that a vehicle at a position neither overlaps nor touches a post."""
    for post in posts.values():
        if post.distance_to_segment(point, point) <= post.radius_m + vehicle.airframe.contact_distance_m:
            raise document.error((*key, "position_m"), f"is in or at post {post.name}")


def check_place(
    bounds: BoundsSpec,
    walls: dict[str, Wall],
    point: Vec2,
    altitude_m: float | None,
    key: Key,
    document: Document,
) -> None:
    """Check that a position, with its altitude if given, is within the bounds and in front of the walls."""
    if bounds.excess2(point) > 0.0:
        raise document.error(
            (*key, "position_m"),
            f"({point[0]:g}, {point[1]:g}) is outside bounds_m x [{bounds.x[0]:g}, {bounds.x[1]:g}], "
            f"y [{bounds.y[0]:g}, {bounds.y[1]:g}]",
        )
    if altitude_m is not None and not bounds.z[0] <= altitude_m <= bounds.z[1]:
        raise document.error(
            (*key, "altitude_m"), f"must be within bounds_m z [{bounds.z[0]:g}, {bounds.z[1]:g}]"
        )
    for name, wall in walls.items():
        if wall.spans(point) and -min(0.5, wall.behind_m) <= wall.signed_distance(point) <= 0.0:
            raise document.error((*key, "position_m"), f"is in or behind wall {name}")


def refuse_mode(mode: Mode, vehicle: VehicleConfig, key: Key, document: Document) -> None:
    problem = vehicle.mode_problem(mode)
    if problem is not None:
        raise document.error(key, problem)


def resolve_alphas(
    per_axis: tuple[float, float] | None,
    per_wall: tuple[float, float] | None,
    wall: Wall,
    key: Key,
    document: Document,
) -> tuple[float, float]:
    """Return the gains (A_n, A_t) in the wall's axes, m/N, from `alpha_m_per_n` or `alpha_wall_m_per_n`.

    Exactly one of the two keys must be given, and the gain along the normal must be above 0. The two gains of
    `alpha_m_per_n` may differ only for a wall that is parallel to one of the mission's axes.
    """
    if (per_axis is None) == (per_wall is None):
        raise document.error(key, "give exactly one of alpha_m_per_n and alpha_wall_m_per_n")
    alphas = per_wall or (0.0, 0.0)
    if per_axis is not None:
        ax, ay = per_axis
        across = abs(wall.normal[0]) < _AXIS_TOLERANCE
        if ax != ay and not across and abs(wall.normal[1]) >= _AXIS_TOLERANCE:
            raise document.error(
                (*key, "alpha_m_per_n"),
                "the wall is oblique to the mission's axes, so different gains per axis could lead the "
                "recovery into the wall; use alpha_wall_m_per_n: [normal, tangential]",
            )
        alphas = (ay, ax) if across else (ax, ay)
    if not alphas[0] > 0.0:
        raise document.error(key, "the gain along the wall's normal must be above 0")
    return alphas
