"""Shortest polylines past walls and posts, and regions that keep each part of a polyline clear of obstacles.

Each part of a path stays on one side of every wall: in front of the wall, behind the wall, or beyond one of
the wall's ends. The distance of a part from posts and from the ends of walls is at least half the vehicle's
width plus a margin.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from dart_flight.base.geometry import Vec2, distance2, distance_to_segment
from dart_flight.base.walls import Wall
from dart_flight.config.mission_file import BoundsSpec
from dart_flight.core.mission.approach import CLEARANCE_M, is_blocked
from dart_flight.core.mission.wall_uncertainty import end_margin_m
from dart_flight.lab.search.optimal_trajectory import Disc, HalfPlane, Region
from dart_flight.lab.search.scenario import Scenario

_PAST_END_M = 0.12  # margin past a wall's end for tracking errors and for a wall that is longer than stated
_AFTER_HIT_M = 0.05  # additional margin after a hit, whose outgoing velocity is uncertain
_ON_LINE_M = 0.01  # distance of a path's corner from the edge of its half-planes
_OFF_BOUNDS_M = 0.1  # distance of trajectories from the bounds
_AROUND = 8  # number of corners of the polyline around a post
TOUCH_M = 0.01  # distance from the wall's plane of a path to a place at this wall


def room_of(scenario: Scenario) -> tuple[HalfPlane, ...]:
    """Return the bounds as half-planes, moved inwards by the margin `_OFF_BOUNDS_M`."""
    (x0, x1), (y0, y1) = scenario.bounds.x, scenario.bounds.y
    return (
        HalfPlane((1.0, 0.0), x0 + _OFF_BOUNDS_M),
        HalfPlane((-1.0, 0.0), -x1 + _OFF_BOUNDS_M),
        HalfPlane((0.0, 1.0), y0 + _OFF_BOUNDS_M),
        HalfPlane((0.0, -1.0), -y1 + _OFF_BOUNDS_M),
    )


class Obstacles(NamedTuple):
    """Walls, bounds and discs around posts. The discs are large enough for a vehicle at any yaw."""

    walls: tuple[Wall, ...]
    discs: tuple[Disc, ...]
    bounds: BoundsSpec

    @classmethod
    def from_scenario(cls, scenario: Scenario) -> Obstacles:
        kept_m = scenario.vehicle.airframe.corner_m + CLEARANCE_M
        discs = (Disc(post.centre, post.radius_m + kept_m) for post in scenario.posts)
        return cls(tuple(scenario.walls.values()), tuple(discs), scenario.bounds)


def shortest_path(begin: Vec2, end: Vec2, obstacles: Obstacles) -> list[Vec2] | None:
    """Return the shortest polyline past posts and walls, with both ends, or None if there is no path.

    If an end is nearer to a wall than `CLEARANCE_M`, no clearance from this wall is required at that end.
    """
    walls, discs, bounds = obstacles

    def blocked(a: Vec2, b: Vec2) -> bool:
        return any(_blocks(w, a, b) for w in walls) or any(_cuts(d, a, b) for d in discs)

    if not blocked(begin, end):
        return _on_one_side_each([begin, end], walls, bounds)
    tips = [tip for wall in walls for tip in _corners_around_ends(wall)]
    tips += [corner for disc in discs for corner in _corners_around_disc(disc)]
    path = _shortest_through([begin, end, *_within_bounds(tips, bounds)], blocked)
    return path and _on_one_side_each(path, walls, bounds)


def least_length_m(begin: Vec2, end: Vec2, obstacles: Obstacles) -> float:
    """Return a lower bound on the length of the paths that go around the ends of walls.

    Posts are ignored, because they only lengthen a path.
    """
    tips: list[Vec2] = []
    for wall in obstacles.walls:
        past_m, (tx, ty) = wall.half_vehicle_m + _PAST_END_M, wall.tangent
        (lx, ly), (rx, ry) = _surface_ends(wall)
        tips += [(lx - past_m * tx, ly - past_m * ty), (rx + past_m * tx, ry + past_m * ty)]
    path = _shortest_through(
        [begin, end, *tips], lambda a, b: any(_crosses(w, a, b) for w in obstacles.walls)
    )
    if path is None:
        return distance2(begin, end)
    return sum(distance2(a, b) for a, b in itertools.pairwise(path))


def _shortest_through(places: Sequence[Vec2], blocked: Callable[[Vec2, Vec2], bool]) -> list[Vec2] | None:
    """Return the shortest polyline from places[0] to places[1]; other places may be corners (Dijkstra)."""
    best, queue = {0: 0.0}, [(0.0, 0)]
    previous: dict[int, int] = {}
    while queue:
        length, here = heapq.heappop(queue)
        if here == 1:
            break
        for there in range(1, len(places)):
            a, b = places[here], places[there]
            further = length + distance2(a, b)
            if further < best.get(there, math.inf) and not blocked(a, b):
                best[there], previous[there] = further, here
                heapq.heappush(queue, (further, there))
    if 1 not in previous:
        return None
    path = [1]
    while path[-1] != 0:
        path.append(previous[path[-1]])
    return [places[k] for k in reversed(path)]


def _surface_ends(wall: Wall) -> tuple[Vec2, Vec2]:
    """Return the ends of a wall's surface, which is half the vehicle's width behind the wall's plane."""
    return wall.displaced(-wall.half_vehicle_m).ends


