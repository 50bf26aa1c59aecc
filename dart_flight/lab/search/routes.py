"""Ways past walls: the shortest polyline between two places, and on which side of each wall its parts are."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence

from dart_flight.base.geometry import Vec2, distance2
from dart_flight.base.walls import Wall
from dart_flight.config.mission_file import BoundsSpec
from dart_flight.core.mission.approach import CLEARANCE_M, is_blocked
from dart_flight.core.mission.wall_uncertainty import end_margin_m
from dart_flight.lab.search.optimal_trajectory import HalfPlane

_PAST_END_M = 0.1  # beyond half a vehicle: a wall may be a little longer, and the vehicle beside its path
_ON_LINE_M = 0.01  # a corner of a path is that far inside of its half-planes
TOUCH_M = 0.01  # that a path to a place at a wall keeps from its plane


def shortest_path(begin: Vec2, end: Vec2, walls: Sequence[Wall], bounds: BoundsSpec) -> list[Vec2] | None:
    """Corners of the shortest path past the ends of walls, both ends included; None: there is none.

    A wall nearer than `CLEARANCE_M` to one of the ends does not count at that end.
    """
    tips = [tip for wall in walls for tip in _round_ends(wall, bounds)]
    places: list[Vec2] = [begin, end, *tips]
    best, queue = {0: 0.0}, [(0.0, 0)]
    came: dict[int, int] = {}
    while queue:
        length, here = heapq.heappop(queue)
        if here == 1:
            break
        for there in range(1, len(places)):
            a, b = places[here], places[there]
            further = length + distance2(a, b)
            if further < best.get(there, math.inf) and not any(_stands_between(w, a, b) for w in walls):
                best[there], came[there] = further, here
                heapq.heappush(queue, (further, there))
    if 1 not in came:
        return None
    path = [1]
    while path[-1] != 0:
        path.append(came[path[-1]])
    return _on_one_side_each([places[k] for k in reversed(path)], walls, bounds)


def _round_ends(wall: Wall, bounds: BoundsSpec) -> Iterator[Vec2]:
    """Corners round a wall's ends, before it and behind it, as far from its plane as a path keeps."""
    (tx, ty), (nx, ny), reach = wall.tangent, wall.normal, 0.5 * wall.length_m
    for side, face in itertools.product((-1.0, 1.0), (-1.0, 1.0)):
        tip = (wall.point[0] + side * reach * tx, wall.point[1] + side * reach * ty)
        past, off = side * (end_margin_m(wall, tip) + _PAST_END_M), face * (CLEARANCE_M + _ON_LINE_M)
        x, y = tip[0] + past * tx + off * nx, tip[1] + past * ty + off * ny
        if bounds.x[0] <= x <= bounds.x[1] and bounds.y[0] <= y <= bounds.y[1]:
            yield (x, y)


def _on_one_side_each(path: list[Vec2], walls: Sequence[Wall], bounds: BoundsSpec) -> list[Vec2]:
    """The path with more corners, so that each of its parts is on one side of every wall (`sides`)."""
    found = [path[0]]
    for b in path[1:]:
        for wall in walls:
            a = found[-1]
            if _fits(a, b, wall):
                continue
            between = [c for c in _round_ends(wall, bounds) if _fits(a, c, wall) and _fits(c, b, wall)]
            found += sorted(between, key=lambda c: distance2(a, c) + distance2(c, b))[:1]
        found.append(b)
    return found


def _fits(a: Vec2, b: Vec2, wall: Wall) -> bool:
    """Whether a straight path is on one side of a wall; of one that it begins or ends at, it is."""
    near = (wall.spans(p) and 0.0 <= wall.signed_distance(p) < CLEARANCE_M for p in (a, b))
    return any(near) or max(_inside(a, b, wall)) >= 0.0


def _inside(a: Vec2, b: Vec2, wall: Wall) -> list[float]:
    return [min(_within(half, a), _within(half, b)) for half in _half_planes(wall)]


def _half_planes(wall: Wall) -> tuple[HalfPlane, ...]:
    """Before a wall, behind it, past its right and its left end."""
    (nx, ny), (tx, ty), (x, y) = wall.normal, wall.tangent, wall.point
    plane_m, middle_m = nx * x + ny * y, tx * x + ty * y
    past_m = 0.5 * wall.length_m + wall.half_vehicle_m + _PAST_END_M - _ON_LINE_M
    return (
        HalfPlane((nx, ny), plane_m + CLEARANCE_M),
        HalfPlane((-nx, -ny), -plane_m + CLEARANCE_M),
        HalfPlane((tx, ty), middle_m + past_m),
        HalfPlane((-tx, -ty), -middle_m + past_m),
    )


def _stands_between(wall: Wall, a: Vec2, b: Vec2) -> bool:
    """As `is_blocked`, but that a place just before a wall is before it."""
    near = [wall.spans(p) and 0.0 <= wall.signed_distance(p) < CLEARANCE_M for p in (a, b)]
    return not any(near) and bool(is_blocked(wall, a, b))


def sides(begin: Vec2, end: Vec2, walls: Iterable[Wall], touched: Sequence[Wall]) -> tuple[HalfPlane, ...]:
    """A half-plane for each wall that holds the straight path between two places and keeps clear of the wall.

    Args:
        begin, end: of the path, on which no wall stands.
        walls: all there are.
        touched: those that are hit where the path begins or ends: it comes up to them.
    """
    return tuple(_side(begin, end, wall, wall in touched) for wall in walls)


def _side(begin: Vec2, end: Vec2, wall: Wall, touched: bool) -> HalfPlane:
    (nx, ny), (x, y) = wall.normal, wall.point
    plane_m = nx * x + ny * y
    if touched:
        return HalfPlane((nx, ny), plane_m)
    inside = _inside(begin, end, wall)
    best = max(range(4), key=lambda k: inside[k])
    if inside[best] >= 0.0:
        return _half_planes(wall)[best]
    # A place at the wall: as near to it as that is, but for what it must not touch.
    nearest = max(TOUCH_M, min(wall.signed_distance(begin), wall.signed_distance(end)))
    return HalfPlane((nx, ny), plane_m + min(nearest, CLEARANCE_M))


def _within(half: HalfPlane, place: Vec2) -> float:
    return half.normal[0] * place[0] + half.normal[1] * place[1] - half.offset_m
