"""The edits of a mission or scenario in the studio; each returns an `Edit` for `OpenFile.edit`.

Values are written exactly as given. Only `drag` rounds: positions to millimetres, directions to 0.1 degrees.
Objects have the ids of `scene_model`.
"""

from __future__ import annotations

from typing import Any

from dart_flight.base.geometry import Vec2
from dart_flight.lab.studio.open_file import Edit, Tree


def drag(handle: str, position: Vec2, yaw_rad: float | None = None) -> Edit:
    """Move a handle, and turn it if `yaw_rad` is given (a wall's normal); both rounded."""
    raise NotImplementedError


def set_value(key: tuple[str | int, ...], value: Any) -> Edit:
    """Set any key of the file, such as `("walls", "wood", "length_m")`; None removes the key."""
    raise NotImplementedError


def move(object_id: str, position: Vec2) -> Edit:
    """Move a wall, post, start, goal, waypoint, visit or corner to a position."""
    raise NotImplementedError


def turn_wall(object_id: str, yaw_deg: float) -> Edit:
    """Turn a wall about its point, so that its normal has a direction, degrees counter-clockwise from x."""
    raise NotImplementedError


def rename(object_id: str, name: str) -> Edit:
    """Rename a wall or post, and every mention of it in hits, waypoints, sequence and gains."""
    raise NotImplementedError


def add_wall(point: Vec2, yaw_deg: float, length_m: float, material: str, name: str | None = None) -> Edit:
    """Add a wall; without a name, the material's name with a number, if needed, is used."""
    raise NotImplementedError


def add_post(centre: Vec2, radius_m: float, material: str, name: str | None = None) -> Edit:
    raise NotImplementedError


def add_waypoint(position: Vec2, after: int | None = None) -> Edit:
    """Add a waypoint after so many hits; by default after the last."""
    raise NotImplementedError


def add_visit(position: Vec2, within_m: float = 0.1) -> Edit:
    raise NotImplementedError


def add_hit(
    wall: str, normal_m_s: float | None = -1.0, tangential_m_s: float = 0.0, mode: str | None = None
) -> Edit:
    """Add a hit at the end; without `normal_m_s`, the recovery of the hit before leads to it.

    In a scenario, the wall is added to the sequence.
    """
    raise NotImplementedError


def set_hit(
    number: int,
    wall: str | None = None,
    mode: str | None = None,
    normal_m_s: float | None = None,
    tangential_m_s: float | None = None,
) -> Edit:
    """Change a hit (`number` from 1); None leaves a value."""
    raise NotImplementedError


def copy_object(object_id: str) -> Edit:
    """Copy a wall, post, waypoint, visit or hit; a wall or post appears half a metre beside the original."""
    raise NotImplementedError


def delete(object_id: str) -> Edit:
    """Delete a wall, post, waypoint, visit or hit, and the hits of a deleted wall or post."""
    raise NotImplementedError


def scenario_of(tree: Tree, name: str) -> Tree:
    """Return a scenario, objective quickest, with the room of a mission."""
    raise NotImplementedError
