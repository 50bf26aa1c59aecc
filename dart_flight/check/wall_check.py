"""The check that a mission tolerates the standard deviations of its walls' positions and directions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping

from dart_flight.base.geometry import Vec2
from dart_flight.base.walls import Wall
from dart_flight.check.findings import CheckFinding
from dart_flight.config.mission import Collision, Mission
from dart_flight.core.mission.approach import (
    ON_PLANE_M,
    NoApproachError,
    is_blocked,
    plan_approach,
    segments_to_impact,
)
from dart_flight.core.mission.wall_uncertainty import SURE_SD, end_margin_m, position_margin_m
from dart_flight.planning.envelope import incidence_deg, max_incidence_deg
from dart_flight.planning.predicted_flight import PredictedContact, PredictedFlight, impact_place

_INCIDENCE_SD = 2.0
_OPPOSITE = -0.9  # maximum dot product of opposite walls' normals, up to 26 degrees from antiparallel
_SAME_PLACE_M = 0.005  # faces with a smaller gap, below the measuring accuracy, count as back to back


def check_walls(mission: Mission, planned: PredictedFlight | None) -> list[CheckFinding]:
    """Check that each collision tolerates the uncertainty of the walls and is far enough from wall ends.

    If a recovery leads to a wall, `planned` gives the impact point.
    """
    hits = {} if planned is None else planned.hits
    known = [c for c in mission.collisions if c.probe is None and not c.wall.sought]
    found = [finding for c in known for finding in _check_collision(mission, c, hits)]
    faces = _check_opposite_faces(mission)
    return [*faces, *_check_ends(mission, hits), *found, *_check_way_to_goal(mission, hits)]


def _check_way_to_goal(mission: Mission, hits: Mapping[int, PredictedContact]) -> Iterator[CheckFinding]:
    """Return a no-go if a wall is between the last impact and the goal."""
    if not mission.recovers_to_goal or mission.goal_trajectory is not None:
        return
    last = mission.collisions[-1]
    (x, y), (nx, ny) = impact_place(last, hits), last.wall.normal
    before = (x + ON_PLANE_M * nx, y + ON_PLANE_M * ny)
    for wall in mission.walls:
        if is_blocked(wall, before, mission.goal.position_m, 0.0, 0.0):
            message = (
                f"wall {wall.name} is between the last impact and the goal: the vehicle would fly into it; "
                "move the goal, or add waypoints around the wall"
            )
            yield CheckFinding("way_to_goal", False, message)
            return


def _check_opposite_faces(mission: Mission) -> Iterator[CheckFinding]:
    """Check that the vehicle fits between opposite walls, and that no partition was entered as two walls.

    Walls of a corner are not opposite. Both faces of a wall with `thickness_m` may be close.
    """
    contact_m = mission.vehicle.airframe.contact_distance_m
    surfaces = [mission.vehicle.airframe.wall_surface(wall) for wall in mission.flat_walls]
    for one, other in itertools.combinations(surfaces, 2):
        (ax, ay), (bx, by) = one.normal, other.normal
        same = one.thickness_m is not None and other.name == one.back().name
        gaps = [one.signed_distance(place) for place in _places_before(one, other)]
        if same or not gaps or ax * bx + ay * by > _OPPOSITE:
            continue
        names = f"walls {one.name} and {other.name}"
        figures = {"gap_m": min(gaps, key=abs)}
        if _SAME_PLACE_M < min(gaps) < 2.0 * contact_m:
            message = (
                f"{names} face each other at {min(gaps):.3f} m, minimum {2.0 * contact_m:.2f} m for the "
                "vehicle: check their places; if they are one partition, enter one wall with thickness_m"
            )
            yield CheckFinding("opposite_walls", False, message, figures=figures)
        elif -contact_m < max(gaps) <= _SAME_PLACE_M:
            message = (
                f"{names} are back to back at {max(0.0, -max(gaps)):.3f} m, less than the contact distance "
                f"{contact_m:.2f} m: enter the partition as one wall with thickness_m"
            )
            yield CheckFinding("opposite_walls", False, message, figures=figures)


def _places_before(one: Wall, other: Wall) -> list[Vec2]:
    """Return the two ends of the part of wall `other` that projects onto wall `one`."""
    left, right = (one.along(end) for end in other.ends)
    reach = 0.5 * one.length_m
    low, high = max(-reach, min(left, right)), min(reach, max(left, right))
    if not low < high:
        return []
    (lx, ly), (rx, ry) = other.ends
    shares = [(along - left) / (right - left) for along in (low, high)]
    return [(lx + share * (rx - lx), ly + share * (ry - ly)) for share in shares]


def _check_ends(mission: Mission, hits: Mapping[int, PredictedContact]) -> Iterator[CheckFinding]:
    """Check the collision nearest to a wall's end, because the whole vehicle must meet the wall.

    Posts have no ends and are skipped.
    """
    walls = [c for c in mission.collisions if not c.wall.post_radius_m and not c.wall.sought]
    places = [(c, impact_place(c, hits)) for c in walls]
    if not places:
        return

    def room_m(one: tuple[Collision, Vec2]) -> float:
        wall, place = one[0].wall, one[1]
        return float(wall.end_distance_m(place) - end_margin_m(wall, place))

    nearest, place = min(places, key=room_m)
    wall = nearest.wall
    distance_m, slack = float(wall.end_distance_m(place)), float(position_margin_m(wall, place))
    side = "from" if distance_m >= 0.0 else "beyond"
    message = f"the impact on wall {wall.name} is {abs(distance_m):.2f} m {side} the wall's end"
    needed = f"half the vehicle's width ({wall.half_vehicle_m:.2f} m)"
    if slack > 0.0:
        needed += f" plus {SURE_SD:g} standard deviations of the wall's position ({slack:.2f} m)"
    figures = {"distance_m": distance_m, "margin_m": wall.half_vehicle_m + slack}
    if room_m((nearest, place)) < 0.0:
        message += f", minimum {needed}"
        if distance_m < mission.vehicle.airframe.guard_along_m + slack:
            message += "; at this place not all guards touch the wall, so the contact rotates the vehicle"
        message += ": move the impact along the wall"
    yield CheckFinding("wall_end", room_m((nearest, place)) >= 0.0, message, figures=figures)


def _check_collision(
    mission: Mission, collision: Collision, hits: Mapping[int, PredictedContact]
) -> Iterator[CheckFinding]:
    wall, item = collision.wall, f"survey_{collision.index}"
    problems = [
        *_target_wall_problems(mission, collision, impact_place(collision, hits)),
        *_blocking_walls(mission, collision),
    ]
    if problems:
        yield CheckFinding(item, False, f"within {SURE_SD:g} standard deviations {', '.join(problems)}")
    elif wall.is_uncertain:
        slack = float(position_margin_m(wall, impact_place(collision, hits)))
        message = f"wall {wall.name}: the impact tolerates a position error of {slack:.2f} m ({SURE_SD:g} sd)"
        yield CheckFinding(item, True, message)
    planned_deg, most_deg = (
        incidence_deg(mission, collision),
        max_incidence_deg(mission.vehicle, collision.mode),
    )
    off_deg = planned_deg + _INCIDENCE_SD * math.degrees(wall.yaw_sd_rad or 0.0)
    if planned_deg <= most_deg < off_deg:  # `check_collisions` reports a planned excess
        yield CheckFinding(
            f"incidence_{collision.index}",
            False,
            f"the angle between wall {wall.name} and the vehicle's leading edge may be {off_deg:.0f} degrees "
            f"({_INCIDENCE_SD:g} sd), limit {most_deg:g} degrees with {collision.mode.value} arms: measure "
            "the wall's direction",
        )


def _target_wall_problems(mission: Mission, collision: Collision, place: Vec2) -> Iterator[str]:
    """Yield a phrase for each problem that the uncertainty of the target wall's position may cause."""
    wall = collision.wall
    if not wall.is_uncertain:
        return
    slack, (x, y), (nx, ny) = float(position_margin_m(wall, place)), place, wall.normal
    nearest, furthest = (x + slack * nx, y + slack * ny), (x - slack * nx, y - slack * ny)
    excess = mission.bounds.excess2(furthest)
    if excess > 0.0:
        yield f"wall {wall.name} may be {excess:.2f} m outside bounds_m"
    for other in mission.walls:
        if other.name != wall.name and is_blocked(other, nearest, furthest, 0.0):
            yield f"wall {wall.name} may be behind wall {other.name}"


