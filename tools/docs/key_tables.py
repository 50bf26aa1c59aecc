"""The tables of keys for `docs/missions.md`, `docs/planning.md` and `docs/configuration.md`, from the
schemas.

Missions and scenarios have one table per section. The configuration has one row per key of
`configs/dart.yaml`, with its value and the source from its comment.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import msgspec

from dart_flight.config.document import Document, dotted
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
    """Return a row per key of the shipped configuration."""
    text = CONFIGURATION.read_text(encoding="utf-8")
    document, named = Document(text, CONFIGURATION.name), sources(text)
    schema = schemas()["configuration.json"]
    rows = ["| key | shipped | allowed | meaning | source of the shipped value |", "|---|---|---|---|---|"]
    for key in document.lines:
        value: Any = document.tree
        for part in key:
            value = value[part]
        if not key or isinstance(key[-1], int):
            continue
        words = f"{_cell(meaning(schema, key))} | {_cell(named.get(key, ''))}"
        if isinstance(value, dict):
            rows.append(f"| **`{dotted(key)}`** | | | {words} |")
            continue
        shown = "null" if value is None else msgspec.json.encode(value).decode().strip('"')
        rows.append(f"| `{dotted(key)}` | {shown} | {_kind(lookup(schema, key))} | {words} |")
    return "\n".join(rows) + "\n"
