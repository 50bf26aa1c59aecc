"""Lossless conversion of records to JSON and back, including numbers that are not finite.

JSON has no NaN and no infinity. These numbers become the strings "nan", "inf" and "-inf". Every other float
is written as the shortest decimal number that is read back as exactly the same float.

A value that is None is left out. The schema of the log cannot allow null: Foxglove refuses a topic if its
schema has a type with alternatives.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar, get_args

import msgspec

from dart_flight.base.records import Record

R = TypeVar("R", bound=Record)

_ENCODER = msgspec.json.Encoder()
_WORDS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def encode(record: Record) -> bytes:
    """Return a record as JSON. Two records have equal JSON exactly if the records are equal bit for bit."""
    data = _ENCODER.encode(record)
    # The fast encoder writes null for a missing value and for a number that is not finite.
    return _ENCODER.encode(_spell(msgspec.to_builtins(record))) if b"null" in data else data


def decode(data: bytes, decoder: msgspec.json.Decoder[R]) -> R:
    """Return the record that `data` encodes.

    Raises:
        msgspec.MsgspecError: the data are not a record of the decoder's type.
    """
    try:
        return decoder.decode(data)
    except msgspec.ValidationError:
        return msgspec.convert(_complete(_numbers(msgspec.json.decode(data)), decoder.type), decoder.type)


def _spell(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    if isinstance(value, dict):
        return {key: _spell(part) for key, part in value.items() if part is not None}
    if isinstance(value, tuple | list):
        return [_spell(part) for part in value]
    return value


def _complete(value: Any, kind: Any) -> Any:
    """Add None for each field without a default that `encode` has left out, also in nested records."""
    if isinstance(value, list):
        return [_complete(part, kind) for part in value]
    structs = [part for part in (kind, *get_args(kind)) if isinstance(part, type(msgspec.Struct))]
    if not isinstance(value, dict) or not structs:
        return value
    for field in msgspec.structs.fields(structs[0]):
        if field.name in value:
            value[field.name] = _complete(value[field.name], field.type)
        elif field.required:
            value[field.name] = None
    return value


def _numbers(value: Any) -> Any:
    if isinstance(value, str):
        return _WORDS.get(value, value)
    if isinstance(value, dict):
        return {key: _numbers(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_numbers(part) for part in value]
    return value