def _blocking_walls(mission: Mission, collision: Collision) -> Iterator[str]:
    """Yield a phrase for every wall, except the target, that may block the run-up or the trajectory."""
    if collision.trajectory is not None:
        places = [state.position for state in collision.trajectory.states()]
        for wall in mission.walls:
            if wall.is_uncertain and wall.name != collision.wall.name:
                slack_m = max(float(position_margin_m(wall, place)) for place in places)
                nearest = wall.displaced(slack_m)
                if any(is_blocked(nearest, a, b, 0.0, 0.0) for a, b in itertools.pairwise(places)):
                    yield f"wall {wall.name} may block the trajectory to wall {collision.wall.name}"
        return
    if collision.approach_m_s is None:
        return
    try:
        approach = plan_approach(mission, collision)
    except NoApproachError:
        return  # `check_collisions` reports it
    impact, first = collision.impact_point, collision.index == 1
    assert impact is not None
    legs = segments_to_impact(mission.start, approach.begin[:2], impact, collision.wall, first)
    for wall in mission.walls:
        if wall.is_uncertain and wall.name != collision.wall.name:
            nearest = wall.displaced(float(position_margin_m(wall, impact)))
            if any(is_blocked(nearest, *leg) for leg in legs(nearest)):
                yield f"wall {wall.name} may block the run-up to wall {collision.wall.name}"
