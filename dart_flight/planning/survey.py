"""A mission that measures the walls of another mission by touching them.

Probes touch every wall twice (docs/walls.md). The first contact is rigid, along the assumed normal. The
second contact is along the measured normal, in the mode of the mission's impact. The second contact is needed
because a contact at large incidence does not measure the wall's direction well. The survey begins with the
nearest wall that a clear path reaches.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from dart_flight.base.geometry import Vec2, distance2
from dart_flight.base.records import Mode
from dart_flight.base.walls import Wall
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.core.mission.approach import is_blocked, is_blocked_by_post
from dart_flight.core.mission.wall_uncertainty import position_margin_m

_SPEED_M_S = 0.5  # speed of a probe; at this speed both modes are still detected reliably
_RUN_UP_M = 0.5  # distance of the run-up point from the wall at its nearest possible position
_BACK_M = 0.5
# Points of contact in the order of trial: offset from the wall's middle, as a fraction of its length.
_ALONG = (0.0, 0.2, -0.2, 0.35, -0.35)
_PLACE_SD_M, _YAW_SD_DEG = 0.1, 3.0  # standard deviations for walls without configured standard deviations


class SurveyPlan(NamedTuple):
    """A mission that touches walls, and why it cannot reach the other walls (reasons by wall name)."""

    mission: Mission
    unreachable: dict[str, str]


def plan_survey(mission: Mission, speed_m_s: float = _SPEED_M_S) -> SurveyPlan:
    """Return a mission that touches the flat walls of the given mission.

    The survey has the same start, bounds, limits and vehicle, and ends at the start. If the mission has no
    wall, or none can be reached, this raises InputError.
    """
    mission = mission.replace(_figures(mission))
    left = list(mission.flat_walls)
    here, probes, unreachable = mission.start, list[dict[str, Any]](), dict[str, str]()
    while left:
        legs = {wall.name: _probe_leg(mission, wall, here) for wall in left}
        near = [(distance2(here, leg.begin), wall) for wall in left if (leg := legs[wall.name]) is not None]
        if not near:
            unreachable |= {wall.name: "no clear path leads to the wall" for wall in left}
            break
        _, wall = min(near, key=lambda found: found[0])
        leg = legs[wall.name]
        assert leg is not None
        left.remove(wall)
        for mode in _modes(mission, wall):
            probes.append(
                {
                    "wall": wall.name,
                    "mode": mode.value,
                    "probe": {
                        "from_m": list(leg.begin),
                        "length_m": leg.length_m,
                        "speed_m_s": speed_m_s,
                        "back_m": _BACK_M,
                    },
                }
            )
        here = leg.back
    if not probes:
        raise InputError("no wall can be touched: no clear path leads to a wall", source=mission.source)
    changes = {
        "name": f"survey-{mission.name}"[:64],
        "collisions": probes,
        "waypoints": [],
        "goal": {"position_m": list(mission.start), "hold_s": 0.5, "capture_radius_m": 0.3},
        "predicted": None,
        "goal_trajectory": None,
        "after_impact": "setpoint",
        "standoff_m": None,
    }
    return SurveyPlan(mission.replace(changes), unreachable)


def _figures(mission: Mission) -> dict[str, float]:
    """Return default standard deviations by mission key, for walls without configured deviations."""
    figures = {}
    for wall in mission.flat_walls:
        if wall.position_sd_m is None:
            figures[f"walls.{wall.name}.position_sd_m"] = _PLACE_SD_M
        if wall.yaw_sd_rad is None:
            figures[f"walls.{wall.name}.yaw_sd_deg"] = _YAW_SD_DEG
    return figures


class _SurveyLeg(NamedTuple):
    """A straight leg to a wall: its beginning, largest length, and the point at which to wait afterwards."""

    begin: Vec2
    length_m: float
    back: Vec2


def _probe_leg(mission: Mission, wall: Wall, here: Vec2) -> _SurveyLeg | None:
    """Return a leg along a wall's normal that begins at a reachable point, or None if none is possible."""
    (px, py), (nx, ny), (tx, ty) = wall.point, wall.normal, wall.tangent
    for share in _ALONG:
        along = share * wall.length_m
        contact = (px + along * tx, py + along * ty)
        margin = float(position_margin_m(wall, contact))
        begin = (contact[0] + (margin + _RUN_UP_M) * nx, contact[1] + (margin + _RUN_UP_M) * ny)
        beyond = margin
        while (
            beyond > 0.0
            and mission.bounds.excess2((contact[0] - beyond * nx, contact[1] - beyond * ny)) > 0.0
        ):
            beyond -= 0.05
        if mission.bounds.excess2(begin) > 0.0 or not _is_clear(mission, here, begin):
            continue
        if any(is_blocked(other, begin, contact) for other in mission.walls if other.name != wall.name):
            continue
        back = (contact[0] + _BACK_M * nx, contact[1] + _BACK_M * ny)
        return _SurveyLeg(begin, round(margin + _RUN_UP_M + max(0.0, beyond), 3), back)
    return None


def _is_clear(mission: Mission, a: Vec2, b: Vec2) -> bool:
    walls = any(is_blocked(wall, a, b) for wall in mission.walls)
    return not walls and not any(is_blocked_by_post(mission, post, a, b) for post in mission.posts)


def _modes(mission: Mission, wall: Wall) -> Sequence[Mode]:
    """Return the modes of the two contacts: rigid, then the mode of the mission's impact on the wall."""
    modes = mission.vehicle.modes
    used = [c.mode for c in mission.collisions if c.wall.name == wall.name]
    first = Mode.RIGID if Mode.RIGID in modes else modes[0]
    return (first, used[0] if used else first)


def surveyed_walls(mission: Mission, measured: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the mission file's keys for each measured wall (`MeasuredWall`), by wall name."""
    found = {}
    for wall in mission.flat_walls:
        new = measured.get(wall.name)
        if new is None:
            continue
        keys: dict[str, Any] = {
            "point_m": [round(v, 4) for v in new.point_m],
            "normal": [round(v, 6) for v in new.normal],
            "length_m": wall.length_m,
            "material": new.material or wall.material,
            "position_sd_m": round(max(1e-3, new.position_sd_m or 0.0), 4),
        }
        if new.yaw_sd_deg is not None:
            keys["yaw_sd_deg"] = round(new.yaw_sd_deg, 3)
        found[wall.name] = keys
    return found


def surveyed_collisions(
    mission: Mission, written: Sequence[Mapping[str, Any]], measured: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Return the mission file's keys for each collision, expressed relative to the measured walls.

    Gains along the mission's axes, and points in the mission frame, would be wrong for a wall that was found
    elsewhere. `written` has the collisions as in the mission file.
    """
    found = []
    for keys, collision in zip(written, mission.collisions, strict=True):
        one, wall = dict(keys), collision.wall
        if wall.name in measured and not wall.post_radius_m:
            if one.pop("alpha_m_per_n", None) is not None:
                one["alpha_wall_m_per_n"] = [
                    collision.alpha_normal_m_per_n,
                    collision.alpha_tangential_m_per_n,
                ]
            if one.pop("impact_point_m", None) is not None and collision.impact_point is not None:
                one["impact_along_m"] = round(float(wall.along(collision.impact_point)), 4)
        found.append(one)
    return found
