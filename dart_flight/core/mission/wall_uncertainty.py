"""Where a wall may really stand, and what follows for a flight to it (docs/walls.md).

A wall may carry standard deviations of its place and direction. What flies at it reckons with three of them
beside the tolerances of `guard:`, which are the floor for walls that carry none.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import msgspec

from dart_flight.base.geometry import Vec2, Vec3, turn_between
from dart_flight.base.records import WallEstimate
from dart_flight.base.walls import Wall
from dart_flight.config.vehicle.flying import GuardThresholds
from dart_flight.core.mission.anchors import FrameAnchors
from dart_flight.core.mission.arithmetic import Number

SURE_SD = 3.0  # standard deviations that are reckoned with
_MIN_CLOSING_M_S = 0.1
_SURE_DIRECTION_RAD = 0.05  # a direction that was felt less surely turns no heading


def position_margin_m(wall: Wall, place: tuple[Number, ...]) -> Number:
    """How far nearer or further away than the plan the plane may be met, metres; 0 without figures.

    Args:
        wall: the wall.
        place: mission frame; numbers, or arrays of them.
    """
    return SURE_SD * wall.plane_sd_m(place)


def end_margin_m(wall: Wall, place: tuple[Number, ...]) -> Number:
    """What a hit keeps from the wall's end, and a path that passes it from its other side, metres.

    Half a vehicle, and what the wall's place leaves open.
    """
    return wall.half_vehicle_m + position_margin_m(wall, place)


def overrun_m(guard: GuardThresholds, wall: Wall, place: Vec2 | Vec3) -> float:
    """How far behind the plane there must have been a contact."""
    return float(guard.wall_overrun_m + position_margin_m(wall, place))


def early_m(guard: GuardThresholds, wall: Wall, place: Vec2 | Vec3) -> float:
    """How far before the plane a contact may be that with the wall."""
    return float(guard.wall_early_m + position_margin_m(wall, place))


def late_s(guard: GuardThresholds, wall: Wall, place: Vec2 | Vec3, closing_m_s: float) -> float:
    """How long after the planned impact the wall must have been met, closing in at a speed (positive)."""
    return float(guard.wall_late_s + position_margin_m(wall, place) / max(closing_m_s, _MIN_CLOSING_M_S))


class EstimatedWalls:
    """The walls of a mission as its contacts have found them: one answer for core and planner.

    Args:
        anchors: where contacts put the mission frame right: how well it is known adds to every wall's place.
    """

    def __init__(self, anchors: FrameAnchors | None = None) -> None:
        self._anchors = anchors
        self._found: dict[str, Wall] = {}
        self._turned: dict[str, float] = {}

    def add_estimate(self, felt: WallEstimate, wall: Wall) -> None:
        """Take where a contact has found its wall's plane; `wall` is as the mission has it."""
        self._found[wall.name] = _as_felt(self._found.get(wall.name, wall), wall, felt)
        sure = (felt.plane_normal_sigma_rad or math.inf) < _SURE_DIRECTION_RAD
        if felt.plane_normal_mission is not None and sure:
            self._turned[wall.name] = turn_between(wall.normal, felt.plane_normal_mission)

    def turned(self, wall: Wall) -> float:
        """By how much a wall was felt to be turned against the mission's, rad; positive: to the left."""
        return self._turned.get(wall.name, 0.0)

    def is_met(self, name: str) -> bool:
        """Whether a contact has told where a wall is."""
        return name in self._found

    def move_frame(self, by: Vec2) -> None:
        """The mission frame's origin has moved, in its axes: the walls that were met stay where they are."""
        for name, wall in self._found.items():
            self._found[name] = wall.moved(-(by[0] * wall.normal[0] + by[1] * wall.normal[1]))

    def walls_now(self, walls: Iterable[Wall], now_us: int) -> tuple[Wall, ...]:
        """The walls of a mission, and those that probes have found."""
        known = {wall.name: wall for wall in walls}
        return tuple(self.wall_now(wall, now_us) for wall in (known | self._found).values())

    def wall_now(self, wall: Wall, now_us: int | None = None) -> Wall:
        """A wall where it was met last, and as surely as that contact told; as the mission has it before.

        Args:
            wall: as the mission has it.
            now_us: autopilot time: where the frame drifts the wall's place is the less sure the later.
        """
        wall = self._found.get(wall.name, wall)
        if self._anchors is None or now_us is None:
            return wall
        sd_m = math.hypot(wall.position_sd_m or 0.0, self._anchors.sd_m(wall.normal, now_us))
        return msgspec.structs.replace(wall, position_sd_m=sd_m)


def _as_felt(before: Wall, written: Wall, felt: WallEstimate) -> Wall:
    """A wall by what was known of it before a contact, by the mission, and by the contact."""
    sure_m, place, normal = felt.plane_offset_sigma_m, felt.plane_point_mission, felt.plane_normal_mission
    figures = written.position_sd_m is not None or written.yaw_sd_rad is not None
    if place is None or normal is None:  # against where it was taken to be
        sd_m = None if written.position_sd_m is None else min(written.position_sd_m, sure_m)
        return msgspec.structs.replace(before.moved(felt.plane_offset_m), position_sd_m=sd_m)
    if not (figures or written.sought):  # against the mission's plane, whose direction is taken as known
        return written.moved(written.signed_distance(place))
    sure_rad = felt.plane_normal_sigma_rad
    if written.yaw_sd_rad is None:  # its direction is taken as known
        normal, sure_rad = written.normal, None
    found = msgspec.structs.replace(before, normal=normal, sought=False)
    if before.sought:  # its middle is where it was met
        middle = place
    else:
        along, (tx, ty) = before.along(place), found.tangent
        middle = (place[0] - along * tx, place[1] - along * ty)
        sure_m = math.hypot(sure_m, along * math.tan(sure_rad or 0.0))
    if felt.material is not None:
        found = msgspec.structs.replace(found, material=felt.material, material_known=True)
    return msgspec.structs.replace(found, point=middle, position_sd_m=sure_m, yaw_sd_rad=sure_rad)