def _crosses(wall: Wall, a: Vec2, b: Vec2) -> bool:
    """Return whether a straight path crosses a wall's face, or passes an end of the face too closely."""
    crosses, place = wall.crossing(a, b, -wall.half_vehicle_m, -wall.half_vehicle_m)
    return bool(crosses and wall.end_distance_m(place) > _ON_LINE_M - wall.half_vehicle_m - _PAST_END_M)


def _corners_around_ends(wall: Wall) -> Iterator[Vec2]:
    """Yield corners around a wall's ends, on both sides of the wall, just beyond the clearance."""
    (tx, ty), (nx, ny) = wall.tangent, wall.normal
    for (side, tip), face in itertools.product(zip((-1.0, 1.0), wall.ends, strict=True), (-1.0, 1.0)):
        past, off = side * (end_margin_m(wall, tip) + _PAST_END_M), face * (CLEARANCE_M + _ON_LINE_M)
        yield (tip[0] + past * tx + off * nx, tip[1] + past * ty + off * ny)


def _corners_around_disc(disc: Disc) -> Iterator[Vec2]:
    """Yield corners around a disc; the lines that connect the corners stay outside of the disc."""
    step = 2.0 * math.pi / _AROUND
    radius = (disc.radius_m + _ON_LINE_M) / math.cos(0.5 * step)
    for k in range(_AROUND):
        yield (disc.centre[0] + radius * math.cos(k * step), disc.centre[1] + radius * math.sin(k * step))


def _within_bounds(places: Sequence[Vec2], bounds: BoundsSpec) -> list[Vec2]:
    (x0, x1), (y0, y1) = bounds.x, bounds.y
    return [(x, y) for x, y in places if x0 <= x <= x1 and y0 <= y <= y1]


def _cuts(disc: Disc, a: Vec2, b: Vec2) -> bool:
    """Return whether a straight path enters a disc.

    A path that begins or ends in the disc enters it if some point between is nearer to the centre than both
    ends.
    """
    nearest_m = distance_to_segment(disc.centre, a, b)
    return nearest_m < min(disc.radius_m, distance2(a, disc.centre), distance2(b, disc.centre))


def _on_one_side_each(path: list[Vec2], walls: Sequence[Wall], bounds: BoundsSpec) -> list[Vec2]:
    """Return the path with additional corners, so that each part is on one side of every wall."""
    found = [path[0]]
    for b in path[1:]:
        for wall in walls:
            a = found[-1]
            if _fits(a, b, wall):
                continue
            corners = _within_bounds(list(_corners_around_ends(wall)), bounds)
            between = [c for c in corners if _fits(a, c, wall) and _fits(c, b, wall)]
            found += sorted(between, key=lambda c: distance2(a, c) + distance2(c, b))[:1]
        found.append(b)
    return found


