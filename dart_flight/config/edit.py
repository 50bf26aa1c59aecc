"""Edits of a YAML file that change only the edited entries; comments, order and spacing stay."""

from __future__ import annotations

import copy
import difflib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import yaml

from dart_flight.config.document import (
    Document,
    InputError,
    Key,
    read_text,
    replace_file,
    report_write_errors,
)

_INDENT: Final = 2  # spaces by which a new block is indented


def edit_values(text: str, values: Mapping[Key, float], source: str = "") -> str:
    """Return a YAML text in which numbers replace the values at the given keys; comments keep their columns.

    An integer in a key is an index into a list, from 0. Every key must exist and have a scalar value.
    """
    wanted = copy.deepcopy(Document(text, source).tree)
    for key, value in values.items():
        at: Any = wanted
        for part in key[:-1]:
            at = _child(at, part, key, source)
        if isinstance(_child(at, key[-1], key, source), dict | list):
            raise _no_value(key, source)
        at[key[-1]] = value
    return update_text(text, wanted, source)


def write_values(path: Path, values: Mapping[Key, float]) -> None:
    """Replace numbers in a YAML file atomically; see `edit_values`."""
    with report_write_errors(path):
        replace_file(path, edit_values(read_text(path), values, str(path)).encode("utf-8"))


def _child(tree: Any, part: str | int, key: Key, source: str) -> Any:
    inside = isinstance(tree, list) and isinstance(part, int) and 0 <= part < len(tree)
    if inside or (isinstance(tree, dict) and part in tree):
        return tree[part]
    raise _no_value(key, source)


def _no_value(key: Key, source: str) -> InputError:
    message = "the command replaces the value of this key, but the file has no such value"
    return InputError(message, source=source, key=key)


def update_text(text: str, wanted: Mapping[str, Any], source: str = "") -> str:
    """Return a YAML text with the wanted values; unchanged entries keep their bytes.

    A comment on its own line belongs to the entry below it, and is moved or deleted with this entry. A key
    that is replaced by another key at the same place is renamed.

    Raises:
        InputError: the text is not YAML as `Document` reads it.
    """
    present = Document(text, source).tree
    if not wanted or not present:
        return text if not wanted and not present else (_block(wanted, 0) or "{}") + "\n"
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    assert root is not None
    begin, end = _Editor(text).span(root)
    return text[:begin] + _Editor(text).updated(root, present, wanted) + text[end:]


class _Entry(NamedTuple):
    """An entry of a mapping or list in the text.

    Attributes:
        key: key of a mapping's entry; None in a list.
        name: node of the key.
        node: node of the value.
        begin: index of the key's first character, or of the dash before a block list's item.
    """

    key: str | None
    name: yaml.Node | None
    node: yaml.Node
    begin: int


