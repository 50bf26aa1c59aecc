"""A mission that touches the walls of another one, so that they need not be surveyed.

Every wall is met twice by probes (docs/walls.md): first rigid, straight at it where the mission has it; then
square to it as it was felt, in the mode in which the mission hits it: one contact at a large incidence does
not tell the direction well. The order is the nearest first, of those to which the way is clear.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from dart_flight.base.geometry import Vec2, distance2
from dart_flight.base.records import Mode
from dart_flight.base.walls import Wall
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.core.mission.approach import is_blocked, is_post_in_the_way
from dart_flight.core.mission.wall_uncertainty import position_margin_m

_SPEED_M_S = 0.5  # gentle, and well over the threshold of the detection in either mode
_RUN_UP_M = 0.5  # before the nearest place where the wall may stand
_BACK_M = 0.5
_ALONG = (0.0, 0.2, -0.2, 0.35, -0.35)  # shares of a wall's length at which it may be touched
_PLACE_SD_M, _YAW_SD_DEG = 0.1, 3.0  # of walls that carry no figures of their own


class SurveyPlan(NamedTuple):
    """A mission that touches walls, and the names of those that it cannot reach, each with the reason."""

    mission: Mission
    unreachable: dict[str, str]


def plan_survey(mission: Mission, speed_m_s: float = _SPEED_M_S) -> SurveyPlan:
    """The mission that touches the walls of another one.

    Args:
        mission: whose flat walls are to be measured; start, bounds, limits and vehicle are kept, and the goal
            is where it starts.
        speed_m_s: of the touches.

    Raises:
        InputError: the mission has no wall, or none can be reached.
    """
    mission = mission.replace(_figures(mission))
    left = list(mission.flat_walls)
    here, probes, unreachable = mission.start, list[dict[str, Any]](), dict[str, str]()
    while left:
        ways = {wall.name: _touch(mission, wall, here) for wall in left}
        near = [(distance2(here, way.begin), wall) for wall in left if (way := ways[wall.name]) is not None]
        if not near:
            unreachable |= {wall.name: "no clear way to it" for wall in left}
            break
        _, wall = min(near, key=lambda found: found[0])
        way = ways[wall.name]
        assert way is not None
        left.remove(wall)
        for mode in _modes(mission, wall):
            probes.append(
                {
                    "wall": wall.name,
                    "mode": mode.value,
                    "probe": {
                        "from_m": list(way.begin),
                        "length_m": way.length_m,
                        "speed_m_s": speed_m_s,
                        "back_m": _BACK_M,
                    },
                }
            )
        here = way.back
    if not probes:
        raise InputError("no wall can be touched: there is no clear way to any", source=mission.source)
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
    """What is believed of walls that carry no figure: they are surveyed because nobody knows."""
    figures = {}
    for wall in mission.flat_walls:
        if wall.position_sd_m is None:
            figures[f"walls.{wall.name}.position_sd_m"] = _PLACE_SD_M
        if wall.yaw_sd_rad is None:
            figures[f"walls.{wall.name}.yaw_sd_deg"] = _YAW_SD_DEG
    return figures


class _SurveyLeg(NamedTuple):
    """A straight leg to a wall: where it begins, how long it may get, where the vehicle waits afterwards."""

    begin: Vec2
    length_m: float
    back: Vec2


def _touch(mission: Mission, wall: Wall, here: Vec2) -> _SurveyLeg | None:
    """The leg straight at a wall whose beginning can be reached from a place; None where none can."""
    (px, py), (nx, ny), (tx, ty) = wall.point, wall.normal, wall.tangent
    for share in _ALONG:
        along = share * wall.length_m
        met = (px + along * tx, py + along * ty)
        margin = float(position_margin_m(wall, met))
        begin = (met[0] + (margin + _RUN_UP_M) * nx, met[1] + (margin + _RUN_UP_M) * ny)
        beyond = margin
        while beyond > 0.0 and mission.bounds.excess2((met[0] - beyond * nx, met[1] - beyond * ny)) > 0.0:
            beyond -= 0.05
        if mission.bounds.excess2(begin) > 0.0 or not _is_clear(mission, here, begin):
            continue
        if any(is_blocked(other, begin, met) for other in mission.walls if other.name != wall.name):
            continue
        back = (met[0] + _BACK_M * nx, met[1] + _BACK_M * ny)
        return _SurveyLeg(begin, round(margin + _RUN_UP_M + max(0.0, beyond), 3), back)
    return None


def _is_clear(mission: Mission, a: Vec2, b: Vec2) -> bool:
    """Whether the straight way from one place to another keeps clear of walls and posts."""
    walls = any(is_blocked(wall, a, b) for wall in mission.walls)
    return not walls and not any(is_post_in_the_way(mission, post, a, b) for post in mission.posts)


def _modes(mission: Mission, wall: Wall) -> Sequence[Mode]:
    """Rigid first, then the mode in which the mission hits the wall."""
    modes = mission.vehicle.modes
    used = [c.mode for c in mission.collisions if c.wall.name == wall.name]
    first = Mode.RIGID if Mode.RIGID in modes else modes[0]
    return (first, used[0] if used else first)


def surveyed_walls(mission: Mission, measured: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The keys of a mission's walls as they were measured, for those that were.

    Args:
        mission: whose walls they are.
        measured: `MeasuredWall` by name.
    """
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
    """The keys of a mission's collisions, said relative to the walls that were measured.

    Gains along the mission's axes, and places in it, would no longer fit walls that stand elsewhere.

    Args:
        mission: as it was read.
        written: its collisions as the file says them.
        measured: as `surveyed_walls`.
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
