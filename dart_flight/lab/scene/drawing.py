"""Rooms, vehicles and forces as primitives of foxglove.SceneUpdate.

Positions are in metres, in the mission frame (x along the mission's heading, y left, z up) or the vehicle
frame (forward, left, up).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import combinations

from foxglove.messages import (
    ArrowPrimitive,
    Color,
    CubePrimitive,
    CylinderPrimitive,
    LinePrimitive,
    LinePrimitiveLineType,
    Point3,
    Pose,
    Quaternion,
    SceneEntity,
    SpherePrimitive,
    TextPrimitive,
    Timestamp,
    Vector3,
)

from dart_flight.base.geometry import IDENTITY, Vec2, Vec3
from dart_flight.base.geometry import Quaternion as Rotation
from dart_flight.base.walls import Post
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import Airframe
from dart_flight.lab.map_model import DrawnWall, RoomMap, named_material, planned_lines
from dart_flight.planning.predicted_flight import PredictedFlight

MISSION, VEHICLE = "mission", "vehicle"  # names of the frames

# Okabe and Ito's colours, which colour-blind people can distinguish.
BLUE, ORANGE = Color(r=0.0, g=0.45, b=0.70, a=1.0), Color(r=0.90, g=0.60, b=0.0, a=1.0)
RED, GREEN = Color(r=0.84, g=0.15, b=0.10, a=1.0), Color(r=0.0, g=0.62, b=0.45, a=1.0)
PURPLE, GREY = Color(r=0.80, g=0.47, b=0.65, a=1.0), Color(r=0.55, g=0.55, b=0.55, a=1.0)
YELLOW = Color(r=0.94, g=0.89, b=0.26, a=1.0)
_WALL = Color(r=0.62, g=0.62, b=0.66, a=0.45)
_DARK = Color(r=0.20, g=0.20, b=0.22, a=1.0)
_PROPELLER = Color(r=0.6, g=0.6, b=0.6, a=0.35)
ARMS = {"rigid": BLUE, "flexible": ORANGE, "travelling": YELLOW, "fault": RED, "unknown": GREY}

FORCE_SCALE_M_PER_N = 0.012  # the arrow for 50 N is 1.5 times as long as the vehicle's width
_OVER_BOUNDS_M = 0.2
_TEXT_PX = 14.0
_LABEL_M = 0.12  # height of a label above its object


def timestamp(t_us: int) -> Timestamp:
    """Return the autopilot's time; a negative time, from a broken clock, becomes 0."""
    seconds, rest_us = divmod(max(0, t_us), 1_000_000)
    return Timestamp(seconds, rest_us * 1000)


def pose(at: Vec3, q: Rotation = IDENTITY) -> Pose:
    x, y, z = at
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(w=q[0], x=q[1], y=q[2], z=q[3]))


def line(
    points: Iterable[Vec3], colour: Color, width_px: float = 2.0, *, closed: bool = False
) -> LinePrimitive:
    """Return a line with a constant width on the screen."""
    return LinePrimitive(
        type=LinePrimitiveLineType.LineLoop if closed else LinePrimitiveLineType.LineStrip,
        pose=pose((0.0, 0.0, 0.0)),
        thickness=width_px,
        scale_invariant=True,
        points=[Point3(x=x, y=y, z=z) for x, y, z in points],
        color=colour,
    )


def text(at: Vec3, words: str) -> TextPrimitive:
    """Return a label that faces the viewer, with a constant size on the screen."""
    return TextPrimitive(
        pose=pose(at), billboard=True, font_size=_TEXT_PX, scale_invariant=True, color=_DARK, text=words
    )


def ball(at: Vec3, diameter_m: float, colour: Color) -> SpherePrimitive:
    return SpherePrimitive(
        pose=pose(at), size=Vector3(x=diameter_m, y=diameter_m, z=diameter_m), color=colour
    )