class _Editor:
    """Edits of one text."""

    def __init__(self, text: str) -> None:
        self._text = text

    def span(self, node: yaml.Node) -> tuple[int, int]:
        """Return where a node begins and ends.

        A block begins with the comments above its first entry, and ends with the line of its last entry.
        """
        if not _is_block(node):
            end: int = node.end_mark.index
            if isinstance(node, yaml.ScalarNode) and node.style in ("|", ">"):
                end = len(self._text[:end].rstrip("\n"))
            return node.start_mark.index, end
        entries = self._entries(node)
        line_end = self._text.find("\n", self.span(entries[-1].node)[1])
        return self._comments_above(entries[0].begin), len(self._text) if line_end < 0 else line_end

    def updated(self, node: yaml.Node, present: Any, wanted: Any) -> str:
        """Return the text of the node alone, with the wanted value."""
        begin, end = self.span(node)
        if _equal(present, wanted):
            return self._text[begin:end]
        same_kind = isinstance(wanted, type(present)) and isinstance(wanted, dict | list)
        if not (same_kind and present and wanted):
            column = node.start_mark.column if _is_block(node) else None
            return _flow(wanted) if column is None or not _nests(wanted) else _block(wanted, column)
        if _is_block(node):
            return self._updated_block(node, present, wanted)
        return self._updated_flow(node, present, wanted)

    # -- flow collections: braces and brackets --

    def _updated_flow(self, node: yaml.Node, present: Any, wanted: Any) -> str:
        entries = self._entries(node)
        begin, end = self.span(node)
        first, last = entries[0].begin, self.span(entries[-1].node)[1]
        steps = list(_steps(present, wanted))
        pieces = [self._flow_entry(entries, present, wanted, step) for step in steps]
        inner = ", ".join(piece for piece in pieces if piece is not None)
        if all(step.old is not None and step.new is not None for step in steps):  # keep the separators
            ends = [self.span(entry.node)[1] for entry in entries]
            gaps = [self._text[a : b.begin] for a, b in zip(ends, entries[1:], strict=False)]
            inner = "".join(f"{piece}{gap}" for piece, gap in zip(pieces, [*gaps, ""], strict=True))
        return self._text[begin:first] + inner + self._text[last:end]

    def _flow_entry(self, entries: list[_Entry], present: Any, wanted: Any, step: _EntryStep) -> str | None:
        if step.new is None:
            return None
        if step.old is None:
            return (f"{_scalar(step.new)}: " if isinstance(step.new, str) else "") + _flow(wanted[step.new])
        entry = entries[step.position]
        return self._head(entry, step) + self.updated(entry.node, present[step.old], wanted[step.new])

    def _head(self, entry: _Entry, step: _EntryStep) -> str:
        """Return the text from the beginning of an entry to its value; a renamed entry gets its new key."""
        begin = self.span(entry.node)[0]
        if entry.name is None or step.new == step.old:
            return self._text[entry.begin : begin]
        return _scalar(step.new) + self._text[entry.name.end_mark.index : begin]

    # -- block collections: one entry in each line --

    def _updated_block(self, node: yaml.Node, present: Any, wanted: Any) -> str:
        entries = self._entries(node)
        column = self._column(entries[0].begin)
        begins = [self._comments_above(entry.begin) for entry in entries]
        end = self.span(node)[1]
        chunks = list[str]()
        for step in _steps(present, wanted):
            if step.new is None:
                continue
            if step.old is None:
                chunks.append(self._new_entry(entries[0], step.new, wanted[step.new], column))
                continue
            entry, i = entries[step.position], step.position
            begin, value_end = self.span(entry.node)
            until = self._line_start(begins[i + 1]) - 1 if i + 1 < len(entries) else end
            value = self.updated(entry.node, present[step.old], wanted[step.new])
            tail = self._text[value_end:until]
            if "\n" not in value + self._text[begin:value_end]:
                tail = _with_comment(tail, value_end - begin - len(value))
            head = self._head(entry, step)
            if _is_block(entry.node) and value[:1] in "{[" and "#" not in head:
                head = head.rstrip()
            if value and head[-1:] in ":-":
                head += " "
            if value[:1] not in "{[" and _nests(wanted[step.new]) and not _is_block(entry.node):
                value = "\n" + " " * (column + _INDENT) + _block(wanted[step.new], column + _INDENT)
                head = head.rstrip()
            chunks.append(self._text[begins[i] : entry.begin] + head + value + tail)
        return ("\n" + " " * column).join(chunks)

    def _new_entry(self, sibling: _Entry, key: Any, value: Any, column: int) -> str:
        if sibling.key is None:
            return f"- {_flow(value)}"
        return _block({key: value}, column)

    def _entries(self, node: yaml.Node) -> list[_Entry]:
        if isinstance(node, yaml.MappingNode):
            return [_Entry(k.value, k, v, k.start_mark.index) for k, v in node.value]
        if _is_block(node):
            return [_Entry(None, None, n, self._text.rindex("-", 0, self.span(n)[0])) for n in node.value]
        return [_Entry(None, None, n, n.start_mark.index) for n in node.value]

    def _line_start(self, index: int) -> int:
        return self._text.rfind("\n", 0, index) + 1

    def _column(self, index: int) -> int:
        return index - self._line_start(index)

    def _comments_above(self, index: int) -> int:
        """Return the beginning of the comments directly above an entry, at the entry's column."""
        column, begin = self._column(index), index
        if self._text[self._line_start(index) : index].strip():  # the line begins with a dash
            return index
        while (line := self._line_start(begin)) > 0:
            above = self._line_start(line - 1)
            text = self._text[above : line - 1]
            if above == 0 or len(text) - len(text.lstrip(" ")) != column or not text.lstrip().startswith("#"):
                break
            begin = above + column
        return begin


