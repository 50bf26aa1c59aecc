"""The objects of a mission or scenario by id, such as `wall/acrylic` or `hit/0`, and their keys.

Ids are `wall/NAME`, `simulated/NAME`, `post/NAME`, `start`, `goal`, `waypoint/I`, `visit/I`, `hit/I` (I
counts from 0) and `corner/I`, a corner of the bounds.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Any

from dart_flight.base.walls import BACK, FRONT
from dart_flight.config.document import InputError, Key

SECTIONS = {
    "wall": "walls",
    "simulated": "simulated_walls",
    "post": "posts",
    "waypoint": "waypoints",
    "visit": "visits",
    "hit": "collisions",
}
_LISTS = ("waypoint", "visit", "hit")
_BY_NUMBER = re.compile(r"(?:.*_)?(\d+)$")


def key_of(object_id: str) -> Key:
    """Return the key of an object's entry in the file; a corner's entry is `bounds_m`."""
    kind, _, name = object_id.partition("/")
    if kind in SECTIONS:
        return (SECTIONS[kind], int(name) if kind in _LISTS else name)
    return ("bounds_m",) if kind == "corner" else (kind,)


def object_of(key: Key) -> str:
    """Return the object whose entry contains a key of the file, or ""."""
    section, *rest = key or ("",)
    if section in ("start", "goal"):
        return str(section)
    if section == "bounds_m":
        return "corner/0"
    kind = next((kind for kind, name in SECTIONS.items() if name == section), "")
    return f"{kind}/{rest[0]}" if kind and rest else ""


def entry_of(tree: Any, object_id: str) -> Any:
    """Return the value of an object in the file, or None if it does not exist."""
    try:
        for part in key_of(object_id):
            tree = tree[part]
    except (KeyError, IndexError, TypeError):
        return None
    return tree


def existing_entry(tree: Any, object_id: str) -> dict[str, Any]:
    """Return the keys and values of an object; raise InputError if it does not exist."""
    found = entry_of(tree, object_id)
    if not isinstance(found, dict):
        raise InputError(f"{describe(object_id)} does not exist")
    return found


def describe(object_id: str) -> str:
    """Return an object in words, such as `wall acrylic`, `hit 2` or `the goal`."""
    kind, _, name = object_id.partition("/")
    if kind not in SECTIONS:
        return "the bounds" if kind == "corner" else f"the {kind}"
    return f"{'simulated wall' if kind == 'simulated' else kind} {int(name) + 1 if kind in _LISTS else name}"


def base_name(wall: str) -> str:
    """Return the entry of a wall, for a partition's face without the face."""
    return wall.removesuffix(FRONT).removesuffix(BACK)


def objects_in_finding(item: str, message: str, walls: Collection[str], posts: Collection[str]) -> list[str]:
    """Return the objects that a finding of `check` concerns, the most important first."""
    found = list[str]()
    number = _BY_NUMBER.match(item)
    if item.startswith("waypoint_") and item.endswith("_clearance"):
        found.append(f"waypoint/{int(item.split('_')[1]) - 1}")
    elif item.endswith("_clearance") or item == "goal":
        found.append(item.removesuffix("_clearance"))
    elif number is not None:
        found.append(f"hit/{int(number[1]) - 1}")
    named = [("wall", name) for name in walls] + [("post", name) for name in posts]
    found += [
        f"{kind}/{name}"
        for kind, name in named
        if re.search(rf"\b{kind}s? ([^,:;]* and )?{re.escape(name)}(?![\w-])", message)
    ]
    return list(dict.fromkeys(found))
