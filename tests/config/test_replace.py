"""`Mission.replace` gives the mission that the file would give with the same keys edited, for every key."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from dart_flight.config.document import Document, InputError, Key, dotted, iterate_leaves
from dart_flight.config.mission import Mission, load_mission, parse_mission
from dart_flight.config.vehicle import VehicleConfig, load_vehicle, packaged

MISSIONS = [
    "dual_collision",
    "find_a_wall",
    *(
        pytest.param(name, marks=pytest.mark.rest)
        for name in ("single_wall", "square", "unknown_room", "rigid_cage/single_wall")
    ),
]
ROOT = Path(__file__).parents[2]
SCHEMA = json.loads((ROOT / "docs" / "schemas" / "mission.json").read_text())


def comparable(mission: Mission) -> Mission:
    return msgspec.structs.replace(mission, source="", vehicle_source=None)


def outcome(load: Callable[..., Mission], *arguments: Any) -> Mission | str:
    """Return a mission, or the text `refused`; the two ways word some errors differently."""
    try:
        return comparable(load(*arguments))
    except InputError:
        return "refused"


def other_values(value: Any, schema: dict[str, Any]) -> Iterator[Any]:
    """Yield values other than a key's, most of which are allowed."""
    options = [o for o in schema.get("anyOf", [schema]) if o.get("type") != "null"]
    yield from (one for one in options[0].get("enum", []) if one != value)
    if isinstance(value, bool):
        yield not value
    elif isinstance(value, int | float):
        yield from (value + 0.01, 0.9 * value)
    elif isinstance(value, list) and all(isinstance(one, int | float) for one in value):
        yield [one + 0.02 for one in value]
    elif value is None and options[0].get("type") in ("number", "integer"):
        yield from (0.3, 1.2)
    elif value is None and options[0].get("type") == "array":
        yield [0.1, 0.02]


def schema_of(key: Key) -> dict[str, Any]:
    """Return the schema of a key of a mission."""
    found: dict[str, Any] = SCHEMA
    for part in key:
        found = resolved(found)
        if isinstance(part, int):
            items = found.get("items") or found.get("prefixItems") or {}
            found = items[part] if isinstance(items, list) else items
        else:
            found = found.get("properties", {}).get(part) or found.get("additionalProperties") or {}
    return dict(found)


def resolved(schema: Any) -> dict[str, Any]:
    for option in schema.get("anyOf", [schema]):
        if "$ref" in option:
            return resolved(SCHEMA["$defs"][option["$ref"].rpartition("/")[2]])
    return dict(schema)


def absent_keys(tree: Any, key: Key = ()) -> Iterator[Key]:
    """Yield the keys that the sections of a mission could have, but lack."""
    if isinstance(tree, list):
        for i, part in enumerate(tree):
            yield from absent_keys(part, (*key, i))
    if isinstance(tree, dict):
        yield from (
            (*key, name) for name in resolved(schema_of(key)).get("properties", {}) if name not in tree
        )
        for name, part in tree.items():
            yield from absent_keys(part, (*key, name))


def changes_of(tree: dict[str, Any]) -> Iterator[tuple[Key, Any]]:
    present = [(k, v) for k, v in iterate_leaves(tree, in_lists=True)]
    present += [(k, v) for k, v in iterate_leaves(tree) if isinstance(v, list)]
    for key, value in [*present, *((key, None) for key in absent_keys(tree))]:
        if key[0] not in ("vehicle", "flown"):
            yield from ((key, other) for other in other_values(value, schema_of(key)))


def edited(tree: dict[str, Any], key: Key, value: Any) -> dict[str, Any]:
    tree = copy.deepcopy(tree)
    node: Any = tree
    for part in key[:-1]:
        node = node[part]
    node[key[-1]] = value
    return tree


@pytest.mark.parametrize("name", MISSIONS)
def test_replacing_any_key_equals_editing_it(name: str) -> None:
    path = packaged("missions", *f"{name}.yaml".split("/"))
    tree = Document.load(path).tree
    vehicle = load_vehicle(path.parent / tree["vehicle"])
    mission = load_mission(path)
    found = []
    for key, value in changes_of(tree):
        by_edit = outcome(parse_mission, Document.from_tree(edited(tree, key, value)), vehicle)
        assert outcome(mission.replace, {dotted(key): value}) == by_edit, (dotted(key), value)
        found.append(by_edit)
    assert sum(one != "refused" for one in found) > 30
    assert len({one.digest for one in found if isinstance(one, Mission)}) > 25, "the changes matter"


@pytest.mark.parametrize("section", ["airframe", "flying", "imu", "detection"])
def test_replacing_any_key_of_the_vehicle_equals_editing_it(section: str) -> None:
    tree = Document.load(packaged("missions", "unknown_room.yaml")).tree
    tree["limits"] = {"motion": "position"}
    vehicle = load_vehicle()
    mission = parse_mission(Document.from_tree(tree), vehicle)
    for key, value in iterate_leaves(vehicle.to_dict()[section], (section,)):
        for other in other_values(value, {}):
            replaced = outcome(mission.replace, {f"vehicle.{dotted(key)}": other})
            changed = outcome_of_vehicle(vehicle, dotted(key), other)
            expected = changed if changed == "refused" else parse_with(tree, changed)
            assert replaced == expected, (dotted(key), other)


def outcome_of_vehicle(vehicle: VehicleConfig, key: str, value: Any) -> Any:
    try:
        return vehicle.replace({key: value})
    except InputError:
        return "refused"


def parse_with(tree: dict[str, Any], vehicle: VehicleConfig) -> Mission | str:
    return outcome(parse_mission, Document.from_tree(tree), vehicle)


def test_two_changes_one_after_the_other_equal_both_at_once() -> None:
    mission = load_mission(packaged("missions", "unknown_room.yaml"))
    first, second = {"limits.motion": "position"}, {"vehicle.airframe.contact_distance_m": 0.2}
    third = {"limits.motion": "automatic"}
    assert comparable(mission.replace(first).replace(second).replace(third)) == comparable(
        mission.replace(second | third)
    )


def test_keys_changed_in_python_are_kept_and_a_change_of_resolved_parts_is_refused() -> None:
    mission = load_mission(packaged("missions", "single_wall.yaml"))
    moved = msgspec.structs.replace(mission, walls=tuple(wall.displaced(0.1) for wall in mission.walls))
    for use in (moved.to_dict, lambda: moved.replace({"goal.hold_s": 3.0})):
        with pytest.raises(InputError, match="has changed walls of a mission without `replace`"):
            use()
    rehearsal = msgspec.structs.replace(mission, standoff_m=0.5)
    assert rehearsal.replace({"goal.hold_s": 3.0}).standoff_m == 0.5
