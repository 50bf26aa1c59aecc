"""Past walls and posts: the shortest polyline between two places, and what keeps each of its parts clear.

A part of a path keeps to one side of every wall: a half-plane before it or behind it. Past a wall's end it
keeps beyond the end, and from its edge by half a vehicle and a margin: round the edge as round a post.
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

_PAST_END_M = 0.12  # beyond half a vehicle: a wall may be a little longer, and the vehicle beside its path
_AFTER_HIT_M = 0.05  # more than that after a hit: what it leaves of the velocity is known less well
_ON_LINE_M = 0.01  # a corner of a path is that far inside of its half-planes
_AROUND = 8  # corners of the polyline round a post
TOUCH_M = 0.01  # that a path to a place at a wall keeps from its plane


class Obstacles(NamedTuple):
    """What paths lead past; `discs`: round posts, with what a vehicle turned as it likes keeps from them."""

    walls: tuple[Wall, ...]
    discs: tuple[Disc, ...]
    bounds: BoundsSpec

    @classmethod
    def of(cls, scenario: Scenario) -> Obstacles:
        """Of a scenario."""
        airframe = scenario.vehicle.airframe
        kept_m = math.hypot(airframe.contact_distance_m, airframe.guard_along_m) + CLEARANCE_M
        discs = (Disc(post.centre, post.radius_m + kept_m) for post in scenario.posts)
        return cls(tuple(scenario.walls.values()), tuple(discs), scenario.bounds)


def shortest_path(begin: Vec2, end: Vec2, among: Obstacles) -> list[Vec2] | None:
    """Corners of the shortest path past posts and the ends of walls, both ends included; None: there is none.

    A wall nearer than `CLEARANCE_M` to one of the ends does not count at that end.
    """
    walls, discs, bounds = among

    def blocked(a: Vec2, b: Vec2) -> bool:
        return any(_stands_between(w, a, b) for w in walls) or any(_cuts(d, a, b) for d in discs)

    if not blocked(begin, end):
        return _on_one_side_each([begin, end], walls, bounds)
    tips = [tip for wall in walls for tip in _round_ends(wall)]
    tips += [corner for disc in discs for corner in _round_disc(disc)]
    path = _shortest_through([begin, end, *_within_bounds(tips, bounds)], blocked)
    return path and _on_one_side_each(path, walls, bounds)


def least_length_m(begin: Vec2, end: Vec2, among: Obstacles) -> float:
    """No path that keeps clear is shorter: past a wall's end it crosses the line on beyond the edge.

    Posts do not count, which keeps it a bound.
    """
    tips: list[Vec2] = []
    for wall in among.walls:
        edge, past_m = _edge(wall), wall.half_vehicle_m + _PAST_END_M
        tips += [_moved_along(wall, tip, side * past_m) for side, tip in zip((-1.0, 1.0), edge, strict=True)]
    path = _shortest_through([begin, end, *tips], lambda a, b: any(_crosses(w, a, b) for w in among.walls))
    if path is None:
        return distance2(begin, end)
    return sum(distance2(a, b) for a, b in itertools.pairwise(path))


def _shortest_through(places: Sequence[Vec2], blocked: Callable[[Vec2, Vec2], bool]) -> list[Vec2] | None:
    """The shortest polyline from the first place to the second, by any others (Dijkstra)."""
    best, queue = {0: 0.0}, [(0.0, 0)]
    came: dict[int, int] = {}
    while queue:
        length, here = heapq.heappop(queue)
        if here == 1:
            break
        for there in range(1, len(places)):
            a, b = places[here], places[there]
            further = length + distance2(a, b)
            if further < best.get(there, math.inf) and not blocked(a, b):
                best[there], came[there] = further, here
                heapq.heappush(queue, (further, there))
    if 1 not in came:
        return None
    path = [1]
    while path[-1] != 0:
        path.append(came[path[-1]])
    return [places[k] for k in reversed(path)]


def _edge(wall: Wall) -> tuple[Vec2, Vec2]:
    """The two ends of a wall's face, which is half a vehicle behind the plane of the vehicle's centre."""
    (nx, ny), back = wall.normal, wall.half_vehicle_m
    middle = (wall.point[0] - back * nx, wall.point[1] - back * ny)
    left, right = (_moved_along(wall, middle, side * 0.5 * wall.length_m) for side in (-1.0, 1.0))
    return left, right


def _moved_along(wall: Wall, place: Vec2, by_m: float) -> Vec2:
    (tx, ty) = wall.tangent
    return (place[0] + by_m * tx, place[1] + by_m * ty)


def _crosses(wall: Wall, a: Vec2, b: Vec2) -> bool:
    """Whether a straight path leads through a wall's face, or nearer past its end than a path keeps."""
    here, there = (wall.signed_distance(p) + wall.half_vehicle_m for p in (a, b))
    if here * there >= 0.0:
        return False
    share = here / (here - there)
    crossing = (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]))
    return bool(wall.end_distance_m(crossing) > _ON_LINE_M - wall.half_vehicle_m - _PAST_END_M)


