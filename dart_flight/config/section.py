"""Base of all sections that are read from YAML files.

The meaning of a key is written once, under `Attributes:` in the docstring of its section, next to its type.
`make docs` copies the meaning to the JSON Schemas, the tables in docs/ and the comments of configs/dart.yaml.
The docstring states what the key's name does not: meaning, sign, frame, effect of null, and perhaps unit. If
a key's type is itself a section, the docstring of that section may explain the key; the key then needs no
entry.

A key that is added later has a default, for files and logs without this key. If the key changes decisions,
the default keeps the old behaviour, and the shipped configurations set the better value.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
from msgspec import Meta

# Every number has two bounds, which catch wrong units (130 for 0.13). These bounds are the defaults.
Seconds = Annotated[float, Meta(gt=0.0, le=600.0)]
SecondsOrZero = Annotated[float, Meta(ge=0.0, le=600.0)]
Metres = Annotated[float, Meta(gt=0.0, le=100.0)]
Speed = Annotated[float, Meta(gt=0.0, le=30.0)]
Volts = Annotated[float, Meta(gt=0.0, le=100.0)]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of every section of a file: immutable, without unknown keys."""


def without_defaults(value: Any) -> Any:
    """Return a value as plain dictionaries and lists, without the fields whose value is the default."""
    if isinstance(value, msgspec.Struct):
        fields = msgspec.structs.fields(value)
        kept = {f.name: getattr(value, f.name) for f in fields if getattr(value, f.name) != _default_of(f)}
        return {name: without_defaults(one) for name, one in kept.items()}
    if isinstance(value, Mapping):
        return {str(key): without_defaults(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [without_defaults(one) for one in value]
    return msgspec.to_builtins(value)


def _default_of(field: msgspec.structs.FieldInfo) -> Any:
    if field.default_factory is not msgspec.NODEFAULT:
        return field.default_factory()
    return field.default


def shared_keys(section: Section, kind: type[Section]) -> dict[str, Any]:
    """Return names and values of the section's keys that `kind` defines.

    The conversion from a file to its resolved form uses this function, so that the conversion loses no key.
    """
    return {name: getattr(section, name) for name in kind.__struct_fields__}
