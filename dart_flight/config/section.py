"""Base of everything that is read from a YAML file.

A key's meaning stands once: under `Attributes:` in the docstring of its section, beside the types. From
there it goes into the JSON Schemas, the tables in docs/ and the comments of configs/dart.yaml (`make docs`).
It says what the key's name does not: what is meant, sign and frame, what null does; the unit where the name
has none. A key whose type is a section needs none where the section's own docstring says it.

A key that comes later has a default: what files and logs without it mean. Where the key changes what is
decided, that is the value with which nothing changes, and the shipped configurations say the better one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
from msgspec import Meta

# Every number has two ends: what lies beyond is a slip of the unit (130 for 0.13) or of the key.
# Where a key's own range is not known better, these hold.
Seconds = Annotated[float, Meta(gt=0.0, le=600.0)]
SecondsOrZero = Annotated[float, Meta(ge=0.0, le=600.0)]
Metres = Annotated[float, Meta(gt=0.0, le=100.0)]
Speed = Annotated[float, Meta(gt=0.0, le=30.0)]
Volts = Annotated[float, Meta(gt=0.0, le=100.0)]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of every part of a file: frozen, unknown keys refused."""


def without_defaults(value: Any) -> Any:
    """Return a value as plain dictionaries and lists, without the fields that have their default."""
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


def keys_of(section: Section, kind: type[Section]) -> dict[str, Any]:
    """The values of the keys that a section shares with others of its kind, by name.

    What a file and what is made of it share goes both ways through this, so that no key is forgotten on one.
    """
    return {name: getattr(section, name) for name in kind.__struct_fields__}
