"""Accuracy of the mission frame when PX4's position drifts, and the frame's correction by contacts.

A contact is an *anchor*: the contact measures the position of the wall along the wall's normal, with an error
of 1 to 2 cm. After the contact PX4 integrates its velocity, so the position drifts. The velocity error is
nearly constant, so the standard deviation of the drift grows in proportion to the age of the contact
(docs/anchors.md).

    information = sum over anchors n n' / (s^2 + (drift age)^2),    sd along n = sqrt(n' information^-1 n)

Here n is a wall's normal, s is the standard deviation of the measured wall position, and drift is the
standard deviation of the velocity error. The start is an anchor in every direction, because the vehicle was
placed there.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from dart_flight.base.geometry import Vec2
from dart_flight.base.records import FrameAnchor, WallEstimate
from dart_flight.base.walls import Wall

START_SD_M: Final = 0.3  # standard deviation with which people place the vehicle at the mission's start
WALL_SD_M: Final = 0.02  # standard deviation of a surveyed wall if none is configured
_SAME_NORMAL: Final = 0.98  # two normals count as one direction if their cosine is larger


class Anchor(NamedTuple):
    """One contact: wall's normal (mission frame), autopilot time, standard deviation of the measurement."""

    normal: Vec2
    t_us: int
    sd_m: float


def has_same_normal(a: Vec2, b: Vec2) -> bool:
    """Return whether two unit normals are nearly parallel or opposite, and so share one anchor."""
    return abs(a[0] * b[0] + a[1] * b[1]) >= _SAME_NORMAL


class FrameAnchors:
    """The anchors of one flight.

    Args:
        drift_m_s: standard deviation of PX4's velocity error, which makes PX4's position drift.
        start_us: time at which the frame was first set.
    """

    def __init__(self, drift_m_s: float, start_us: int = 0) -> None:
        self._drift_m_s = drift_m_s
        self._start_us = start_us
        self._anchors: list[Anchor] = []

    def begin(self, t_us: int) -> None:
        self._start_us = t_us

    def add(self, anchor: Anchor) -> None:
        self._anchors = [one for one in self._anchors if not has_same_normal(one.normal, anchor.normal)]
        self._anchors.append(anchor)

    def correct_frame(self, wall: Wall, estimate: WallEstimate, now_us: int) -> FrameAnchor:
        """Add the anchor of a contact, and return the frame's correction along the wall's normal.

        The difference between measured and assumed wall is divided between frame and wall in proportion to
        their variances. `wall` is the wall assumed before the contact.
        """
        measured_sd, place = estimate.plane_offset_sigma_m, estimate.plane_point_mission
        wall_sd = WALL_SD_M if wall.position_sd_m is None else wall.position_sd_m
        expected = self.sd_m(wall.normal, estimate.t_us)
        gain = expected**2 / (expected**2 + wall_sd**2 + measured_sd**2)
        moved = gain * (estimate.plane_offset_m if place is None else wall.signed_distance(place))
        age_s, sd = self.age_s(wall.normal, estimate.t_us), expected * math.sqrt(1.0 - gain)
        self.add(Anchor(wall.normal, estimate.t_us, sd))
        by = (moved * wall.normal[0], moved * wall.normal[1])
        return FrameAnchor(
            now_us, wall.name, by, expected, sd, age_s, wall.normal, estimate.t_us, self._start_us
        )

    def add_recorded(self, recorded: FrameAnchor) -> None:
        """Add an anchor that the core recorded; the planner's process calls this function."""
        self.begin(recorded.start_us)
        self.add(Anchor(recorded.normal, recorded.felt_us, recorded.sd_m))

    def age_s(self, normal: Vec2, now_us: int) -> float | None:
        """Return the time since the last contact with a wall with (nearly) this normal, or None."""
        for one in self._anchors:
            if has_same_normal(one.normal, normal):
                return (now_us - one.t_us) * 1e-6
        return None

    def sd_m(self, normal: Vec2, now_us: int) -> float:
        """Return the standard deviation of the frame's position along a normal."""
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
