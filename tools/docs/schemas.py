"""The JSON Schemas of mission, scenario and configuration, from the types that the loader uses.

They use JSON Schema draft 7, which editors' YAML support understands fully. Descriptions come from the types'
docstrings: the summary describes a section, its `Attributes:` the keys.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.config.document import Key
from dart_flight.config.mission_file import MissionFile
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.config.vehicle.lock_config import NO_LOCK
from dart_flight.lab.search.scenario import ScenarioFile

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "schemas"

Schema = dict[str, Any]


def schemas() -> dict[str, Schema]:
    """Return file name -> schema."""
    return {
        "mission.json": _schema(MissionFile, "DART mission"),
        "scenario.json": _schema(ScenarioFile, "DART scenario"),
        "configuration.json": _with_no_lock(_schema(VehicleConfig, "DART vehicle configuration")),
    }


def text_of(schema: Schema) -> str:
    """Return the text of a schema's file."""
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


def meaning(schema: Schema, key: Key) -> str:
    """Return the description of a key, or that of its section, on one line."""
    found = lookup(schema, key)
    for option in (found, *found.get("anyOf", [])):
        if "description" in option:
            return str(option["description"])
        if "$ref" in option:
            return str(schema["$defs"][target(option)].get("description", ""))
    return ""


def lookup(schema: Schema, key: Key) -> Schema:
    """Return the schema of a key of a document."""
    here: Schema = schema
    for part in key:
        options = [here, *here.get("anyOf", [])]
        reference = next((option for option in options if "$ref" in option), None)
        if reference is not None:
            here = schema["$defs"][target(reference)]
        here = here["properties"][part] if "properties" in here else here["additionalProperties"]
    return here


def target(value: Schema) -> str:
    """Return the name to which a reference points."""
    return str(value["$ref"]).rpartition("/")[2]


def _schema(type_: type[msgspec.Struct], title: str) -> Schema:
    schema = _draft_7(msgspec.json.schema(type_))
    for struct in _structs(type_):
        definition = schema["$defs"][struct.__name__]
        definition["description"] = _docstring(struct)[0]
        attributes: dict[str, str] = {}
        for base in reversed(struct.__mro__):  # shared keys are in a base class
            attributes |= _docstring(base)[1]
        keys = {field.name: field.encode_name for field in msgspec.structs.fields(struct)}
        for name, text in attributes.items():
            definition["properties"][keys[name]]["description"] = text
    return {"$schema": "http://json-schema.org/draft-07/schema#", "title": title, **schema}


def _with_no_lock(schema: Schema) -> Schema:
    """Allow a lock with driver `none` and any other keys; the loader treats such a lock as no lock."""
    no_lock = {
        "type": "object",
        "properties": {"driver": {"const": NO_LOCK, "description": "the vehicle has no lock"}},
        "required": ["driver"],
    }
    schema["$defs"]["VehicleConfig"]["properties"]["lock"]["anyOf"].append(no_lock)
    return schema


def _draft_7(node: Any) -> Any:
    """Convert fixed-length lists to draft 7; everything else is already valid in draft 7."""
    if isinstance(node, list):
        return [_draft_7(item) for item in node]
    if not isinstance(node, dict):
        return node
    node = {key: _draft_7(value) for key, value in node.items()}
    if "prefixItems" in node:
        node["items"] = node.pop("prefixItems")
        node["additionalItems"] = False
    return node


def _structs(type_: type[msgspec.Struct]) -> Iterator[type[msgspec.Struct]]:
    """Yield a struct and all structs it contains, each once."""
    waiting, seen = [msgspec.inspect.type_info(type_)], set()
    while waiting:
        info = waiting.pop()
        if isinstance(info, msgspec.inspect.StructType):
            if info.cls in seen:
                continue
            seen.add(info.cls)
            yield info.cls
            waiting += [field.type for field in info.fields]
        elif isinstance(info, msgspec.inspect.UnionType):
            waiting += info.types
        elif isinstance(info, msgspec.inspect.DictType):
            waiting.append(info.value_type)
        elif isinstance(info, msgspec.inspect.TupleType):
            waiting += info.item_types
        elif isinstance(info, msgspec.inspect.ListType | msgspec.inspect.VarTupleType):
            waiting.append(info.item_type)


def _docstring(struct: type) -> tuple[str, dict[str, str]]:
    """Return the text before `Attributes:`, and the text of every attribute."""
    summary, _, listed = inspect.cleandoc(struct.__doc__ or "").partition("\nAttributes:\n")
    attributes: dict[str, str] = {}
    names: list[str] = []
    for line in listed.splitlines():
        start = re.match(r" {4}([a-z][a-z0-9_, ]*): (.+)$", line)
        if start:
            names = [name.strip() for name in start[1].split(",")]
            attributes |= dict.fromkeys(names, start[2])
        else:
            for name in names:
                attributes[name] += " " + line.strip()
    return " ".join(summary.split()), attributes


def write() -> None:
    """Write the files of docs/schemas."""
    FOLDER.mkdir(exist_ok=True)
    for name, schema in schemas().items():
        (FOLDER / name).write_text(text_of(schema), encoding="utf-8")
