"""The comments of `configs/dart.yaml`: meaning of every key and source of its value.

A comment is `MEANING [tag] source`. `make docs` writes the meaning and keeps the rest, which is written by
hand. Names that the user chooses (materials) and the keys of their sections have no comment.
"""

from __future__ import annotations

import re
import textwrap
from typing import NamedTuple

from dart_flight.config.document import Document, Key
from tools.docs.schemas import ROOT, Schema, lookup, meaning, schemas

CONFIGURATION = ROOT / "configs" / "dart.yaml"
_SOURCE = re.compile(r"\[(?:paper|maker|px4|ours|example)\].*")
_COLUMN, _WIDTH = 40, 110


class _Line(NamedTuple):
    """A key's line: its first row, the row after its comment, its code, and its comment."""

    first: int
    end: int
    code: str
    comment: str

    @property
    def source(self) -> str:
        """The handwritten part of the comment."""
        found = _SOURCE.search(self.comment)
        return found[0] if found else ""


def sources(text: str) -> dict[Key, str]:
    """Return key -> tag and source of its value."""
    return {key: line.source for key, line in _lines(text).items() if line.source}


def current(text: str) -> str:
    """Return the configuration with up-to-date comments."""
    schema = schemas()["configuration.json"]
    rows = text.splitlines()
    # Start with the last line, so that earlier row numbers stay valid.
    for key, line in reversed(_lines(text).items()):
        words = "" if _is_below_a_name(schema, key) else meaning(schema, key).removesuffix(".")
        rows[line.first : line.end] = _written(line.code, words, line.source)
    return "\n".join(rows) + "\n"


def write() -> None:
    """Write the file."""
    CONFIGURATION.write_text(current(CONFIGURATION.read_text("utf-8")), "utf-8")


def _lines(text: str) -> dict[Key, _Line]:
    """Return every key that begins a line, with its comment, including continuation lines."""
    rows = text.splitlines()
    found: dict[Key, _Line] = {}
    for key, number in Document(text, CONFIGURATION.name).lines.items():
        row = rows[number - 1]
        # In a flow mapping on one line, the comment belongs to the key that begins the line.
        if not key or not row.lstrip().startswith(f"{key[-1]}:"):
            continue
        code, _, comment = row.partition(" #")
        end = number
        while end < len(rows) and rows[end].lstrip().startswith("#"):
            comment += " " + rows[end].lstrip("# ")
            end += 1
        found[key] = _Line(number - 1, end, code.rstrip(), comment.strip())
    return found


def _is_below_a_name(schema: Schema, key: Key) -> bool:
    return any("additionalProperties" in lookup(schema, key[:length]) for length in range(1, len(key)))


def _written(code: str, words: str, source: str) -> list[str]:
    column = max(_COLUMN, len(code) + 2)
    width = _WIDTH - column - 2
    parts = textwrap.wrap(words, width, break_long_words=False, break_on_hyphens=False)
    if parts and len(parts[-1]) + 1 + len(source) <= width:
        parts[-1] = f"{parts[-1]} {source}".rstrip()
    else:  # the tag begins a line
        parts += textwrap.wrap(source, width, break_long_words=False, break_on_hyphens=False)
    if not parts:
        return [code]
    return [f"{code if i == 0 else '':<{column}}# {part}" for i, part in enumerate(parts)]
