"""The check of a connected vehicle's place in the mission's frame.

Before take-off, the operator checks that the reported place agrees with the vehicle's place in the room.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

from dart_flight.base.geometry import MissionFrame, Quaternion, Vec2, Vec3, wrap_angle, wrap_deg, yaw_ned_of
from dart_flight.check.findings import CheckFinding
from dart_flight.config.mission import Mission
from dart_flight.core.mission.anchors import START_SD_M
from dart_flight.core.mission.approach import is_blocked, is_blocked_by_post

START_TOLERANCE_M: Final = 1.0  # maximum distance between a vehicle placed by hand and the mission's start
_FITS_DEG, _MISFITS_DEG = 15.0, 30.0  # maximum error of a correct heading, minimum error of a wrong heading
_NEAR_RAD: Final = 0.01  # tolerance for rounded values such as 1.57 and 3.14
_SIDES: Final = ("ahead", "right", "behind", "left")


def check_heading(mission: Mission) -> list[CheckFinding]:
    """Return a remark if `frame.heading_deg` looks like an angle in radians."""
    given = mission.frame.heading_deg
    eighths = round(given / (0.25 * math.pi))
    if eighths == 0 or abs(eighths) > 8 or abs(given - eighths * 0.25 * math.pi) > _NEAR_RAD:
        return []
    message = (
        f"frame.heading_deg {given:g} looks like radians ({given:g} rad is {45 * eighths} deg): give degrees"
    )
    return [CheckFinding("heading", True, message, remark=True)]


def evaluate_place(
    mission: Mission, position_ned: Vec3 | None, q_frd_to_ned: Quaternion | None
) -> list[CheckFinding]:
    """Check the vehicle's distance from start, its surroundings and its heading, before take-off."""
    if position_ned is None or q_frd_to_ned is None:
        return []
    frame = mission.frame_at(position_ned)
    x, y, _ = frame.point_from_ned(position_ned)
    place, yaw_ned = (x, y), yaw_ned_of(q_frd_to_ned)
    off_m = math.dist(place, mission.start)
    heading_deg = math.degrees(yaw_ned) % 360.0
    figures = {"x_m": x, "y_m": y, "heading_deg": heading_deg, "start_offset_m": off_m}
    message = f"vehicle at ({x:.2f}, {y:.2f}) in the mission's frame, {off_m:.2f} m from start, "
    message += f"heading {round(heading_deg) % 360} deg"
    for name, distance_m, bearing_deg, side in _surroundings(mission, frame, place, yaw_ned):
        message += f"; {name} {distance_m:.2f} m at {round(bearing_deg) % 360} deg ({side})"
        figures |= {f"{name}_distance_m": distance_m, f"{name}_bearing_deg": bearing_deg}
    wrong = list(_departure_problems(mission, place, off_m))
    if wrong:
        message = f"{'; '.join(wrong)}: check frame, normals and the vehicle's position. {message}"
    behind = list(_walls_facing_away(mission, place))
    if behind:
        message += (
            f"; the vehicle is behind the face of wall {', '.join(behind)}: check the sign of its normal"
        )
    doubtful = not wrong and (off_m > START_SD_M or bool(behind))
    return [
        CheckFinding("place", not wrong, message, remark=doubtful, figures=figures),
        *_evaluate_heading(mission, heading_deg),
    ]


def _surroundings(
    mission: Mission, frame: MissionFrame, place: Vec2, yaw_ned: float
) -> Iterator[tuple[str, float, float, str]]:
    """Yield name, distance (m), bearing (deg) and side (ahead, right, behind, left) of each wall and post.

    The hidden face of a partition is left out. Distances are measured to the surface, so that the operator
    can compare them with a tape measure. A wrong distance reveals that `given_at: surface` is missing in the
    mission.
    """
    to_surface_m = mission.vehicle.airframe.contact_distance_m
    points = [
        (f"wall {wall.name}", wall.displaced(-to_surface_m).foot(place), 0.0)
        for wall in mission.walls
        if not wall.sought and not wall.post_radius_m and wall.signed_distance(place) > -wall.behind_m
    ]
    points += [(f"post {post.name}", post.centre, post.radius_m) for post in mission.posts]
    for name, point, radius_m in points:
        dx, dy = point[0] - place[0], point[1] - place[1]
        bearing = frame.yaw_to_ned(math.atan2(dy, dx))
        side = _SIDES[round(wrap_angle(bearing - yaw_ned) / (0.5 * math.pi)) % 4]
        yield name, math.hypot(dx, dy) - radius_m, math.degrees(bearing) % 360.0, side


def _departure_problems(mission: Mission, place: Vec2, off_m: float) -> Iterator[str]:
    excess_m = mission.bounds.excess2(place)
    if excess_m > 0.0:
        yield f"the vehicle is {excess_m:.2f} m outside bounds_m"
    if off_m > START_TOLERANCE_M:
        yield f"the vehicle is {off_m:.2f} m from start, limit {START_TOLERANCE_M:g} m"
    for wall in mission.walls:
        if not wall.sought and is_blocked(wall, place, mission.start):
            behind = wall.signed_distance(place) < 0.0 < wall.signed_distance(mission.start)
            if behind:
                yield f"the vehicle is behind wall {wall.name}"
            else:
                yield f"wall {wall.name} is too near the vehicle or between the vehicle and start"
    for post in mission.posts:
        if is_blocked_by_post(mission, post, place, mission.start):
            yield f"post {post.name} is between the vehicle and start"


def _walls_facing_away(mission: Mission, place: Vec2) -> Iterator[str]:
    """Yield the names of the walls whose back faces the vehicle; omit walls that are hit only later."""
    later = {collision.wall.name for collision in mission.collisions[1:]}
    for wall in mission.walls:
        if wall.name not in later and wall.spans(place) and -wall.behind_m <= wall.signed_distance(place) < 0:
            yield wall.name


def _evaluate_heading(mission: Mission, heading_deg: float) -> Iterator[CheckFinding]:
    given = mission.frame.heading_deg
    in_radians = math.degrees(given)
    if 0.0 < abs(given) <= 2.0 * math.pi and (
        abs(wrap_deg(heading_deg - in_radians)) < _FITS_DEG
        and abs(wrap_deg(heading_deg - given)) > _MISFITS_DEG
    ):
        message = (
            f"frame.heading_deg {given:g} looks like radians: the vehicle's heading is {heading_deg:.0f} "
        )
        message += f"deg, and {given:g} rad is {in_radians % 360.0:.0f} deg; give degrees"
        yield CheckFinding("heading", False, message)
