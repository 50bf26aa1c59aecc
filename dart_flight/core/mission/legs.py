"""Legs of a mission that depend on walls found in flight: whether to skip them, and their updated form."""

from __future__ import annotations

import msgspec

from dart_flight.base.geometry import Vec2
from dart_flight.config.mission import Collision, Mission, Waypoint
from dart_flight.config.probes import resolve_place
from dart_flight.core.mission.wall_uncertainty import EstimatedWalls


def skip_reason(leg: Collision | Waypoint, walls: EstimatedWalls) -> str | None:
    """Return the reason to skip a leg (a failed condition, or a wall that was not found), or None."""
    if leg.if_met is not None and not walls.is_measured(leg.if_met):
        return f"no contact with wall {leg.if_met}"
    if leg.if_not_met is not None and walls.is_measured(leg.if_not_met):
        return f"contact with wall {leg.if_not_met}"
    if isinstance(leg, Waypoint):
        at = leg.wall_at
        name = at.name if at is not None and at.sought else None
    else:
        name = leg.wall.name if leg.wall.sought and leg.probe is None else None
    if name is not None and not walls.is_measured(name):
        return f"no contact with wall {name}"
    return None


def update_collision(collision: Collision, walls: EstimatedWalls, now_us: int, here: Vec2) -> Collision:
    """Return a collision at its wall's estimated position; the impact point keeps its place along it.

    `here` is the resting position, mission frame, at which a probe with `from_here` starts.
    """
    wall, probe = walls.known_wall(collision.wall, now_us), collision.probe
    if probe is not None and probe.from_here:
        collision = msgspec.structs.replace(collision, probe=probe.starting_at(here))
    if collision.impact_point is None or wall == collision.wall:
        return collision
    along = collision.wall.along(collision.impact_point)
    (x, y), (tx, ty) = wall.point, wall.tangent
    return msgspec.structs.replace(collision, wall=wall, impact_point=(x + along * tx, y + along * ty))


def update_waypoint(waypoint: Waypoint, walls: EstimatedWalls) -> Waypoint:
    """Return a waypoint with its position relative to the wall's estimate."""
    if waypoint.at_wall is None or waypoint.wall_at is None or waypoint.position is None:
        return waypoint
    place = resolve_place(walls.known_wall(waypoint.wall_at), waypoint.at_wall)
    return msgspec.structs.replace(waypoint, position=(*place, waypoint.position[2]))


def update_mission(mission: Mission, walls: EstimatedWalls, now_us: int, here: Vec2) -> Mission:
    """Return a mission with estimated walls and waypoints, and with its start at the resting position.

    Waypoints that are skipped are omitted.
    """
    return msgspec.structs.replace(
        mission,
        start=here,
        walls=walls.known_walls(mission.walls, now_us),
        waypoints=tuple(
            update_waypoint(w, walls) for w in mission.waypoints if skip_reason(w, walls) is None
        ),
    )
