"""The possible positions of a wall, and their consequences for a flight to it (docs/walls.md).

A wall may have standard deviations of its position and direction. An approach allows for three standard
deviations, in addition to the tolerances of `guard:`. The tolerances also apply to walls without standard
deviations.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import msgspec

from dart_flight.base.arithmetic import Number
from dart_flight.base.geometry import Vec2, Vec3, angle_between
from dart_flight.base.records import WallEstimate
from dart_flight.base.walls import Wall
from dart_flight.config.vehicle.flying import GuardThresholds
from dart_flight.core.mission.anchors import FrameAnchors

SURE_SD = 3.0  # approaches stay clear of a wall at up to this many standard deviations
_MIN_CLOSING_M_S = 0.1
_SURE_DIRECTION_RAD = 0.05  # a less certain estimate of a wall's direction does not change the heading


def position_margin_m(wall: Wall, place: tuple[Number, ...]) -> Number:
    """Return the tolerance of the wall plane's position, for the point of the plane nearest to `place`.

    The tolerance is 0 if the wall has no standard deviations. `place` is in the mission frame.
    """
    return SURE_SD * wall.plane_sd_m(place)


def end_margin_m(wall: Wall, place: tuple[Number, ...]) -> Number:
    """Return the distance to keep from the wall's end.

    An impact must lie at least this far inside the wall's end. A path that passes the wall must stay at least
    this far outside the end. The distance is half the vehicle's width plus the tolerance of the wall's
    position.
    """
    return wall.half_vehicle_m + position_margin_m(wall, place)


def spans_with_margin(wall: Wall, place: tuple[Number, ...]) -> Number:
    """Return whether a wall, lengthened by `end_margin_m` at each end, spans a place."""
    return wall.end_distance_m(place) >= -end_margin_m(wall, place)


def overrun_m(guard: GuardThresholds, wall: Wall, place: Vec2 | Vec3) -> float:
    """Return how far behind the plane the vehicle is when a contact becomes overdue."""
    return float(guard.wall_overrun_m + position_margin_m(wall, place))


def early_m(guard: GuardThresholds, wall: Wall, place: Vec2 | Vec3) -> float:
    """Return how far before the plane a contact already counts as a contact with the wall."""
    return float(guard.wall_early_m + position_margin_m(wall, place))


def late_s(guard: GuardThresholds, wall: Wall, place: Vec2 | Vec3, closing_m_s: float) -> float:
    """Return how long after the planned impact a contact becomes overdue.

    The closing speed is positive towards the wall; at least 0.1 m/s is assumed.
    """
    return float(guard.wall_late_s + position_margin_m(wall, place) / max(closing_m_s, _MIN_CLOSING_M_S))


class EstimatedWalls:
    """Estimator of a mission's walls from the contacts of the flight; core and planner use the same class.

    If `anchors` correct the mission frame, the frame's standard deviation is added to that of every wall.
    """

    def __init__(self, anchors: FrameAnchors | None = None) -> None:
        self._anchors = anchors
        self._found: dict[str, Wall] = {}
        self._turned: dict[str, float] = {}

    def add_estimate(self, estimate: WallEstimate, wall: Wall) -> None:
        """Add a contact's estimate of a wall's plane; `wall` is the wall as the mission defines it."""
        self._found[wall.name] = _updated_wall(self._found.get(wall.name, wall), wall, estimate)
        sure = (estimate.plane_normal_sigma_rad or math.inf) < _SURE_DIRECTION_RAD
        if estimate.plane_normal_mission is not None and sure:
            self._turned[wall.name] = angle_between(wall.normal, estimate.plane_normal_mission)

    def rotation(self, wall: Wall) -> float:
        """Return the rotation from the mission's wall to the estimated wall, rad, counter-clockwise."""
        return self._turned.get(wall.name, 0.0)

    def is_measured(self, name: str) -> bool:
        return name in self._found

    def move_frame(self, by: Vec2) -> None:
        """Keep the measured walls in place when the frame's origin moves by a vector, in frame axes."""
        for name, wall in self._found.items():
            self._found[name] = wall.displaced(-(by[0] * wall.normal[0] + by[1] * wall.normal[1]))

    def known_walls(self, walls: Iterable[Wall], now_us: int) -> tuple[Wall, ...]:
        """Return the mission's walls and the walls that probes have found, at their estimated positions."""
        known = {wall.name: wall for wall in walls}
        return tuple(self.known_wall(wall, now_us) for wall in (known | self._found).values())

    def known_wall(self, wall: Wall, now_us: int | None = None) -> Wall:
        """Return the newest estimate of a wall; before the first contact, return the mission's wall.

        If the frame drifts, the standard deviation grows with time. If `now_us` is None, the frame's standard
        deviation is left out.
        """
        wall = self._found.get(wall.name, wall)
        if self._anchors is None or now_us is None:
            return wall
        sd_m = math.hypot(wall.position_sd_m or 0.0, self._anchors.sd_m(wall.normal, now_us))
        return msgspec.structs.replace(wall, position_sd_m=sd_m)


def _updated_wall(before: Wall, written: Wall, estimate: WallEstimate) -> Wall:
    """Return the new estimate of a wall after a contact.

    `before` is the previous estimate, `written` the wall as the mission defines it.
    """
    sure_m, place, normal = (
        estimate.plane_offset_sigma_m,
        estimate.plane_point_mission,
        estimate.plane_normal_mission,
    )
    figures = written.position_sd_m is not None or written.yaw_sd_rad is not None
    if place is None or normal is None:  # the contact gives only the plane's offset
        sd_m = None if written.position_sd_m is None else min(written.position_sd_m, sure_m)
        return msgspec.structs.replace(before.displaced(estimate.plane_offset_m), position_sd_m=sd_m)
    if not (figures or written.sought):  # shift the mission's plane; the plane's direction is assumed exact
        return written.displaced(written.signed_distance(place))
    sure_rad = estimate.plane_normal_sigma_rad
    if written.yaw_sd_rad is None:  # the wall's direction is assumed exact
        normal, sure_rad = written.normal, None
    found = msgspec.structs.replace(before, normal=normal, sought=False)
    if before.sought:  # a probe found the wall: the contact becomes the wall's middle
        middle = place
    else:
        along, (tx, ty) = before.along(place), found.tangent
        middle = (place[0] - along * tx, place[1] - along * ty)
        sure_m = math.hypot(sure_m, along * math.tan(sure_rad or 0.0))
    if estimate.material is not None:
        found = msgspec.structs.replace(found, material=estimate.material, material_known=True)
    return msgspec.structs.replace(found, point=middle, position_sd_m=sure_m, yaw_sd_rad=sure_rad)
