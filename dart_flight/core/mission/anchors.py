"""How well the mission frame is known where PX4's position drifts: contacts with walls put it right.

A contact tells the place of its wall to a centimetre or two, along the wall's normal and nowhere else. Since
then the position is carried by PX4's velocity, so its standard deviation grows with the age of the contact,
in proportion: what drifts is a velocity's bias (docs/anchors.md).

    information = sum over anchors n n' / (s^2 + (drift age)^2),    sd along n = sqrt(n' information^-1 n)

The start is an anchor in every direction: the vehicle was put down there.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from dart_flight.base.geometry import Vec2
from dart_flight.base.records import FrameAnchor, WallEstimate
from dart_flight.base.walls import Wall

START_SD_M: Final = 0.3  # how well the vehicle stands where the mission has its start
WALL_SD_M: Final = 0.02  # of a wall that carries no figure, as it is taken to be surveyed
_SAME_NORMAL: Final = 0.98  # cosine: an anchor in nearly this direction takes the place of the one before


class Anchor(NamedTuple):
    """One contact: the wall's normal (mission frame), when it was (autopilot time), how well it told."""

    normal: Vec2
    t_us: int
    sd_m: float


def has_same_normal(a: Vec2, b: Vec2) -> bool:
    """Whether two unit normals are nearly parallel, of either sign: a contact with one anchors the other."""
    return abs(a[0] * b[0] + a[1] * b[1]) >= _SAME_NORMAL


class FrameAnchors:
    """The anchors of one flight.

    Args:
        drift_m_s: standard deviation of the velocity that carries the position.
        start_us: when the frame was laid at the start.
    """

    def __init__(self, drift_m_s: float, start_us: int = 0) -> None:
        self._drift_m_s = drift_m_s
        self._start_us = start_us
        self._anchors: list[Anchor] = []

    def begin(self, t_us: int) -> None:
        """The vehicle leaves the ground at its start."""
        self._start_us = t_us

    def add(self, anchor: Anchor) -> None:
        """A contact has told where the frame is along a normal."""
        self._anchors = [one for one in self._anchors if not has_same_normal(one.normal, anchor.normal)]
        self._anchors.append(anchor)

    def take(self, wall: Wall, felt: WallEstimate, now_us: int) -> FrameAnchor:
        """A contact has told where a wall stands: by how much that moves the frame, along the wall's normal.

        The difference between where it was met and where it was taken to be is shared by the frame and the
        wall as their variances are.

        Args:
            wall: as it was known before the contact.
            felt: by the contact.
            now_us: when the frame moves.
        """
        told_sd, place = felt.plane_offset_sigma_m, felt.plane_point_mission
        wall_sd = WALL_SD_M if wall.position_sd_m is None else wall.position_sd_m
        expected = self.sd_m(wall.normal, felt.t_us)
        gain = expected**2 / (expected**2 + wall_sd**2 + told_sd**2)
        moved = gain * (felt.plane_offset_m if place is None else wall.signed_distance(place))
        age_s, sd = self.age_s(wall.normal, felt.t_us), expected * math.sqrt(1.0 - gain)
        self.add(Anchor(wall.normal, felt.t_us, sd))
        by = (moved * wall.normal[0], moved * wall.normal[1])
        return FrameAnchor(now_us, wall.name, by, expected, sd, age_s, wall.normal, felt.t_us, self._start_us)

    def follow(self, taken: FrameAnchor) -> None:
        """Know what another of the same flight has taken: the planner's process follows the core."""
        self.begin(taken.start_us)
        self.add(Anchor(taken.normal, taken.felt_us, taken.sd_m))

    def age_s(self, normal: Vec2, now_us: int) -> float | None:
        """Time since the last contact with a wall of (nearly) this normal; None: there was none."""
        for one in self._anchors:
            if has_same_normal(one.normal, normal):
                return (now_us - one.t_us) * 1e-6
        return None

    def sd_m(self, normal: Vec2, now_us: int) -> float:
        """Standard deviation of the frame's place along a normal now, metres."""
        start = 1.0 / self._variance(START_SD_M, self._start_us, now_us)
        xx = yy = start
        xy = 0.0
        for (nx, ny), t_us, sd in self._anchors:
            weight = 1.0 / self._variance(sd, t_us, now_us)
            xx, xy, yy = xx + weight * nx * nx, xy + weight * nx * ny, yy + weight * ny * ny
        nx, ny = normal
        return math.sqrt((yy * nx * nx - 2.0 * xy * nx * ny + xx * ny * ny) / (xx * yy - xy * xy))

    def _variance(self, sd_m: float, t_us: int, now_us: int) -> float:
        drifted_m = self._drift_m_s * max(0, now_us - t_us) * 1e-6
        return sd_m * sd_m + drifted_m * drifted_m
