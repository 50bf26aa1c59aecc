"""Lossless conversion of records to JSON and back, including numbers that are not finite.

JSON has no NaN and no infinity. These numbers become the strings "nan", "inf" and "-inf". Every other float
is written as the shortest decimal number that is read back as exactly the same float.

A value that is None is omitted. The schema of the log cannot allow null: Foxglove rejects a topic if its
schema has a type with alternatives.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, TypeVar, get_args

import msgspec

from dart_flight.base.records import Record

R = TypeVar("R", bound=Record)

_ENCODER = msgspec.json.Encoder()
_WORDS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def encode(record: Record) -> bytes:
    """Return a record as JSON; two records have equal JSON if and only if they are equal bit for bit."""
    data = _ENCODER.encode(record)
    # The fast encoder writes null for a missing value and for a number that is not finite.
    return _ENCODER.encode(_spell(msgspec.to_builtins(record))) if b"null" in data else data


def decode(data: bytes, decoder: msgspec.json.Decoder[R]) -> R:
    """Return the record in `data`; raise msgspec.MsgspecError if the data has another type."""
    try:
        return decoder.decode(data)
    except msgspec.ValidationError:
        return msgspec.convert(_restore(msgspec.json.decode(data), decoder.type), decoder.type)


def _spell(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    if isinstance(value, dict):
        return {key: _spell(part) for key, part in value.items() if part is not None}
    if isinstance(value, tuple | list):
        return [_spell(part) for part in value]
    return value


def _restore(value: Any, kind: Any) -> Any:
    """Restore omitted None values and spelled numbers, including those in nested records."""
    if isinstance(value, list):
        return [_restore(part, kind) for part in value]
    parts = list(_parts(kind))
    if isinstance(value, str):
        return _WORDS.get(value, value) if float in parts and str not in parts else value
    struct = next((part for part in parts if isinstance(part, type(msgspec.Struct))), None)
    if struct is None or not isinstance(value, dict):
        return value
    fields = {field.name: field for field in msgspec.structs.fields(struct)}
    missing = {name: None for name, field in fields.items() if field.required}
    return missing | {
        name: _restore(part, fields[name].type) for name, part in value.items() if name in fields
    }


def _parts(kind: Any) -> Iterator[Any]:
    yield kind
    for part in get_args(kind):
        yield from _parts(part)
