"""Records to JSON and back without losing a bit, also where a number is not finite.

JSON has no word for NaN: such numbers are written as the strings "nan", "inf", "-inf". Every other
float comes back as it was, because its shortest decimal form is written.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar

import msgspec

from dart_flight.base.records import Record

R = TypeVar("R", bound=Record)

_ENCODER = msgspec.json.Encoder()
_WORDS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def encode(record: Record) -> bytes:
    """A record as JSON; two records are equal bit for bit where their encodings are."""
    data = _ENCODER.encode(record)
    nulls = data.count(b"null")
    # Either a value that may be missing or a number that is not finite: the fast encoder writes both alike.
    if not nulls or nulls == sum(getattr(record, field) is None for field in record.__struct_fields__):
        return data
    return _ENCODER.encode(_spell(msgspec.structs.asdict(record)))


def decode(data: bytes, decoder: msgspec.json.Decoder[R]) -> R:
    """A record from `encode`.

    Raises:
        msgspec.MsgspecError: it is none of the decoder's type.
    """
    try:
        return decoder.decode(data)
    except msgspec.ValidationError:
        return msgspec.convert(_numbers(msgspec.json.decode(data)), decoder.type)


def _spell(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    if isinstance(value, dict):
        return {key: _spell(part) for key, part in value.items()}
    if isinstance(value, tuple | list):
        return [_spell(part) for part in value]
    return value


def _numbers(value: Any) -> Any:
    if isinstance(value, str):
        return _WORDS.get(value, value)
    if isinstance(value, dict):
        return {key: _numbers(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_numbers(part) for part in value]
    return value
