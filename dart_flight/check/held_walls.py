"""Measurement of a wall: a person holds the vehicle against the wall's left end, then its right end.

While both guards of a side touch the wall, the vehicle's centre is as far from the wall as at the first touch
in flight. Left and right are as seen by a person facing the wall.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from dart_flight.base.geometry import MissionFrame, Quaternion, Vec2, Vec3, tilt_of, wrap_angle, yaw_ned_of
from dart_flight.base.walls import Wall
from dart_flight.config.document import InputError
from dart_flight.config.vehicle import Airframe

SAMPLE_S: Final = 2.0  # duration of a measurement at one end
_FEWEST: Final = 20  # minimum number of poses in one measurement
_TRACKED: Final = 0.9  # minimum fraction of poses in which the body is tracked
_MOVED_M: Final = 0.02  # maximum distance of a pose from the mean pose
_TURNED_RAD: Final = math.radians(3.0)
_TILT_RAD: Final = math.radians(6.0)
_FLAT_RAD: Final = math.radians(12.0)  # largest angle between the wall and the side that touches it
_NEAREST_ENDS_M: Final = 0.3
_HAND_M: Final = 0.01  # standard deviation of the distance between the guards and the wall
_QUARTER: Final = 0.5 * math.pi

Pose = tuple[Vec3, Quaternion]  # position NED, m, and attitude FRD to NED


class HeldPose(NamedTuple):
    """The mean pose of a vehicle that is held still, mission frame.

    Attributes:
        scatter_m: root mean square distance of the poses from the mean.
    """

    at: Vec2
    yaw_rad: float
    scatter_m: float


def mean_pose(poses: Sequence[Pose | None], frame: MissionFrame) -> HeldPose:
    """Return the mean pose of a measurement; a None in `poses` is a pose without a tracked body.

    Raises:
        InputError: the vehicle was lost, has moved or was not level.
    """
    known = [pose for pose in poses if pose is not None]
    if len(known) < max(_FEWEST, _TRACKED * len(poses)):
        raise InputError(
            f"only {len(known)} of {len(poses)} poses show the vehicle: check markers and cameras"
        )
    tilt = max(tilt_of(q) for _, q in known)
    if tilt > _TILT_RAD:
        raise InputError(
            f"the vehicle is tilted by {math.degrees(tilt):.0f}°, limit {math.degrees(_TILT_RAD):.0f}°: "
            "hold it level"
        )
    places = np.array([frame.point_from_ned(position)[:2] for position, _ in known])
    x, y = places.mean(axis=0).tolist()
    away = np.hypot(places[:, 0] - x, places[:, 1] - y)
    yaws = [frame.yaw_from_ned(yaw_ned_of(q)) for _, q in known]
    turns = np.array([wrap_angle(yaw - yaws[0]) for yaw in yaws])
    turned = float(np.abs(turns - turns.mean()).max())
    if away.max() > _MOVED_M or turned > _TURNED_RAD:
        raise InputError(
            f"the vehicle has moved by {100.0 * away.max():.1f} cm and {math.degrees(turned):.1f}°, limits "
            f"{100.0 * _MOVED_M:g} cm and {math.degrees(_TURNED_RAD):.0f}°: hold it still"
        )
    yaw = wrap_angle(yaws[0] + float(turns.mean()))
    return HeldPose((x, y), yaw, math.sqrt(float(np.mean(away**2))))


def wall_keys(left: HeldPose, right: HeldPose, airframe: Airframe, free: Vec2 | None) -> dict[str, Any]:
    """Return the measured keys of a wall for a mission file.

    `free` is a point in front of the wall, such as the mission's start, or None if unknown.

    Raises:
        InputError: the ends are too close or exchanged, or the vehicle did not touch the wall with a side.
    """
    (lx, ly), (rx, ry) = left.at, right.at
    apart = math.hypot(rx - lx, ry - ly)
    if apart < _NEAREST_ENDS_M:
        raise InputError(f"the two ends are {apart:.2f} m apart, at least {_NEAREST_ENDS_M:g} m are needed")
    # A person who faces the wall looks against its normal, and sees the left end on the left.
    normal = ((ry - ly) / apart, -(rx - lx) / apart)
    middle = (0.5 * (lx + rx), 0.5 * (ly + ry))
    if free is not None and (free[0] - middle[0]) * normal[0] + (free[1] - middle[1]) * normal[1] <= 0.0:
        raise InputError("the mission's start would be behind this wall: were left and right exchanged?")
    facing = math.atan2(-normal[1], -normal[0])
    for name, held in (("left", left), ("right", right)):
        off = wrap_angle(held.yaw_rad - facing)
        off -= _QUARTER * round(off / _QUARTER)
        if abs(off) > _FLAT_RAD:
            raise InputError(
                f"at the {name} end, the side of the vehicle is at {math.degrees(abs(off)):.0f}° to the "
                f"wall, limit {math.degrees(_FLAT_RAD):.0f}°: hold both guards of a side against the wall"
            )
    sds = [math.hypot(held.scatter_m, _HAND_M) for held in (left, right)]
    return {
        "point_m": [round(v, 4) for v in middle],
        "normal": [round(v, 5) for v in normal],
        "length_m": round(apart + 2.0 * airframe.guard_along_m, 3),
        "given_at": "centre",
        "position_sd_m": round(0.5 * math.hypot(*sds), 4),
        "yaw_sd_deg": round(math.degrees(math.hypot(*sds) / apart), 2),
    }


def difference_from(wall: Wall, measured: Mapping[str, Any]) -> str:
    """Describe how far a measured wall is from a wall of the file: `3.1 cm and 1.2° from the file`."""
    distance_m = abs(wall.signed_distance((measured["point_m"][0], measured["point_m"][1])))
    nx, ny = measured["normal"]
    turned = wrap_angle(math.atan2(ny, nx) - math.atan2(wall.normal[1], wall.normal[0]))
    return f"{100.0 * distance_m:.1f} cm and {math.degrees(abs(turned)):.1f}° from the file"
