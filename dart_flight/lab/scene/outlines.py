"""Room, vehicle and path as point clouds (foxglove.PointCloud), for viewers without scenes such as Rerun."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise

from foxglove.messages import PackedElementField, PackedElementFieldNumericType, PointCloud

from dart_flight.base.geometry import Vec3
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import Airframe
from dart_flight.lab.scene.drawing import goal_altitude_m, height_over, pose, timestamp

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


def room(mission: Mission) -> list[tuple[Iterable[Vec3], Rgb]]:
    """Return edges of the bounds, a grid on every wall's surface, and the goal's capture circle."""
    (x0, x1), (y0, y1), (z0, z1) = mission.bounds.x, mission.bounds.y, mission.bounds.z
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    edges: list[Segment] = []
    for (ax, ay), (bx, by) in pairwise([*corners, corners[0]]):
        edges += [((ax, ay, z0), (bx, by, z0)), ((ax, ay, z1), (bx, by, z1)), ((ax, ay, z0), (ax, ay, z1))]
    parts: list[tuple[Iterable[Vec3], Rgb]] = [(_points(edges, _ROOM_STEP_M), GREY)]
    height = height_over(mission)
    for wall in mission.walls:
        (ax, ay), (bx, by) = mission.vehicle.airframe.wall_surface(wall).ends
        columns, rows = max(1, round(wall.length_m / _GRID_M)), max(1, round(height / _GRID_M))
        lines: list[Segment] = []
        for i in range(columns + 1):
            x, y = ax + (bx - ax) * i / columns, ay + (by - ay) * i / columns
            lines.append(((x, y, 0.0), (x, y, height)))
        lines += [((ax, ay, height * i / rows), (bx, by, height * i / rows)) for i in range(rows + 1)]
        parts.append((_points(lines, _ROOM_STEP_M), WALL))
    (gx, gy), radius = mission.goal.position_m, mission.goal.capture_radius_m
    turns = [2.0 * math.pi * i / 60 for i in range(60)]
    z = goal_altitude_m(mission)
    circle = [(gx + radius * math.cos(a), gy + radius * math.sin(a), z) for a in turns]
    return [*parts, (circle, GREEN)]


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
