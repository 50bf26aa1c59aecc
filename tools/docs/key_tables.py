"""The tables of keys for `docs/missions.md`, `docs/planning.md` and `docs/configuration.md`, from the
schemas.

Missions and scenarios have one table per section. The configuration has one row per key, with the value in
`configs/dart.yaml` and the source from the comment there.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import msgspec

from dart_flight.config.document import Document, Key, dotted
from tools.docs.configuration_comments import CONFIGURATION, sources
from tools.docs.schemas import Schema, lookup, meaning, schemas, target

# --- mission and scenario ------------------------------------------------------------------------------


def mission_tables() -> str:
    """Return the tables of every section of a mission file."""
    return "".join(_sections(schemas()["mission.json"], known=set()))


def scenario_tables() -> str:
    """Return the tables of the sections that a scenario has and a mission lacks."""
    return "".join(_sections(schemas()["scenario.json"], known=set(schemas()["mission.json"]["$defs"])))


def _sections(schema: Schema, known: set[str]) -> Iterator[str]:
    """Yield a table per section, in the order of first mention."""
    places = {target(schema): ""}
    waiting = list(places)
    while waiting:
        struct = waiting.pop(0)
        definition = schema["$defs"][struct]
        yield _section(definition, places[struct])
        for name, value in definition["properties"].items():
            for reference in re.findall(r"#/\$defs/(\w+)", msgspec.json.encode(value).decode()):
                if reference not in places and reference not in known | {"Mode"}:
                    if "properties" in schema["$defs"][reference]:
                        waiting.append(reference)
                    places[reference] = f"{places[struct]}{name}{_nested(value)}."


def _section(definition: Schema, place: str) -> str:
    required = set(definition["required"]) if "required" in definition else set()
    title = f"`{place[:-1]}`" if place else "The file"
    rows = [
        f"**{title}**: {definition['description']}\n",
        "| key | value | default | meaning |",
        "|---|---|---|---|",
    ]
    for name, value in sorted(definition["properties"].items(), key=lambda item: item[0] not in required):
        default = "required" if name in required else _default(value)
        rows.append(f"| `{name}` | {_kind(value)} | {default} | {_cell(value.get('description', ''))} |")
    return "\n".join(rows) + "\n\n"


def _nested(value: Schema) -> str:
    return ".NAME" if "additionalProperties" in value else "[i]" if value.get("type") == "array" else ""


def _default(value: Schema) -> str:
    default = value.get("default")
    if default in (None, {}):
        return "-"
    if isinstance(default, list | tuple):
        return ", ".join(f"`{item}`" for item in default)
    return "see below" if isinstance(default, dict) else f"`{default}`"


def _kind(value: Schema) -> str:
    if "anyOf" in value:
        return " or ".join(_kind(option) for option in value["anyOf"] if option.get("type") != "null")
    if "enum" in value:
        return ", ".join(f"`{item}`" for item in value["enum"])
    if "$ref" in value:
        definition = _definitions()[target(value)]
        return _kind(definition) if "enum" in definition else "section"
    kind = value.get("type")
    if kind == "array":
        items = value["items"]
        if isinstance(items, list):
            return f"{len(items)} numbers{_limits(items[0])}"
        return f"list of {_kind(items)}" + ("s" if _kind(items) == "section" else "")
    if kind == "object":
        return (
            f"name: {_kind(value['additionalProperties'])}"
            if "additionalProperties" in value
            else "keys and values"
        )
    words = {"number": "number", "integer": "whole number", "string": "text", "boolean": "`true`, `false`"}
    return words[str(kind)] + _limits(value)


def _limits(value: Schema) -> str:
    bounds = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    found = [f"{sign} {value[name]:g}" for name, sign in bounds.items() if name in value]
    return f" {', '.join(found)}" if found else ""


def _definitions() -> dict[str, Schema]:
    return {name: definition for schema in schemas().values() for name, definition in schema["$defs"].items()}


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


# --- configuration -------------------------------------------------------------------------------------


def configuration_table() -> str:
    """Return a row per key of the configuration, shipped keys first in each section."""
    text = CONFIGURATION.read_text(encoding="utf-8")
    tree, schema = Document(text, CONFIGURATION.name).tree, schemas()["configuration.json"]
    rows = ["| key | shipped | allowed | meaning | source of the shipped value |", "|---|---|---|---|---|"]
    return "\n".join([*rows, *_configuration_rows((), tree, schema, sources(text))]) + "\n"


def _configuration_rows(
    section: Key, tree: dict[str, Any], schema: Schema, named: dict[Key, str]
) -> Iterator[str]:
    """Yield the rows of a section; a key that the shipped file lacks has its default in parentheses."""
    absent = {name: value for name, value in _keys_of(section, schema).items() if name not in tree}
    for name in (*tree, *absent):
        key, inner = (*section, name), tree[name] if isinstance(tree.get(name), dict) else {}
        words = f"{_cell(meaning(schema, key))} | {_cell(named.get(key, ''))}"
        if inner:
            yield f"| **`{dotted(key)}`** | | | {words} |"
        else:
            default = absent.get(name, {}).get("default", "required")
            shown = _shown(tree[name]) if name in tree else f"({_shown(default)})"
            yield f"| `{dotted(key)}` | {shown} | {_kind(lookup(schema, key))} | {words} |"
        yield from _configuration_rows(key, inner, schema, named)


def _keys_of(section: Key, schema: Schema) -> dict[str, Schema]:
    """Return the schemas of a section's keys by name; none if the user chooses the names."""
    found = lookup(schema, section)
    for option in (found, *found.get("anyOf", [])):
        if "$ref" in option:
            properties: dict[str, Schema] = schema["$defs"][target(option)].get("properties", {})
            return properties
    return {}


def _shown(value: Any) -> str:
    return "null" if value is None else msgspec.json.encode(value).decode().strip('"')
