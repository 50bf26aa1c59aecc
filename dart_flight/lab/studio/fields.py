"""The input fields of an object of the open file, each with the edit that it makes; no viser in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from dart_flight.config.document import Key
from dart_flight.lab.studio import edits
from dart_flight.lab.studio.objects import describe, entry_of, key_of
from dart_flight.lab.studio.open_file import Edit, Tree


class Field(NamedTuple):
    """A field of the panel.

    Attributes:
        value: present value; text for a choice.
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


def object_ids(tree: Tree) -> list[str]:
    """Return the ids of all objects of a mission or scenario that the panel can show."""
    found = ["start", "goal"]
    for section, kind in (
        ("walls", "wall"),
        ("simulated_walls", "simulated"),
        ("posts", "post"),
        ("waypoints", "waypoint"),
        ("visits", "visit"),
        ("collisions", "hit"),
    ):
        entries = tree.get(section)
        names: Sequence[Any] = list(entries) if isinstance(entries, dict) else ()
        if isinstance(entries, list):
            names = range(len(entries))
        found += [f"{kind}/{name}" for name in names]
    return [one for one in [*found, "corner/0"] if entry_of(tree, one) is not None]


def fields_of(tree: Tree, object_id: str, materials: Sequence[str], modes: Sequence[str]) -> list[Field]:
    """Return the fields of an object; of a part that is not as the format demands, no field."""
    entry, key, kind = entry_of(tree, object_id), key_of(object_id), object_id.partition("/")[0]
    if not isinstance(entry, dict):
        return []
    reader = _KeyReader(entry, key)
    if kind == "corner":
        return [
            Field(
                f"{axis} {('low', 'high')[i]}, m",
                float(entry[axis][i]),
                lambda v, axis=axis, i=i: edits.set_value(("bounds_m", axis, i), v),  # type: ignore[misc]
                step=0.1,
            )
            for axis in "xyz"
            for i in (0, 1)
            if isinstance(entry.get(axis), list) and len(entry[axis]) == 2
        ]
    if kind == "hit":
        return _hit_fields(tree, object_id, entry, modes)
    found = list[Field]()
    if kind in ("wall", "post"):
        name = object_id.partition("/")[2]
        found.append(Field("name", name, lambda v: edits.rename(object_id, str(v).strip())))
    found += _place_fields(reader)
    if kind in ("wall", "simulated"):
        normal = entry.get("normal")
        if isinstance(normal, list) and len(normal) == 2:
            yaw = math.degrees(math.atan2(normal[1], normal[0]))
            hint = "direction of the normal, which points into free space, counter-clockwise from x"
            turn = Field(
                "direction, °", round(yaw, 6), lambda v: edits.turn_wall(object_id, v), (), 1.0, hint
            )
            found.append(turn)
        found += [
            reader.number("length_m", "length, m", 0.1),
            reader.choice("material", "material", materials),
            reader.optional("position_sd_m", "position ±, m", 0.01, "standard deviation along the normal"),
            reader.optional("yaw_sd_deg", "direction ±, °", 0.5, "standard deviation; 0: not given"),
        ]
    elif kind == "post":
        found += [
            reader.number("radius_m", "radius, m", 0.01),
            reader.choice("material", "material", materials),
        ]
    elif kind == "start":
        found.append(reader.number("altitude_m", "altitude, m", 0.1))
    elif kind == "goal":
        found += [
            reader.number("capture_radius_m", "radius, m", 0.05, 0.15),
            reader.number("hold_s", "hold, s", 0.5, 2.0),
        ]
    elif kind == "waypoint":
        found += [
            reader.optional("altitude_m", "altitude, m", 0.1, "0: the altitude does not change"),
            reader.optional("speed_m_s", "speed, m/s", 0.1, "0: the configuration's transit speed"),
            reader.number("after", "after hits", 1.0, 0.0, whole=True),
        ]
    elif kind == "visit":
        found.append(reader.number("within_m", "within, m", 0.05))
    return found


def _place_fields(reader: _KeyReader) -> list[Field]:
    name = next((k for k in ("point_m", "centre_m", "position_m") if k in reader.entry), "")
    place, key = reader.entry.get(name), (*reader.key, name)
    if not isinstance(place, list) or len(place) != 2:
        return []
    return [
        Field("x, m", float(place[0]), lambda v: edits.set_value((*key, 0), v)),
        Field("y, m", float(place[1]), lambda v: edits.set_value((*key, 1), v)),
    ]


def _hit_fields(tree: Tree, object_id: str, entry: dict[str, Any], modes: Sequence[str]) -> list[Field]:
    number, approach = int(object_id.partition("/")[2]) + 1, entry.get("approach")
    walls = [str(name) for section in ("walls", "posts") for name in tree.get(section) or ()]
    wall, mode = str(entry.get("wall")), entry.get("mode")
    names = walls if wall in walls else [wall, *walls]
    found = [Field("wall", wall, lambda v: edits.set_hit(number, wall=v), tuple(names))]
    if modes:
        known = mode if mode in modes else modes[0]
        found.append(Field("mode", str(known), lambda v: edits.set_hit(number, mode=v), tuple(modes)))
    if isinstance(approach, dict):
        found += [
            Field(
                "normal, m/s",
                float(approach.get("normal_m_s", -1.0)),
                lambda v: edits.set_hit(number, normal_m_s=v),
                step=0.05,
                hint="velocity along the wall's normal; negative is towards the wall",
            ),
            Field(
                "tangential, m/s",
                float(approach.get("tangential_m_s", 0.0)),
                lambda v: edits.set_hit(number, tangential_m_s=v),
                step=0.05,
                hint="velocity along the wall, positive to the right when looking along the normal",
            ),
        ]
    return found


class _KeyReader(NamedTuple):
    """Makes the fields of single keys of an entry."""

    entry: dict[str, Any]
    key: Key

    def number(
        self, name: str, label: str, step: float, default: float = 0.0, *, whole: bool = False
    ) -> Field:
        value, key = self.entry.get(name, default), (*self.key, name)
        shown = float(value) if isinstance(value, int | float) else default
        return Field(label, shown, lambda v: edits.set_value(key, int(v) if whole else v), step=step)

    def optional(self, name: str, label: str, step: float, hint: str) -> Field:
        value, key = self.entry.get(name), (*self.key, name)
        shown = float(value) if isinstance(value, int | float) else 0.0
        return Field(label, shown, lambda v: edits.set_value(key, v or None), step=step, hint=hint)

    def choice(self, name: str, label: str, options: Sequence[str]) -> Field:
        value, key = str(self.entry.get(name)), (*self.key, name)
        allowed = tuple(options) if value in options else (value, *options)
        return Field(label, value, lambda v: edits.set_value(key, v), allowed)


def label_of(object_id: str) -> str:
    """Return an object as the panel's list shows it."""
    return describe(object_id).removeprefix("the ")
