"""The input fields of an object of the open file, each with the edit that it makes; no viser in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

from dart_flight.lab.studio import edits
from dart_flight.lab.studio.objects import SECTIONS, entry_of, key_of
from dart_flight.lab.studio.open_file import Edit, Tree


class Field(NamedTuple):
    """A field of the panel.

    Attributes:
        value: present value; text for a name or a choice.
        edit: returns the edit that sets the value.
        options: the allowed values of a choice.
        step: step of a number's arrows; its digits are not limited.
    """

    label: str
    value: float | str
    edit: Callable[[Any], Edit]
    options: tuple[str, ...] = ()
    step: float = 0.01
    hint: str = ""


def _or_none(value: float) -> float | None:
    return value or None


class _NumberSpec(NamedTuple):
    """A number of an entry; it is shown if the dictionary or list that contains it exists."""

    path: tuple[str | int, ...]
    label: str
    step: float = 0.01
    default: float = 0.0
    hint: str = ""
    written: Callable[[float], float | None] = float


def _at(name: str) -> tuple[_NumberSpec, _NumberSpec]:
    return _NumberSpec((name, 0), "x, m"), _NumberSpec((name, 1), "y, m")


_WALL = (
    *_at("point_m"),
    _NumberSpec(("length_m",), "length, m", 0.1),
    _NumberSpec(
        ("position_sd_m",), "position ±, m", hint="standard deviation along the normal", written=_or_none
    ),
    _NumberSpec(("yaw_sd_deg",), "direction ±, °", 0.5, 0.0, "standard deviation; 0: not given", _or_none),
)
_NUMBERS = {
    "wall": _WALL,
    "simulated": _WALL,
    "post": (*_at("centre_m"), _NumberSpec(("radius_m",), "radius, m")),
    "start": (*_at("position_m"), _NumberSpec(("altitude_m",), "altitude, m", 0.1)),
    "goal": (
        *_at("position_m"),
        _NumberSpec(("capture_radius_m",), "radius, m", 0.05, 0.15),
        _NumberSpec(("hold_s",), "hold, s", 0.5, 2.0),
    ),
    "waypoint": (
        *_at("position_m"),
        _NumberSpec(("altitude_m",), "altitude, m", 0.1, 0.0, "0: unchanged", _or_none),
        _NumberSpec(("speed_m_s",), "speed, m/s", 0.1, 0.0, "0: the configuration's transit speed", _or_none),
        _NumberSpec(("after",), "after hits", 1.0, written=int),
    ),
    "visit": (*_at("position_m"), _NumberSpec(("within_m",), "within, m", 0.05)),
    "corner": tuple(
        _NumberSpec((axis, i), f"{axis} {end}, m", 0.1)
        for axis in "xyz"
        for i, end in enumerate(("low", "high"))
    ),
    "hit": (
        _NumberSpec(("approach", "normal_m_s"), "normal, m/s", 0.05, -1.0, "negative is towards the wall"),
        _NumberSpec(
            ("approach", "tangential_m_s"),
            "tangential, m/s",
            0.05,
            hint="velocity along the wall, positive to the right when looking along the normal",
        ),
    ),
}


def object_ids(tree: Tree) -> list[str]:
    """Return the ids of all objects of a mission or scenario that the panel can show."""
    found = ["start", "goal"]
    for kind, section in SECTIONS.items():
        entries = tree.get(section)
        names = range(len(entries)) if isinstance(entries, list) else entries
        found += [f"{kind}/{name}" for name in names or ()]
    return [one for one in [*found, "corner/0"] if entry_of(tree, one) is not None]


def fields_of(tree: Tree, object_id: str, materials: Sequence[str], modes: Sequence[str]) -> list[Field]:
    """Return the fields of an object; of a part that is not as the format demands, no field."""
    entry = entry_of(tree, object_id)
    return list(_fields(tree, object_id, entry, materials, modes)) if isinstance(entry, dict) else []


def _fields(
    tree: Tree, object_id: str, entry: dict[str, Any], materials: Sequence[str], modes: Sequence[str]
) -> Iterator[Field]:
    kind, _, name = object_id.partition("/")
    key = key_of(object_id)
    if kind in ("wall", "post"):
        yield Field("name", name, lambda v: edits.rename(object_id, str(v).strip()))
    if kind == "hit":
        walls = [str(one) for section in ("walls", "posts") for one in tree.get(section) or ()]
        for part, options in (("wall", walls), ("mode", modes)):
            if options:
                yield _choice((*key, part), entry, options)
    for i, number in enumerate(_NUMBERS[kind]):
        if i == 2 and "normal" in entry:
            yield from _direction(object_id, entry["normal"])
        inside, last = _inside(entry, number.path), number.path[-1]
        if isinstance(inside, dict):
            value = inside.get(last, number.default)
        elif isinstance(inside, list) and isinstance(last, int) and len(inside) == 2:
            value = inside[last]
        else:
            continue
        yield Field(
            number.label,
            float(value) if isinstance(value, int | float) else number.default,
            lambda v, number=number: edits.set_value((*key, *number.path), number.written(v)),  # type: ignore[misc]
            step=number.step,
            hint=number.hint,
        )
    if "material" in entry:
        yield _choice((*key, "material"), entry, materials)


def _inside(entry: Any, path: tuple[str | int, ...]) -> Any:
    for part in path[:-1]:
        entry = entry.get(part) if isinstance(entry, dict) else None
    return entry


def _direction(object_id: str, normal: Any) -> Iterator[Field]:
    if isinstance(normal, list) and len(normal) == 2:
        yaw = round(math.degrees(math.atan2(normal[1], normal[0])), 6)
        hint = "direction of the normal, which points into free space, counter-clockwise from x"
        yield Field("direction, °", yaw, partial(edits.turn_wall, object_id), step=1.0, hint=hint)


def _choice(key: tuple[Any, ...], entry: dict[str, Any], options: Sequence[str]) -> Field:
    value = str(entry.get(key[-1], options[0] if options else ""))
    allowed = tuple(options) if value in options else (value, *options)
    return Field(str(key[-1]), value, partial(edits.set_value, key), allowed)