class _EntryStep(NamedTuple):
    """The change of one entry; for an inserted entry `old` is None, for a deleted entry `new` is None.

    Attributes:
        old, new: key or index of the entry.
        position: number of the entry in the present collection, from 0.
    """

    old: Any
    new: Any
    position: int


def _steps(present: Any, wanted: Any) -> Iterator[_EntryStep]:
    """Yield the changes from the present to the wanted entries, in the order of the text."""
    if isinstance(present, dict):
        # Keys that exist already keep their order.
        order = [key for key in present if key in wanted]
        new = order + [key for key in wanted if key not in present]
        if [key for key in wanted if key in present] == order:
            new = list(wanted)
        old = list(present)
        a, b = [str(key) for key in old], [str(key) for key in new]
    else:
        old, new = list(range(len(present))), list(range(len(wanted)))
        a, b = (
            [json.dumps(x, sort_keys=True) for x in present],
            [json.dumps(x, sort_keys=True) for x in wanted],
        )
    for _, a0, a1, b0, b1 in difflib.SequenceMatcher(None, a, b, autojunk=False).get_opcodes():
        pairs = min(a1 - a0, b1 - b0)
        yield from (_EntryStep(old[a0 + i], new[b0 + i], a0 + i) for i in range(pairs))
        yield from (_EntryStep(old[i], None, i) for i in range(a0 + pairs, a1))
        yield from (_EntryStep(None, new[i], -1) for i in range(b0 + pairs, b1))


def _is_block(node: yaml.Node) -> bool:
    return isinstance(node, yaml.CollectionNode) and not node.flow_style and bool(node.value)


def _equal(a: Any, b: Any) -> bool:
    """Return whether two values are equal as YAML: 1 and 1.0 are, True and 1 are not."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(_equal(a[key], b[key]) for key in a)
    if isinstance(a, list) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(_equal(x, y) for x, y in zip(a, b, strict=True))
    return isinstance(a, bool) == isinstance(b, bool) and bool(a == b)


def _with_comment(tail: str, shorter: int) -> str:
    """Return the text after a value; if the value gets shorter, a comment in this text keeps its column."""
    gap = len(tail) - len(tail.lstrip(" "))
    if tail[gap : gap + 1] != "#":
        return tail
    return " " * max(min(gap, 2), gap + shorter) + tail[gap:]


# --- new text ----------------------------------------------------------------------------------------


def _nests(value: Any) -> bool:
    """Return whether to write a value in several lines: True for a list or mapping of mappings only."""
    inner: Sequence[Any] = list(value.values()) if isinstance(value, dict) else value
    return isinstance(value, dict | list) and bool(inner) and all(isinstance(one, dict) for one in inner)


def _block(value: Any, column: int) -> str:
    """Return lines of a mapping or list; the first line has no indentation, the others begin at `column`."""
    join = "\n" + " " * column
    if isinstance(value, list):
        return join.join(f"- {_flow(one)}" for one in value)
    below = column + _INDENT
    return join.join(
        f"{_scalar(key)}:\n{' ' * below}{_block(one, below)}"
        if _nests(one)
        else f"{_scalar(key)}: {_flow(one)}"
        for key, one in value.items()
    )


def _flow(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_scalar(key)}: {_flow(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_flow(one) for one in value) + "]"
    return _scalar(value)


def _scalar(value: Any) -> str:
    if isinstance(value, str):
        plain = (
            value.strip() == value and value.isprintable() and not set(value) & set(",[]{}:#&*!|>'\"%@`?\n")
        )
        try:
            if plain and Document(f"a: [{value}]", "").tree == {"a": [value]}:
                return value
        except InputError:
            pass
        quoted = json.dumps(value, ensure_ascii=False)
        return "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in quoted)
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    text = f"{value:.10g}"
    return text if isinstance(value, int) or any(c in text for c in ".en") else f"{text}.0"
