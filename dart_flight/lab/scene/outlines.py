"""Room, vehicle and path as point clouds (foxglove.PointCloud), for viewers without scenes such as Rerun."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise

import numpy as np
from foxglove.messages import PackedElementField, PackedElementFieldNumericType, PointCloud

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.config.vehicle import Airframe
from dart_flight.lab.map_model import RoomMap, circle
from dart_flight.lab.scene.drawing import height_over, pose, timestamp

Segment = tuple[Vec3, Vec3]
_ROOM_STEP_M, _VEHICLE_STEP_M = 0.03, 0.01
_GRID_M = 0.4  # spacing of the lines on a wall
_POINT = struct.Struct("<fffBBBB")
_FIELDS = [
    *(
        PackedElementField(name=axis, offset=4 * i, type=PackedElementFieldNumericType.Float32)
        for i, axis in enumerate("xyz")
    ),
    *(
        PackedElementField(name=part, offset=12 + i, type=PackedElementFieldNumericType.Uint8)
        for i, part in enumerate(("red", "green", "blue", "alpha"))
    ),
]
Rgb = tuple[int, int, int]
GREY, WALL, GREEN, BLUE = (140, 140, 140), (200, 150, 90), (0, 158, 115), (86, 180, 233)
ARMS: dict[str, Rgb] = {
    "rigid": (0, 114, 178),
    "flexible": (230, 159, 0),
    "travelling": (240, 228, 66),
    "fault": (213, 38, 26),
    "unknown": GREY,
}


def cloud(t_us: int, frame: str, coloured: Iterable[tuple[Iterable[Vec3], Rgb]]) -> PointCloud:
    data = b"".join(_POINT.pack(*point, *colour, 255) for points, colour in coloured for point in points)
    return PointCloud(
        timestamp=timestamp(t_us),
        frame_id=frame,
        pose=pose((0.0, 0.0, 0.0)),
        point_stride=_POINT.size,
        fields=_FIELDS,
        data=data,
    )


def room(shown: RoomMap) -> list[tuple[Iterable[Vec3], Rgb]]:
    """Return edges of the bounds, a grid on the surface of every wall and post, and the capture circle."""
    (x0, x1), (y0, y1), (z0, z1) = shown.bounds.x, shown.bounds.y, shown.bounds.z
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    edges: list[Segment] = []
    for (ax, ay), (bx, by) in pairwise([*corners, corners[0]]):
        edges += [((ax, ay, z0), (bx, by, z0)), ((ax, ay, z1), (bx, by, z1)), ((ax, ay, z0), (ax, ay, z1))]
    parts: list[tuple[Iterable[Vec3], Rgb]] = [(_points(edges, _ROOM_STEP_M), GREY)]
    bases = [circle(post.centre, post.radius_m)[::6] for post in shown.posts]
    for wall in shown.walls:
        columns = max(1, round(wall.surface.length_m / _GRID_M))
        bases.append(np.linspace(*wall.surface.ends, columns + 1))
    parts += [(_points(_sheet(base.tolist(), height_over(shown)), _ROOM_STEP_M), WALL) for base in bases]
    return [*parts, (circle(shown.goal, shown.capture_radius_m).tolist(), GREEN)]


def _sheet(base: Sequence[Vec2], height: float) -> list[Segment]:
    """Return a grid of lines on an upright surface above a line on the ground."""
    rows = max(1, round(height / _GRID_M))
    segments: list[Segment] = [((x, y, 0.0), (x, y, height)) for x, y in base]
    for z in (height * i / rows for i in range(rows + 1)):
        segments += [((ax, ay, z), (bx, by, z)) for (ax, ay), (bx, by) in pairwise(base)]
    return segments


def vehicle(airframe: Airframe, arms: str) -> list[tuple[Iterable[Vec3], Rgb]]:
    """Return guards and arms in the vehicle's frame, with a green nose."""
    motors = [(m.x_m, -m.y_m, 0.0) for m in airframe.motors]
    edges: list[Segment] = [((0.0, 0.0, 0.0), motor) for motor in motors]
    for guard in airframe.guards_m:
        edges += pairwise([(x, y, 0.0) for x, y in (*guard, guard[0])])
    nose = [((0.0, 0.0, 0.0), (airframe.contact_distance_m, 0.0, 0.0))]
    return [(_points(edges, _VEHICLE_STEP_M), ARMS[arms]), (_points(nose, _VEHICLE_STEP_M), GREEN)]


def _points(segments: Sequence[Segment], step_m: float) -> Iterator[Vec3]:
    """Yield points along segments, at most a step apart, including both ends."""
    for a, b in segments:
        count = max(1, math.ceil(math.dist(a, b) / step_m))
        for i in range(count + 1):
            s = i / count
            yield (a[0] + (b[0] - a[0]) * s, a[1] + (b[1] - a[1]) * s, a[2] + (b[2] - a[2]) * s)