def _fits(a: Vec2, b: Vec2, wall: Wall) -> bool:
    """Return whether a straight path is on one side of a wall.

    If the path begins or ends at the wall, the whole path must be in front of the wall.
    """
    if _is_at(wall, a) or _is_at(wall, b):
        return min(wall.signed_distance(a), wall.signed_distance(b)) >= 0.0
    return max(_inside(a, b, wall)) >= 0.0


def _is_at(wall: Wall, place: Vec2) -> bool:
    """Return whether a place is in front of a wall and nearer than the clearance."""
    return wall.spans(place) and 0.0 <= wall.signed_distance(place) < CLEARANCE_M


def _inside(a: Vec2, b: Vec2, wall: Wall) -> list[float]:
    return [min(_within(half, a), _within(half, b)) for half in _half_planes(wall)]


_PAST_RIGHT = 2  # from this index on, `_half_planes` are past an end of the wall


def _half_planes(wall: Wall) -> tuple[HalfPlane, ...]:
    """Return the half-planes in front of a wall, behind it, and past its right and left end."""
    (nx, ny), (tx, ty), (x, y) = wall.normal, wall.tangent, wall.point
    plane_m, middle_m = nx * x + ny * y, tx * x + ty * y
    past_m = 0.5 * wall.length_m + wall.half_vehicle_m + _PAST_END_M - _ON_LINE_M
    return (
        HalfPlane((nx, ny), plane_m + CLEARANCE_M),
        HalfPlane((-nx, -ny), -plane_m + CLEARANCE_M),
        HalfPlane((tx, ty), middle_m + past_m),
        HalfPlane((-tx, -ty), -middle_m + past_m),
    )


def _blocks(wall: Wall, a: Vec2, b: Vec2) -> bool:
    """Return whether a wall blocks a path; a place at the wall counts as in front of the wall."""
    if _is_at(wall, a) or _is_at(wall, b):
        return not _fits(a, b, wall)
    return bool(is_blocked(wall, a, b))


def regions(
    begin: Vec2, end: Vec2, obstacles: Obstacles, touched: Sequence[Wall] = (), after_hit: bool = False
) -> tuple[Region, ...]:
    """Return regions that contain the straight path between two places and are clear of all walls and posts.

    Args:
        begin, end: ends of the path. The path must be unobstructed.
        touched: walls hit at the start or end of the path; the path may reach the planes of these walls.
        after_hit: whether the previous event was a hit.
    """
    found: list[Region] = [*obstacles.discs]
    past_end_m = _PAST_END_M + (_AFTER_HIT_M if after_hit else 0.0)
    for wall in obstacles.walls:
        found += _side(begin, end, wall, wall in touched, past_end_m)
    return tuple(found)


def _side(begin: Vec2, end: Vec2, wall: Wall, touched: bool, past_end_m: float) -> Iterator[Region]:
    (nx, ny), (x, y) = wall.normal, wall.point
    plane_m = nx * x + ny * y
    if touched:
        yield HalfPlane((nx, ny), plane_m)
        return
    inside = _inside(begin, end, wall)
    best = max(range(4), key=lambda k: inside[k])
    if inside[best] < 0.0:
        # A path to a place at the wall may come as near to the wall as that place.
        nearest = max(TOUCH_M, min(wall.signed_distance(begin), wall.signed_distance(end)))
        yield HalfPlane((nx, ny), plane_m + min(nearest, CLEARANCE_M))
        return
    half = _half_planes(wall)[best]
    if best < _PAST_RIGHT:
        yield half
        return
    yield HalfPlane(half.normal, half.offset_m - wall.half_vehicle_m - _PAST_END_M)
    kept_m = wall.half_vehicle_m + past_end_m + _ON_LINE_M
    yield Disc(max(_surface_ends(wall), key=lambda tip: _within(half, tip)), kept_m)


def _within(half: HalfPlane, place: Vec2) -> float:
    return half.normal[0] * place[0] + half.normal[1] * place[1] - half.offset_m
