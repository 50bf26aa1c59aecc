"""Writes the tables of channels into `docs/log.md`, from the schemas that every log carries.

python -m tools.log_page
"""

from __future__ import annotations

from pathlib import Path

from dart_flight.recording.schema import INPUTS, NOTES, OUTPUTS, schema
from dart_flight.samples import Record

PAGE = Path(__file__).resolve().parents[1] / "docs" / "log.md"
BEGIN, END = "<!-- begin: python -m tools.log_page -->\n", "<!-- end -->"
_GROUPS = (
    ("Inputs of the flight core", INPUTS),
    ("Outputs of the flight core", OUTPUTS),
    ("Truth and timing, beside the core", NOTES),
)


def tables() -> str:
    """Every channel with its fields, their types, units and frames, as Markdown."""
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


def with_tables(page: str) -> str:
    """The page with today's tables between its marks.

    Raises:
        ValueError: the marks are not there.
    """
    start, end = page.index(BEGIN) + len(BEGIN), page.index(END)
    return f"{page[:start]}{tables()}{page[end:]}"


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
