"""A room measured by touch: a star of probes from the start, and the outline that their contacts form.

The body that touches a wall is an octagon of known size at a known heading. The distance h between the body's
centre and the touched wall depends on the wall's direction. Contacts at points c_i are therefore on one wall
with the normal n if

    c_i . n - h_i(n) = offset        for all these contacts

This holds for any incidence. The fit uses as few walls as possible. Every contact belongs to one wall. The
contacts of a wall have consecutive directions from the start. Consecutive walls intersect in corners. If a
wall has only one contact, more probes are needed beside this contact. Seen from the start, a corner must lie
between the contacts of its two walls. Otherwise another probe is needed between these contacts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_flight.base.arithmetic import sum_in_order
from dart_flight.base.geometry import Vec2, wrap_angle
from dart_flight.config.mission import Mission

_SPEED_M_S = 0.6
_ON_WALL_M = 0.02  # standard deviation of a contact's position
_MOST_OFF_M = 0.05
_BACK_M = 0.5
_INSIDE_M = 0.1  # a probe ends at this distance from the bounds, inside them
_STEEPEST_RAD = math.radians(65.0)  # largest angle between a contacted wall's normal and the probe
_OBLIQUE_RAD = math.radians(12.0)  # the direction measured by a more oblique contact is less certain
_STEP_RAD = math.radians(7.0)  # angle between a single contact and the additional probes beside this contact
_GROUP_COST = 12.0  # a further wall must reduce the sum of squared deviations by this

Array = NDArray[Any]


class RoomContact(NamedTuple):
    """A contact of a probe with a wall.

    Attributes:
        place: position of the vehicle's centre at the contact, mission frame, metres.
        heading_rad: heading of the body during the probe, mission frame.
        normal_rad: direction of the wall's normal as measured by this contact; None if not measured.
        sd_rad: standard deviation of `normal_rad`.
    """

    place: Vec2
    heading_rad: float
    normal_rad: float | None = None
    sd_rad: float = math.inf


class RoomWall(NamedTuple):
    """A wall's surface: c . n = offset_m. The normal n points into the room, at `normal_rad` from x."""

    normal_rad: float
    offset_m: float
    offset_sd_m: float
    normal_sd_rad: float
    touches: tuple[RoomContact, ...]

    @property
    def normal(self) -> Vec2:
        """Unit vector into the room."""
        return (math.cos(self.normal_rad), math.sin(self.normal_rad))


class Room(NamedTuple):
    """The measured outline of a room.

    Attributes:
        walls: counter-clockwise, as seen from the start.
        corners: intersection of each wall with the following wall. An intersection that does not lie between
            the contacts of both walls is None.
        gaps_rad: directions from the start that need more probes; empty if the outline is closed.
    """

    walls: list[RoomWall]
    corners: list[Vec2 | None]
    gaps_rad: list[float]

    @property
    def is_closed(self) -> bool:
        return len(self.walls) >= 3 and None not in self.corners and not self.gaps_rad


def plan_star(mission: Mission, directions_rad: Sequence[float], speed_m_s: float = _SPEED_M_S) -> Mission:
    """Return the mission with a probe in each direction, from the mission's start to its bounds.

    If the mission does not permit the probes, this raises InputError.
    """
    probes = []
    for k, angle in enumerate(directions_rad):
        d = (math.cos(angle), math.sin(angle))
        probe = {
            "from_m": list(mission.start),
            "direction": list(d),
            "length_m": _reach_m(mission, d),
            "speed_m_s": speed_m_s,
            "back_m": _BACK_M,
        }
        probes.append({"wall": f"touch {k + 1}", "mode": "rigid", "probe": probe})
    goal = {"position_m": list(mission.start), "hold_s": 0.2, "capture_radius_m": 0.3}
    return mission.replace({"collisions": probes, "waypoints": [], "goal": goal})


def _reach_m(mission: Mission, direction: Vec2) -> float:
    (x, y), bounds = mission.start, mission.bounds
    reach = math.inf
    for place, along, (low, high) in ((x, direction[0], bounds.x), (y, direction[1], bounds.y)):
        if abs(along) > 1e-9:
            reach = min(reach, ((high if along > 0.0 else low) - place) / along)
    return max(0.1, reach - _INSIDE_M)