def _round_ends(wall: Wall) -> Iterator[Vec2]:
    """Corners round a wall's ends, before it and behind it, as far from its plane as a path keeps."""
    (tx, ty), (nx, ny), reach = wall.tangent, wall.normal, 0.5 * wall.length_m
    for side, face in itertools.product((-1.0, 1.0), (-1.0, 1.0)):
        tip = (wall.point[0] + side * reach * tx, wall.point[1] + side * reach * ty)
        past, off = side * (end_margin_m(wall, tip) + _PAST_END_M), face * (CLEARANCE_M + _ON_LINE_M)
        yield (tip[0] + past * tx + off * nx, tip[1] + past * ty + off * ny)


def _round_disc(disc: Disc) -> Iterator[Vec2]:
    """Corners round a disc, whose sides are outside of it."""
    step = 2.0 * math.pi / _AROUND
    radius = (disc.radius_m + _ON_LINE_M) / math.cos(0.5 * step)
    for k in range(_AROUND):
        yield (disc.centre[0] + radius * math.cos(k * step), disc.centre[1] + radius * math.sin(k * step))


def _within_bounds(places: Sequence[Vec2], bounds: BoundsSpec) -> list[Vec2]:
    (x0, x1), (y0, y1) = bounds.x, bounds.y
    return [(x, y) for x, y in places if x0 <= x <= x1 and y0 <= y <= y1]


def _cuts(disc: Disc, a: Vec2, b: Vec2) -> bool:
    """Whether a straight path leads through a disc; from a place in it, whether it leads further in."""
    nearest_m = distance_to_segment(disc.centre, a, b)
    return nearest_m < min(disc.radius_m, distance2(a, disc.centre), distance2(b, disc.centre))


def _on_one_side_each(path: list[Vec2], walls: Sequence[Wall], bounds: BoundsSpec) -> list[Vec2]:
    """The path with more corners, so that each of its parts is on one side of every wall (`sides`)."""
    found = [path[0]]
    for b in path[1:]:
        for wall in walls:
            a = found[-1]
            if _fits(a, b, wall):
                continue
            corners = _within_bounds(list(_round_ends(wall)), bounds)
            between = [c for c in corners if _fits(a, c, wall) and _fits(c, b, wall)]
            found += sorted(between, key=lambda c: distance2(a, c) + distance2(c, b))[:1]
        found.append(b)
    return found


def _fits(a: Vec2, b: Vec2, wall: Wall) -> bool:
    """Whether a straight path is on one side of a wall; of one that it begins or ends at, before it."""
    if _is_at(wall, a) or _is_at(wall, b):
        return min(wall.signed_distance(a), wall.signed_distance(b)) >= 0.0
    return max(_inside(a, b, wall)) >= 0.0


def _is_at(wall: Wall, place: Vec2) -> bool:
    """Whether a place is just before a wall, nearer than a path keeps."""
    return wall.spans(place) and 0.0 <= wall.signed_distance(place) < CLEARANCE_M


def _inside(a: Vec2, b: Vec2, wall: Wall) -> list[float]:
    return [min(_within(half, a), _within(half, b)) for half in _half_planes(wall)]


_PAST_RIGHT = 2  # the first of `_half_planes` that is past an end


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
    if _is_at(wall, a) or _is_at(wall, b):
        return not _fits(a, b, wall)
    return bool(is_blocked(wall, a, b))


def regions(
    begin: Vec2, end: Vec2, among: Obstacles, touched: Sequence[Wall] = (), after_hit: bool = False
) -> tuple[Region, ...]:
    """What holds the straight path between two places and keeps clear of all walls and posts.

    Args:
        begin, end: of the path, on which nothing stands.
        among: all there is.
        touched: those that are hit where the path begins or ends: it comes up to them.
        after_hit: whether a hit was the last event before it.
    """
    found: list[Region] = [*among.discs]
    past_end_m = _PAST_END_M + (_AFTER_HIT_M if after_hit else 0.0)
    for wall in among.walls:
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
        # A place at the wall: as near to it as that is, but for what it must not touch.
        nearest = max(TOUCH_M, min(wall.signed_distance(begin), wall.signed_distance(end)))
        yield HalfPlane((nx, ny), plane_m + min(nearest, CLEARANCE_M))
        return
    half = _half_planes(wall)[best]
    if best < _PAST_RIGHT:
        yield half
        return
    yield HalfPlane(half.normal, half.offset_m - wall.half_vehicle_m - _PAST_END_M)
    kept_m = wall.half_vehicle_m + past_end_m + _ON_LINE_M
    yield Disc(max(_edge(wall), key=lambda tip: _within(half, tip)), kept_m)


def _within(half: HalfPlane, place: Vec2) -> float:
    return half.normal[0] * place[0] + half.normal[1] * place[1] - half.offset_m
