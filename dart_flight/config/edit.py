"""Replacement of single values in a YAML file; comments, order and spacing are preserved."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import yaml

from dart_flight.config.document import (
    Document,
    InputError,
    Key,
    read_text,
    replace_file,
    report_write_errors,
)


def edit_values(text: str, values: Mapping[Key, float], source: str = "") -> str:
    """Return a YAML text in which numbers replace the values at the given keys; comments keep their columns.

    An integer in a key is an index into a list, from 0. Every key must exist and have a scalar value.
    """
    Document(text, source)  # apply the rules for reading: no aliases, no duplicate keys
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    spots = [(_scalar(root, key, source), _number(value)) for key, value in values.items()]
    for node, number in sorted(spots, key=lambda spot: -spot[0].start_mark.index):
        start, end = node.start_mark.index, node.end_mark.index
        rest = text[end:]
        gap = len(rest) - len(rest.lstrip(" "))
        if rest[gap : gap + 1] == "#":
            gap_wanted = max(1, gap + (end - start) - len(number))
            rest = " " * gap_wanted + rest[gap:]
        text = text[:start] + number + rest
    return text


def write_values(path: Path, values: Mapping[Key, float]) -> None:
    """Replace numbers in a YAML file atomically; see `edit_values`."""
    with report_write_errors(path):
        replace_file(path, edit_values(read_text(path), values, str(path)).encode("utf-8"))


def _number(value: float) -> str:
    text = f"{value:.10g}"
    return text if any(c in text for c in ".en") or isinstance(value, int) else f"{text}.0"


def _scalar(root: yaml.Node | None, key: Key, source: str) -> yaml.ScalarNode:
    node = root
    for part in key:
        if isinstance(node, yaml.SequenceNode) and isinstance(part, int):
            node = node.value[part] if 0 <= part < len(node.value) else None
            continue
        children = node.value if isinstance(node, yaml.MappingNode) else []
        node = next((value for name, value in children if name.value == part), None)
    if not isinstance(node, yaml.ScalarNode) or not node.value:
        raise InputError(
            "the command replaces the value of this key, but the file has no such value",
            source=source,
            key=key,
        )
    return node