class RoomFit:
    """Estimates walls from contacts, in any order.

    Args:
        start: a point inside the room, mission frame, metres.
        along_m: distance from a guard to the middle of the vehicle's side.
        out_m: distance from the vehicle's centre to its side.
    """

    def __init__(self, start: Vec2, touches: Sequence[RoomContact], along_m: float, out_m: float) -> None:
        self._start = start
        self._touches = sorted(touches, key=lambda t: self._bearing(t.place))
        signs = ((1, 1), (1, -1), (-1, 1), (-1, -1))
        body = [(s * out_m, t * along_m) for s, t in signs] + [(s * along_m, t * out_m) for s, t in signs]
        self._body = np.array(body)
        self._angles = np.radians(np.arange(0.0, 360.0, 0.5))
        normals = np.stack([np.cos(self._angles), np.sin(self._angles)])
        # Offset of the surface for every contact and direction of the normal; NaN where a wall of that
        # direction could not stop the probe.
        rows = []
        for one in self._touches:
            c, s = math.cos(one.heading_rad), math.sin(one.heading_rad)
            corners = self._body @ np.array([[c, s], [-s, c]])
            reach = (-(corners @ normals)).max(axis=0)
            offset = np.array(one.place) @ normals - reach
            away = np.array([math.cos(one.heading_rad), math.sin(one.heading_rad)])
            offset[-(away @ normals) < math.cos(_STEEPEST_RAD)] = np.nan
            rows.append(offset)
        self._offsets = np.array(rows)

    def _bearing(self, place: Vec2) -> float:
        return math.atan2(place[1] - self._start[1], place[0] - self._start[0]) % (2.0 * math.pi)

    def fit(self) -> Room:
        """Return the fewest walls that explain the contacts, and the directions that need more contacts."""
        n = len(self._touches)
        if n < 3:
            return Room([], [], [2.0 * math.pi * k / 8 for k in range(8)])
        best: tuple[float, list[list[int]]] = (math.inf, [])
        for first in range(min(n, 6)):  # try several beginnings of the circular sequence
            order = [(first + k) % n for k in range(n)]
            found = self._partition(order)
            best = min(best, found, key=lambda one: one[0])
        walls = [self._wall(group) for group in best[1]]
        return self._closed(walls)

    def _partition(self, order: list[int]) -> tuple[float, list[list[int]]]:
        """Divide the contacts into groups of neighbours at the lowest cost, by dynamic programming.

        Return the cost and the groups.
        """
        n = len(order)
        cost: list[float] = [0.0] + [math.inf] * n
        back = [0] * (n + 1)
        for end in range(1, n + 1):
            for begin in range(end - 1, -1, -1):
                misfit = self._misfit(order[begin:end])[0]
                if misfit == math.inf:
                    break
                total = cost[begin] + misfit + _GROUP_COST
                if total < cost[end]:
                    cost[end], back[end] = total, begin
        groups, end = [], n
        while end > 0:
            groups.append(order[back[end] : end])
            end = back[end]
        return cost[n], groups[::-1]

    def _misfit(self, group: list[int]) -> tuple[float, int, float]:
        """Return a group's best wall: sum of squared deviations, index of the normal, and offset."""
        offsets = self._offsets[group]
        middle = offsets.mean(axis=0)
        off = offsets - middle
        squares = (off * off).sum(axis=0) / _ON_WALL_M**2
        squares[np.isnan(squares)] = np.inf
        squares[np.abs(off).max(axis=0) > _MOST_OFF_M] = np.inf
        for k in group:  # add the contact's own measurement of the direction
            one = self._touches[k]
            if one.normal_rad is None:
                continue
            oblique = abs(wrap_angle(one.normal_rad - one.heading_rad - math.pi))
            sd = max(one.sd_rad, math.radians(1.5)) + (0.5 * oblique if oblique > _OBLIQUE_RAD else 0.0)
            away = (self._angles - one.normal_rad + math.pi) % (2.0 * math.pi) - math.pi
            squares = squares + np.minimum((away / sd) ** 2, 9.0)
        best = int(np.argmin(squares))
        return float(squares[best]), best, float(middle[best])

    def _wall(self, group: list[int]) -> RoomWall:
        _, i, offset = self._misfit(group)
        touches = tuple(self._touches[k] for k in group)
        along = np.array([-math.sin(self._angles[i]), math.cos(self._angles[i])])
        places = np.array([t.place for t in touches]) @ along
        spread = float(((places - places.mean()) ** 2).sum())
        sds = [t.sd_rad for t in touches if t.normal_rad is not None]
        weight = spread / _ON_WALL_M**2 + sum_in_order(1.0 / max(sd, math.radians(1.5)) ** 2 for sd in sds)
        sd_rad = 1.0 / math.sqrt(weight) if weight > 0.0 else math.radians(20.0)
        return RoomWall(float(self._angles[i]), offset, _ON_WALL_M / math.sqrt(len(group)), sd_rad, touches)

    def _closed(self, walls: list[RoomWall]) -> Room:
        corners: list[Vec2 | None] = []
        gaps: list[float] = []
        for k, wall in enumerate(walls):
            following = walls[(k + 1) % len(walls)]
            here, there = self._bearing(wall.touches[-1].place), self._bearing(following.touches[0].place)
            apart = (there - here) % (2.0 * math.pi)
            corner = _crossing(wall, following) if len(walls) > 2 else None
            if corner is not None:
                at = (self._bearing(corner) - here) % (2.0 * math.pi)
                if not (at <= apart + math.radians(4.0) or at >= 2.0 * math.pi - math.radians(4.0)):
                    corner = None
            corners.append(corner)
            if corner is None:
                gaps.append(here + 0.5 * apart)
            if len(wall.touches) == 1:
                only = self._bearing(wall.touches[0].place)
                gaps += [only - _STEP_RAD, only + _STEP_RAD]
        return Room(walls, corners, [wrap_angle(angle) for angle in gaps])


