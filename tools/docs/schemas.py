"""The JSON Schemas of mission, scenario and configuration, from the types that the loader uses.

JSON Schema draft 7, because that is what editors' YAML support understands fully. Descriptions are the
types' docstrings: the summary for a section, its `Attributes:` for the keys; for keys of the configuration
without one, the comment beside the key in `configs/dart.yaml`.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.config.document import Document, Key
from dart_flight.config.mission import MissionFile
from dart_flight.config.scenario import ScenarioFile
from dart_flight.config.vehicle import VehicleConfig

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "schemas"
CONFIGURATION = ROOT / "configs" / "dart.yaml"

Schema = dict[str, Any]


def schemas() -> dict[str, Schema]:
    """File name -> schema."""
    configuration = _schema(VehicleConfig, "DART vehicle configuration")
    for key, text in comments(CONFIGURATION.read_text(encoding="utf-8")).items():
        _describe(configuration, key, text)
    return {
        "mission.json": _schema(MissionFile, "DART mission"),
        "scenario.json": _schema(ScenarioFile, "DART scenario"),
        "configuration.json": configuration,
    }


def text_of(schema: Schema) -> str:
    """The file's text."""
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


def comments(text: str) -> dict[Key, str]:
    """Key -> the comment on its line and on comment lines that go on from there, of a YAML file."""
    rows = text.splitlines()
    found: dict[Key, str] = {}
    for key, number in Document(text, "").lines.items():
        match = re.search(r"\s# ?(.*)$", rows[number - 1])
        # Of a flow mapping on one line only the key that begins the line owns the comment.
        name = str(key[-1]) if key else ""
        if match is None or not rows[number - 1].lstrip().startswith(f"{name}:"):
            continue
        words = [match[1]]
        for row in rows[number:]:
            if not row.lstrip().startswith("#"):
                break
            words.append(row.lstrip("# "))
        found[key] = " ".join(words)
    return found


def _schema(type_: type[msgspec.Struct], title: str) -> Schema:
    schema = _draft_7(msgspec.json.schema(type_))
    for struct in _structs(type_):
        definition = schema["$defs"][struct.__name__]
        summary, attributes = _docstring(struct)
        definition["description"] = summary
        for name, text in attributes.items():
            definition["properties"][name]["description"] = text
    return {"$schema": "http://json-schema.org/draft-07/schema#", "title": title, **schema}


def _draft_7(node: Any) -> Any:
    """Fixed-length lists as draft 7 writes them; all else is the same there."""
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
    """A struct and all that it is made of, each once."""
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


def _docstring(struct: type[msgspec.Struct]) -> tuple[str, dict[str, str]]:
    """What is said before `Attributes:`, and the text of every attribute in it."""
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


def _describe(schema: Schema, key: Key, text: str) -> None:
    """Give a key of the document a description, unless its type has one or the type is used elsewhere too."""
    struct = schema["$ref"].rpartition("/")[2]
    for part in key[:-1]:
        options = schema["$defs"][struct]["properties"].get(part, {})
        reference = next((r for r in re.findall(r"#/\$defs/(\w+)", json.dumps(options))), None)
        if reference is None or "additionalProperties" in options:
            return
        struct = reference
    if json.dumps(schema).count(f'"#/$defs/{struct}"') == 1:
        schema["$defs"][struct]["properties"][key[-1]].setdefault("description", text)


def write() -> None:
    """Write the files of docs/schemas."""
    FOLDER.mkdir(exist_ok=True)
    for name, schema in schemas().items():
        (FOLDER / name).write_text(text_of(schema), encoding="utf-8")
