"""The tables of channels for `docs/log.md`, from the schemas in every log."""

from __future__ import annotations

from dart_flight.base.records import Record
from dart_flight.recording.schema import INPUTS, NOTES, OUTPUTS, schema

_GROUPS = (
    ("Inputs of the flight core", INPUTS),
    ("Outputs of the flight core", OUTPUTS),
    ("Truth and timing, beside the core", NOTES),
)


def tables() -> str:
    """Return every channel with its fields, their types, units and frames, as Markdown."""
    lines: list[str] = []
    for title, kinds in _GROUPS:
        lines += ["", f"### {title}", ""]
        for kind in kinds:
            lines += _channel(kind)
    return "\n".join(lines[1:]) + "\n"


def _channel(kind: type[Record]) -> list[str]:
    described = schema(kind)
    lines = [f"**`{kind.topic}`**, {kind.__name__}. {described['description']}", ""]
    lines += ["| field | type | unit, frame, meaning |", "|---|---|---|"]
    for name, value in described["properties"].items():
        type_ = value["type"] if value["type"] != "array" else f"array of {value['items']['type']}"
        meaning = value.get("description", "").replace("|", "\\|")
        lines.append(f"| `{name}` | {type_} | {meaning} |")
    return [*lines, ""]