def _crossing(a: RoomWall, b: RoomWall) -> Vec2 | None:
    (ax, ay), (bx, by) = a.normal, b.normal
    det = ax * by - ay * bx
    if abs(det) < math.sin(math.radians(8.0)):
        return None
    return ((a.offset_m * by - b.offset_m * ay) / det, (ax * b.offset_m - bx * a.offset_m) / det)


def contacts_from_walls(walls: Sequence[Any], directions_rad: Sequence[float]) -> list[RoomContact]:
    """Return the contacts of a flight along the probes of `plan_star`; `walls` are `MeasuredWall`s."""
    found = []
    for wall in walls:
        heading = directions_rad[int(wall.name.rpartition(" ")[2]) - 1]
        normal_rad = None if wall.yaw_sd_deg is None else math.atan2(wall.normal[1], wall.normal[0])
        sd_rad = math.inf if wall.yaw_sd_deg is None else math.radians(wall.yaw_sd_deg)
        found.append(RoomContact(wall.touched_m or wall.point_m, heading, normal_rad, sd_rad))
    return found


def room_keys(room: Room, material: str) -> dict[str, dict[str, Any]]:
    """Return a mission file's keys for each wall of a closed room, by wall name."""
    found = {}
    for k, wall in enumerate(room.walls):
        (ax, ay), (bx, by) = room.corners[k - 1] or (0.0, 0.0), room.corners[k] or (0.0, 0.0)
        found[f"side {k + 1}"] = {
            "point_m": [round(0.5 * (ax + bx), 4), round(0.5 * (ay + by), 4)],
            "normal": [round(v, 6) for v in wall.normal],
            "length_m": round(math.hypot(bx - ax, by - ay), 4),
            "material": material,
            "given_at": "surface",
            "position_sd_m": round(wall.offset_sd_m, 4),
            "yaw_sd_deg": round(min(30.0, math.degrees(wall.normal_sd_rad)), 3),
        }
    return found
