"""The edits of a mission or scenario in the studio; each returns an `Edit` for `OpenFile.edit`.

Values are written exactly as given. Only `drag` rounds: positions to millimetres, directions to 0.1 degrees.
Objects have the ids of `scene_model`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from typing import Any

from dart_flight.base.geometry import Vec2
from dart_flight.config.document import Document, InputError, Key, dotted
from dart_flight.lab.studio.objects import SECTIONS, base_name, describe, existing_entry, key_of
from dart_flight.lab.studio.open_file import Edit, Tree

_GAIN_M_PER_N = 0.025  # recovery gain of a new hit, as in the shipped missions
_BESIDE_M = 0.5  # distance of a copy from its original
_PLANNED = ("collisions", "waypoints", "predicted", "flown", "goal_trajectory")  # what `plan` decides
_SEARCH = {  # approaches of a scenario made from a mission
    "normal_m_s": {"min": -1.5, "max": -0.1, "step": 0.05},
    "tangential_m_s": {"min": -1.5, "max": 1.5, "step": 0.05},
}
_POINTS = {"wall": "point_m", "simulated": "point_m", "post": "centre_m"}
_GAINS = ("alpha_m_per_n", "alpha_wall_m_per_n")
_NAMING = (
    "wall",
    "if_met",
    "if_not_met",
    "sequence",
    *_GAINS,
)  # keys that name walls
# Keys of a mission's room that a scenario shares.
_SHARED = [
    "version",
    "vehicle",
    "frame",
    "start",
    "goal",
    "bounds_m",
    "walls",
    "posts",
    "transit_mode",
    "limits",
]


def drag(handle: str, position: Vec2, yaw_rad: float | None = None) -> Edit:
    """Move a handle, and turn it if `yaw_rad` is given (a wall's normal); both rounded."""
    x, y = (round(v, 3) + 0.0 for v in position)
    moved = move(handle, (x, y))
    if yaw_rad is None:
        return moved

    def change(tree: Tree) -> None:
        moved.change(tree)
        before = math.atan2(*existing_entry(tree, handle)["normal"][::-1])
        if abs(math.remainder(yaw_rad - before, 2.0 * math.pi)) > math.radians(0.05):
            turn_wall(handle, round(math.degrees(yaw_rad), 1)).change(tree)

    return Edit(f"turn {describe(handle)}", change)


def set_value(key: Key, value: Any) -> Edit:
    """Set any key of the file, such as `("walls", "wood", "length_m")`; None removes the key."""

    def change(tree: Tree) -> None:
        inside: Any = tree
        for part in key[:-1]:
            if isinstance(inside, dict) and isinstance(part, str):
                inside = inside.setdefault(part, {})
            elif isinstance(inside, list) and isinstance(part, int) and part < len(inside):
                inside = inside[part]
            else:
                raise InputError("does not exist", key=key)
        if value is not None:
            inside[key[-1]] = value
        elif isinstance(inside, dict):
            inside.pop(key[-1], None)
        else:
            inside.pop(int(key[-1]))

    return Edit(f"set {dotted(key)}", change)


def move(object_id: str, position: Vec2) -> Edit:
    """Move a wall, post, start, goal, waypoint, visit or corner to a position."""
    kind, _, name = object_id.partition("/")

    def change(tree: Tree) -> None:
        entry = existing_entry(tree, object_id)
        if kind == "corner":
            for axis, value, high in zip("xy", position, (name in "12", name in "23"), strict=True):
                entry[axis] = [entry[axis][0], value] if high else [value, entry[axis][1]]
            return
        point = _POINTS.get(kind, "position_m")
        if point not in entry:
            raise InputError(f"{describe(object_id)} has no position of its own")
        entry[point] = [*position]

    return Edit(f"move {describe(object_id)}", change)


def turn_wall(object_id: str, yaw_deg: float) -> Edit:
    """Turn a wall about its point, so that its normal has a direction, degrees counter-clockwise from x.

    Gains per axis (`alpha_m_per_n`) that differ are possible only for a wall parallel to an axis: they become
    gains of the wall's axes, which turn with the wall.
    """

    def change(tree: Tree) -> None:
        wall = existing_entry(tree, object_id)
        x, y = wall["normal"]
        wall["normal"] = _normal(yaw_deg)
        for gains in list(_gains_of(tree, object_id.partition("/")[2])):
            if 0.0 not in wall["normal"] and gains[0] != gains[1]:
                _to_wall_axes(tree, gains, across=abs(x) < abs(y))

    return Edit(f"turn {describe(object_id)}", change)


def _normal(yaw_deg: float) -> list[float]:
    """Return a unit vector; after quarter turns it is exact."""
    return [round(f(math.radians(yaw_deg)), 10) + 0.0 for f in (math.cos, math.sin)]


def _gains_of(tree: Tree, wall: str) -> Iterator[list[float]]:
    """Yield the gains per axis of a wall's hits, and of the wall in a scenario."""
    yield from (
        hit["alpha_m_per_n"]
        for hit in _list_of(tree, "collisions")
        if base_name(str(hit.get("wall"))) == wall and "alpha_m_per_n" in hit
    )
    per_axis = tree.get("alpha_m_per_n", {})
    yield from (gains for name, gains in per_axis.items() if base_name(name) == wall)


def _to_wall_axes(tree: Tree, gains: list[float], *, across: bool) -> None:
    """Replace gains per axis by gains [normal, tangential]; `across`: the normal was along y."""
    per_axis, per_wall = _GAINS
    own = gains[::-1] if across else [*gains]
    for hit in _list_of(tree, "collisions"):
        if hit.get(per_axis) is gains:
            renamed = {(per_wall if key == per_axis else key): value for key, value in hit.items()}
            hit.clear()
            hit.update(renamed | {per_wall: own})
    of_walls = tree.get(per_axis, {})
    for name in [name for name, found in of_walls.items() if found is gains]:
        del of_walls[name]
        tree.setdefault(per_wall, {})[name] = own
    if per_axis in tree and not of_walls:
        del tree[per_axis]


def rename(object_id: str, name: str) -> Edit:
    """Rename a wall or post, and every mention of it in hits, waypoints, sequence and gains."""
    kind, _, before = object_id.partition("/")

    def renamed(value: Any, key: str = "") -> Any:
        if isinstance(value, dict):
            return {renamed(k, key): renamed(v, k) for k, v in value.items()}
        if isinstance(value, list):
            return [renamed(v, key) for v in value]
        named = key in _NAMING and isinstance(value, str) and base_name(value) == before
        return name + value[len(before) :] if named else value

    def change(tree: Tree) -> None:
        existing_entry(tree, object_id)
        if not name or name in _names(tree):
            raise InputError(f"a wall or post already has the name {name}" if name else "a name is needed")
        section = SECTIONS[kind]
        tree[section] = {(name if key == before else key): value for key, value in tree[section].items()}
        for key in ("collisions", "waypoints", "sequence", *_GAINS):
            if key in tree:
                tree[key] = renamed(tree[key], key)

    return Edit(f"rename {describe(object_id)} to {name}", change)


def _list_of(tree: Tree, section: str) -> list[Any]:
    found = tree.get(section)
    return [one for one in found if isinstance(one, dict)] if isinstance(found, list) else []


def add_wall(point: Vec2, yaw_deg: float, length_m: float, material: str) -> Edit:
    """Add a wall with the name of its material, and a number if the name is taken."""
    wall = {"point_m": [*point], "normal": _normal(yaw_deg), "length_m": length_m}
    return _add_named("walls", wall | {"material": material, "given_at": "centre"}, material)


def add_post(centre: Vec2, radius_m: float, material: str) -> Edit:
    """Add a post with the name `post`, and a number if the name is taken."""
    return _add_named("posts", {"centre_m": [*centre], "radius_m": radius_m, "material": material}, "post")


def _add_named(section: str, entry: dict[str, Any], stem: str) -> Edit:
    def change(tree: Tree) -> None:
        tree.setdefault(section, {})[_free_name(tree, stem)] = entry

    return Edit(f"add {section[:-1]} {stem}", change)


def _names(tree: Tree) -> set[str]:
    return {name for section in ("walls", "simulated_walls", "posts") for name in tree.get(section) or {}}


def _free_name(tree: Tree, stem: str) -> str:
    taken = _names(tree)
    numbered = (f"{stem}{i}" for i in range(2, len(taken) + 3))
    return next(name for name in (stem, *numbered) if name not in taken)


def add_waypoint(position: Vec2) -> Edit:
    """Add a waypoint after the last hit."""

    def change(tree: Tree) -> None:
        flown = len(_list_of(tree, "collisions"))
        waypoint = ({"after": flown} if flown else {}) | {"position_m": [*position]}
        tree.setdefault("waypoints", []).append(waypoint)

    return Edit("add a waypoint", change)


def add_visit(position: Vec2, within_m: float = 0.1) -> Edit:
    """Add a visit at the end of a scenario's list."""

    def change(tree: Tree) -> None:
        tree.setdefault("visits", []).append({"position_m": [*position], "within_m": within_m})

    return Edit("add a visit", change)


def add_hit(wall: str, normal_m_s: float | None = -1.0) -> Edit:
    """Add a hit at the end; without `normal_m_s`, the recovery of the hit before leads to it.

    In a scenario, the wall is added to the sequence.
    """

    def change(tree: Tree) -> None:
        gains = [_GAIN_M_PER_N, _GAIN_M_PER_N]
        if "sequence" in tree:
            sequence = tree["sequence"]
            tree["sequence"] = [*(sequence if isinstance(sequence, list) else []), wall]
            if tree.get("search") and not any(wall in (tree.get(key) or {}) for key in _GAINS):
                tree.setdefault("alpha_wall_m_per_n", {})[wall] = gains
            return
        approach = {"normal_m_s": normal_m_s, "tangential_m_s": 0.0}
        hit = {"wall": wall} | ({} if normal_m_s is None else {"approach": approach})
        tree.setdefault("collisions", []).append(hit | {"alpha_wall_m_per_n": gains})

    return Edit(f"add a hit of {wall}", change)


def copy_object(object_id: str) -> Edit:
    """Copy a wall, post, waypoint, visit or hit; a wall or post appears half a metre beside the original."""
    section, name = _place_of(object_id)

    def change(tree: Tree) -> None:
        entry = copy.deepcopy(existing_entry(tree, object_id))
        if isinstance(name, int):
            tree[section].insert(name + 1, entry)
            if section == "collisions":
                _shift_waypoints(tree, name, 1)
            return
        point, normal = _POINTS[object_id.partition("/")[0]], entry.get("normal", [1.0, 0.0])
        size = math.hypot(*normal) or 1.0
        entry[point] = [round(a + _BESIDE_M * b / size, 3) for a, b in zip(entry[point], normal, strict=True)]
        tree[section][_free_name(tree, name)] = entry

    return Edit(f"copy {describe(object_id)}", change)


def delete(object_id: str) -> Edit:
    """Delete a wall, post, waypoint, visit or hit, and the hits of a deleted wall or post."""
    section, name = _place_of(object_id)

    def change(tree: Tree) -> None:
        existing_entry(tree, object_id)
        if section == "collisions":
            _delete_hit(tree, int(name))
            return
        del tree[section][name]
        if isinstance(name, str) and section != "simulated_walls":
            _forget_wall(tree, name)
        if not tree[section] and section != "walls":
            del tree[section]

    return Edit(f"delete {describe(object_id)}", change)


def _place_of(object_id: str) -> tuple[str, str | int]:
    """Return section and name, or section and index, of an object of which there may be several."""
    key = key_of(object_id)
    if len(key) < 2:
        raise InputError(f"{describe(object_id)} cannot be copied or deleted")
    return str(key[0]), key[1]


def _delete_hit(tree: Tree, index: int) -> None:
    del tree["collisions"][index]
    _shift_waypoints(tree, index, -1)


def _shift_waypoints(tree: Tree, index: int, by: int) -> None:
    """Keep each waypoint between the same hits after a hit was added or deleted at an index, from 0."""
    for waypoint in _list_of(tree, "waypoints"):
        if waypoint.get("after", 0) > index:
            waypoint["after"] += by


def _forget_wall(tree: Tree, name: str) -> None:
    """Remove the hits and gains of a deleted wall, and its places in the sequence."""
    hits = tree.get("collisions", [])
    for i in reversed(range(len(hits))):
        if base_name(str(hits[i].get("wall"))) == name:
            _delete_hit(tree, i)
    if isinstance(tree.get("sequence"), list):
        tree["sequence"] = [wall for wall in tree["sequence"] if base_name(wall) != name]
    for gains in _GAINS:
        kept = {wall: value for wall, value in tree.get(gains, {}).items() if base_name(wall) != name}
        if gains in tree:
            tree[gains] = kept
            if not kept:
                del tree[gains]


def use_plan(mission_text: str, rank: int) -> Edit:
    """Replace the hits of a mission by those of a plan (`PlanRow.mission`); its other keys stay."""
    planned = Document(mission_text, f"plan {rank}").tree

    def change(tree: Tree) -> None:
        for key in _PLANNED:
            tree.pop(key, None)
        tree |= {key: planned[key] for key in (*_PLANNED, "after_impact") if key in planned}

    return Edit(f"use plan {rank}", change)


def scenario_of(tree: Tree, name: str) -> Tree:
    """Return a scenario with the room of a mission, which hits the walls of the mission in the same order.

    A mission that flies along trajectories becomes a scenario of the objective quickest, with the touches
    before its hits. Another mission with hits becomes a search over approaches, objective nearest, with the
    gains of its hits. Without a hit, the planner chooses walls, and the waypoints become visits.
    """
    found = {key: copy.deepcopy(tree[key]) for key in _SHARED if key in tree}
    found |= {"name": name, "walls": found.get("walls", {})}
    hits = [hit for hit in _list_of(tree, "collisions") if "probe" not in hit]
    along = [hit for hit in hits if "trajectory" in hit]
    if along or not hits:
        touches = [
            hit["approach"]["normal_m_s"] for hit in hits if "trajectory" not in hit and "approach" in hit
        ]
        if along:
            found["sequence"] = [hit["wall"] for hit in along]
        else:
            found |= {"sequence": "any", "visits": list(_visits_of(tree))}
        found["objective"] = "quickest"
        return found | ({"touch_m_s": min(1.0, max(0.3, -touches[0]))} if touches else {})
    found |= {
        "sequence": [hit["wall"] for hit in hits],
        "search": copy.deepcopy(_SEARCH),
        "objective": "nearest",
    }
    for hit in reversed(hits):  # the first hit of a wall decides its gains
        for gains in _GAINS:
            if gains in hit:
                found.setdefault(gains, {})[hit["wall"]] = hit[gains]
    return found


def _visits_of(tree: Tree) -> Iterator[dict[str, Any]]:
    start = tree.get("start", {}).get("position_m")
    for waypoint in _list_of(tree, "waypoints"):
        if waypoint.get("position_m") not in (None, start):
            yield {"position_m": [*waypoint["position_m"]], "within_m": 0.1}