def arrow(at: Vec3, force_n: Vec3, colour: Color) -> ArrowPrimitive:
    """Return an arrow whose length is proportional to the force."""
    x, y, z = force_n
    length = FORCE_SCALE_M_PER_N * math.sqrt(x * x + y * y + z * z)
    head = min(0.08, 0.5 * length)
    return ArrowPrimitive(
        pose=pose(at, _turned_to(force_n)),
        shaft_length=length - head,
        shaft_diameter=0.03,
        head_length=head,
        head_diameter=0.07,
        color=colour,
    )


def _turned_to(v: Vec3) -> Rotation:
    """Return the rotation of the x axis to a direction: first yaw, then pitch."""
    yaw, pitch = math.atan2(v[1], v[0]), -math.atan2(v[2], math.hypot(v[0], v[1]))
    cy, sy, cp, sp = math.cos(yaw / 2), math.sin(yaw / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    return (cy * cp, -sy * sp, cy * sp, sy * cp)


def entity(t_us: int, name: str, frame: str = MISSION, **primitives: Sequence[object]) -> SceneEntity:
    """Return an entity; it replaces an earlier entity of the same name."""
    return SceneEntity(
        timestamp=timestamp(t_us),
        frame_id=frame,
        id=name,
        frame_locked=True,
        **primitives,  # type: ignore[arg-type]
    )


# --- the room ----------------------------------------------------------------------------------------------


def room(shown: RoomMap, t_us: int) -> list[SceneEntity]:
    """Return bounds, walls, posts, start and goal."""
    return [
        _bounds(shown, t_us),
        *(_wall(wall, height_over(shown), t_us) for wall in shown.walls),
        *(_post(post, height_over(shown), t_us) for post in shown.posts),
        _goal(shown, t_us),
    ]


def _bounds(shown: RoomMap, t_us: int) -> SceneEntity:
    (x0, x1), (y0, y1), (z0, z1) = shown.bounds.x, shown.bounds.y, shown.bounds.z
    corners: list[Vec2] = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    loops = [line([(x, y, z) for x, y in corners], GREY, 1.0, closed=True) for z in (z0, z1)]
    posts = [line([(x, y, z0), (x, y, z1)], GREY, 1.0) for x, y in corners]
    return entity(t_us, "bounds", lines=[*loops, *posts])


def height_over(shown: RoomMap) -> float:
    """Return the height of the drawn walls, slightly above the bounds."""
    return shown.bounds.z[1] + _OVER_BOUNDS_M


def _wall(wall: DrawnWall, height: float, t_us: int) -> SceneEntity:
    (px, py), (nx, ny) = wall.surface.point, wall.surface.normal
    back = 0.5 * wall.thickness_m
    yaw = math.atan2(ny, nx)
    upright = pose(
        (px - back * nx, py - back * ny, 0.5 * height), (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
    )
    size = Vector3(x=wall.thickness_m, y=wall.surface.length_m, z=height)
    return entity(
        t_us,
        f"wall {wall.plane.name}",
        cubes=[CubePrimitive(pose=upright, size=size, color=_WALL)],
        texts=[text((px - back * nx, py - back * ny, height + _LABEL_M), wall.name)],
    )


def _post(post: Post, height: float, t_us: int) -> SceneEntity:
    x, y = post.centre
    upright = CylinderPrimitive(
        pose=pose((x, y, 0.5 * height)),
        size=Vector3(x=2.0 * post.radius_m, y=2.0 * post.radius_m, z=height),
        bottom_scale=1.0,
        top_scale=1.0,
        color=_WALL,
    )
    texts = [text((x, y, height + _LABEL_M), named_material(post))]
    return entity(t_us, f"post {post.name}", cylinders=[upright], texts=texts)


def _goal(shown: RoomMap, t_us: int) -> SceneEntity:
    start, goal, width = shown.start, shown.goal, 2.0 * shown.capture_radius_m
    size = Vector3(x=width, y=width, z=0.01)
    capture = CylinderPrimitive(
        pose=pose(goal),
        size=size,
        bottom_scale=1.0,
        top_scale=1.0,
        color=Color(r=0.0, g=0.62, b=0.45, a=0.4),
    )
    # Two labels at one point are unreadable.
    names = [(goal, "start and goal")] if start == goal else [(goal, "goal"), (start, "start")]
    return entity(
        t_us,
        "start and goal",
        cylinders=[capture],
        spheres=[ball(goal, 0.04, GREEN), ball(start, 0.04, GREY)],
        texts=[text((x, y, z + _LABEL_M), name) for (x, y, z), name in names],
    )


def planned(flight: PredictedFlight, mission: Mission, t_us: int) -> SceneEntity:
    """Return the predicted path of the mission, with large balls at hits and small balls at waypoints."""
    hits = [(*hit.position, mission.altitude_at(index - 1)) for index, hit in flight.hits.items()]
    stops = [w.position for w in mission.waypoints if w.position is not None]
    return entity(
        t_us,
        "planned path",
        lines=[line(points.tolist(), ORANGE, 2.0) for points in planned_lines(mission, flight)],
        spheres=[*(ball(at, 0.05, ORANGE) for at in hits), *(ball(at, 0.03, ORANGE) for at in stops)],
    )


# --- the vehicle -------------------------------------------------------------------------------------------


def vehicle(airframe: Airframe, arms: str, t_us: int) -> SceneEntity:
    """Return body, propellers and guards in the vehicle's frame; the arms' colour shows the lock's state."""
    # The airframe's axes are forward, right, down.
    motors = [(m.x_m, -m.y_m) for m in airframe.motors]
    # Airframes do not specify the propeller size, so draw the largest propeller that fits.
    inside = airframe.contact_distance_m - max(max(abs(x), abs(y)) for x, y in motors)
    apart = [math.dist(a, b) for a, b in combinations(motors, 2)]
    radius = max(0.02, min(inside, *(0.5 * d for d in apart if d > 0.01)))  # coaxial motors share a position
    size = Vector3(x=2.0 * radius, y=2.0 * radius, z=0.008)
    propellers = [
        CylinderPrimitive(
            pose=pose((x, y, 0.03)), size=size, bottom_scale=1.0, top_scale=1.0, color=_PROPELLER
        )
        for x, y in motors
    ]
    return entity(
        t_us,
        "vehicle",
        VEHICLE,
        cubes=[
            CubePrimitive(pose=pose((0.0, 0.0, 0.0)), size=Vector3(x=0.11, y=0.07, z=0.05), color=_DARK),
            CubePrimitive(pose=pose((0.065, 0.0, 0.0)), size=Vector3(x=0.03, y=0.03, z=0.03), color=GREEN),
        ],
        cylinders=[*propellers, *(_arm(x, y, ARMS[arms]) for x, y in motors)],
        lines=[
            line([(x, y, 0.0) for x, y in guard], ARMS[arms], 3.0, closed=True) for guard in airframe.guards_m
        ],
    )


def _arm(x: float, y: float, colour: Color) -> CylinderPrimitive:
    """Return a cylinder from the centre to a motor; its z axis is rotated towards the motor."""
    length, yaw = math.hypot(x, y), math.atan2(y, x)
    half = math.sqrt(0.5)
    # Pitch the cylinder by a quarter turn, then yaw it towards the motor.
    q = (
        math.cos(yaw / 2) * half,
        -math.sin(yaw / 2) * half,
        math.cos(yaw / 2) * half,
        math.sin(yaw / 2) * half,
    )
    size = Vector3(x=0.022, y=0.022, z=length)
    return CylinderPrimitive(
        pose=pose((0.5 * x, 0.5 * y, 0.0), q), size=size, bottom_scale=1.0, top_scale=1.0, color=colour
    )
