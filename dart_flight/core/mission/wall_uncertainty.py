"""Where a wall may really stand, and what follows for a flight to it (docs/walls.md).

A wall may carry standard deviations of its place and direction. What flies at it reckons with three of them
beside the tolerances of `guard:`, which are the floor for walls that carry none.
"""

from __future__ import annotations

import msgspec

from dart_flight.base.geometry import Vec2, Vec3, wrap_angle
from dart_flight.base.records import WallEstimate
from dart_flight.base.walls import Wall
from dart_flight.config.vehicle.flying import GuardThresholds
from dart_flight.core.mission.arithmetic import Number

SURE_SD = 3.0  # standard deviations that are reckoned with
_MIN_CLOSING_M_S = 0.1
_SQUARE_RAD = 0.17  # heading against the planned wall; what is felt at more is not the wall's direction


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
    """The walls of a mission as its contacts have found them: one answer for core and planner."""

    def __init__(self) -> None:
        self._felt: dict[str, WallEstimate] = {}
        self._turned: dict[str, float] = {}

    def add_estimate(self, felt: WallEstimate) -> None:
        """Take where a contact has found its wall's plane."""
        self._felt[felt.wall] = felt

    def add_direction(self, wall: Wall, yaw: float, felt: WallEstimate) -> None:
        """Take how a wall that was met at a heading (rad, mission frame) was felt to be turned."""
        off = wrap_angle(yaw - wall.parallel_yaw(yaw))
        if abs(off) < _SQUARE_RAD:
            self._turned[wall.name] = wrap_angle(off - felt.incidence_rad)

    def turned(self, wall: Wall) -> float:
        """By how much a wall is turned against the mission's, rad; positive: to the left."""
        return self._turned.get(wall.name, 0.0)

    def wall_now(self, wall: Wall) -> Wall:
        """A wall where it was met last, and as surely as that contact told; as the mission has it before."""
        felt = self._felt.get(wall.name)
        if felt is None:
            return wall
        sure = wall.position_sd_m
        if sure is not None:
            wall = msgspec.structs.replace(wall, position_sd_m=min(sure, felt.plane_offset_sigma_m))
        return wall.moved(felt.plane_offset_m)
