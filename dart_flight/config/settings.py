"""Changes of keys in a vehicle configuration or a mission before validation: `--set` and `replace`."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from typing import Any

from dart_flight.config.document import Document, InputError, Key, to_plain, unknown_name


def apply_settings(settings: Sequence[str], *documents: Document) -> list[Document]:
    """Change documents in place and return those that were changed.

    A setting changes the first document that contains the first part of the setting's key. `Document.convert`
    later rejects a value of the wrong type; its error names the setting.

    Args:
        settings: `KEY=VALUE` with a dotted key, such as `detection.force_threshold_n=8`,
            `materials.wood.rigid.k=5000` or `collisions[0].alpha_m_per_n=[0.1, 0.02]`.
        documents: a vehicle configuration and optionally a mission.

    Raises:
        InputError: a key is unknown, or a setting is not `KEY=VALUE`.
    """
    changed: list[Document] = []
    for setting in settings:
        key, value = _parse_setting(setting)
        document = next((d for d in documents if key[0] in _settable(d)), None)
        if document is None:
            known = sorted({name for d in documents for name in _settable(d)})
            raise InputError(f"--set {setting}: {unknown_name(str(key[0]), known, 'key')}")
        _set(document, key, value, f"--set {setting}")
        changed.append(document)
    return changed


def apply_changes(changes: Mapping[str, Any], document: Document) -> None:
    """Change a document in place, from Python; a missing section is created.

    Args:
        changes: value by dotted key, as in `--set`.

    Raises:
        InputError: a key is unknown, or a file cannot store a value.
    """
    for name, value in changes.items():
        key, setting = _key(name), f"{name}={value!s:.60}"
        if not key:
            raise InputError(f"{name!r} is not a key")
        _set(document, key, to_plain(value, key), setting)


def _settable(document: Document) -> set[str]:
    return set(document.tree) - {"version", "vehicle"}


def _parse_setting(setting: str) -> tuple[Key, Any]:
    name, equals, text = setting.partition("=")
    key = _key(name)
    if not equals or not key or not text.strip():
        raise InputError(f"--set {setting}: expected KEY=VALUE, such as detection.force_threshold_n=8")
    try:
        value = Document(f"value: {text}", "--set").tree["value"]
    except InputError as error:
        raise InputError(f"--set {setting}: {error.message}") from None
    return key, value


def _key(name: str) -> Key:
    """Return the parts of a key such as `collisions[0].mode`."""
    parts = re.findall(r"[^.\[\]]+", name.strip())
    return tuple(int(part) if part.isdigit() else part for part in parts)


def _set(document: Document, key: Key, value: Any, setting: str) -> None:
    """Set a value in a document; error messages quote `setting`, as the user wrote it."""
    document.set_by.pop(key, None)  # a dict keeps a key's old place, so remove the key first
    document.set_by[key] = setting
    node: Any = document.tree
    for part in key[:-1]:
        node = _child(node, part, setting)
    last = key[-1]
    if isinstance(node, list):
        _child(node, last, setting)
        node[int(last)] = value
    elif isinstance(node, dict):
        node[str(last)] = value
    else:
        raise InputError(f"{setting}: there is no key below {key[-2]}")


def _child(node: Any, part: str | int, setting: str) -> Any:
    if isinstance(node, dict) and node.get(str(part)) is not None:
        return node[str(part)]
    if isinstance(node, dict) and (
        str(part) in node or not difflib.get_close_matches(str(part), list(map(str, node)))
    ):
        # The section is missing or null. The conversion to the type decides later whether it may exist.
        node[str(part)] = {}
        return node[str(part)]
    if isinstance(node, list) and isinstance(part, int) and part < len(node):
        return node[part]
    if isinstance(node, list):
        raise InputError(f"{setting}: unknown key {part}, known: 0 to {len(node) - 1}")
    raise InputError(f"{setting}: {unknown_name(str(part), list(node or ()), 'key')}")
