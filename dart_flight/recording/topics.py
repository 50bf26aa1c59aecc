"""The records of a log as arrays: one `Topic` per channel, with the names of the fields."""

from __future__ import annotations

import types
from collections.abc import Iterable, Iterator
from enum import Enum
from typing import Any, NamedTuple, Union, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.base.records import Record
from dart_flight.config.document import suggest_known
from dart_flight.recording.flight_time import find_zero
from dart_flight.recording.schema import RECORD_TYPES

_BY_TOPIC = {kind.topic: kind for kind in RECORD_TYPES}


class Topic:
    """The records of one channel: one array per field, with one entry per record.

    A number has shape (n,); a vector or a list of constant length, such as the motors, has shape (n, k). A
    missing value is NaN, so integers and booleans that may be missing are floats. The array of
    a string field contains strings. If a string may be None, or a field is a list of varying length, the
    array's elements are Python objects. The names of the fields state units and frames (docs/log.md).

    Attributes:
        kind: the type of the records.
        records: the records.
        t_s: array (n,) of autopilot times, in seconds since the flight's zero (`recording.flight_time`). A
            record without a stamp has the time of the previous record.
    """

    def __init__(self, kind: type[Record], records: list[Record], t_s: NDArray[np.float64]) -> None:
        self.kind, self.records, self.t_s = kind, records, t_s
        self._made: dict[str, NDArray[Any]] = {}

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields."""
        return self.kind.__struct_fields__

    def __len__(self) -> int:
        return len(self.records)

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self.fields:
            raise KeyError(f"{self.kind.topic} has no field {name}{suggest_known(name, self.fields)}")
        if name not in self._made:
            values = [getattr(record, name) for record in self.records]
            self._made[name] = _array(values, get_type_hints(self.kind)[name])
        return self._made[name]

    def __getattr__(self, name: str) -> NDArray[Any]:
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(error.args[0]) from None

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.fields]

    def __repr__(self) -> str:
        return f"<{self.kind.topic}: {len(self)} records of {', '.join(self.fields)}>"


class Topics:
    """The channels of a log; `names` lists the channels that have records."""

    def __init__(self, records: Iterable[Record]) -> None:
        found: dict[type[Record], list[Record]] = {}
        stamps: dict[type[Record], list[int]] = {}
        everything = list(records)
        t_us = zero_us = find_zero(everything)
        for record in everything:
            t_us = getattr(record, "t_us", 0) or t_us
            kind = type(record)
            if kind not in found:
                found[kind], stamps[kind] = [], []
            found[kind].append(record)
            stamps[kind].append(t_us)
        self._topics = {
            kind.topic: Topic(kind, rows, np.array([(t - zero_us) * 1e-6 for t in stamps[kind]], dtype=float))
            for kind, rows in found.items()
        }
        self.names = tuple(sorted(self._topics))

    def __getitem__(self, name: str) -> Topic:
        if name not in _BY_TOPIC:
            raise KeyError(f"no channel {name}{suggest_known(name, _BY_TOPIC)}")
        if name not in self._topics:
            return Topic(_BY_TOPIC[name], [], np.empty(0))
        return self._topics[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)


class _Kind(NamedTuple):
    """The type of a field: type of its value or elements, length, and whether a value may be missing."""

    type: Any
    length: int | None
    optional: bool


def _kind(hint: Any) -> _Kind:
    optional = False
    if get_origin(hint) in (Union, types.UnionType):
        optional = True
        (hint,) = (part for part in get_args(hint) if part is not types.NoneType)
    if get_origin(hint) is tuple:
        parts = get_args(hint)
        return _Kind(parts[0], None, True) if Ellipsis in parts else _Kind(parts[0], len(parts), optional)
    return _Kind(hint, 0, optional)


def _array(values: list[Any], hint: Any) -> NDArray[Any]:
    kind = _kind(hint)
    if kind.length is None:
        lengths = {len(value) for value in values}
        if kind.type is float and len(lengths) < 2:
            return np.array(values, dtype=float).reshape(len(values), max(lengths, default=0))
        return _objects(values)
    if kind.length:
        missing = (np.nan,) * kind.length
        rows = [missing if value is None else value for value in values]
        return np.array(rows, dtype=float).reshape(-1, kind.length)
    if kind.type in (int, float, bool):
        if kind.optional or kind.type is float:
            return np.array([np.nan if value is None else value for value in values], dtype=float)
        return np.array(values, dtype=kind.type)
    if isinstance(kind.type, type) and issubclass(kind.type, msgspec.Struct):  # a record within a record
        return _objects(values)
    words = [value.value if isinstance(value, Enum) else value for value in values]
    return _objects(words) if kind.optional else np.array(words, dtype=np.str_)


def _objects(values: list[Any]) -> NDArray[Any]:
    array = np.empty(len(values), dtype=object)
    array[:] = values
    return array
