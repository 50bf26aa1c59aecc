"""Descriptions of the log's fields are derived from their names."""

import enum
import json
import types
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import jsonschema
import msgspec
import pytest

from dart_flight.base.records import Record
from dart_flight.recording.encoding import decode, encode
from dart_flight.recording.schema import RECORD_TYPES, describe, schema


@pytest.mark.parametrize(
    ("name", "description"),
    [
        ("normal", "unit vector, mission frame"),
        ("normal_force_n", "N"),
        ("normal_in_m_s", "m/s"),
        ("torque_sigma_nm", "N m"),
        ("force_mission", "N; mission frame"),
    ],
)
def test_a_unit_suffix_takes_precedence_over_the_quantity(name: str, description: str) -> None:
    assert describe(name).startswith(description)


FOXGLOVE_TYPES = ("boolean", "string", "number", "integer", "object", "array")


def fill(kind: Any, missing: bool) -> Any:
    """Return a value of a type; optional fields are missing, or filled, in nested records too."""
    options = get_args(kind)
    if get_origin(kind) in (Union, types.UnionType):
        return None if missing else fill(options[0], missing)
    if get_origin(kind) in (tuple, list):
        return get_origin(kind)(fill(part, missing) for part in options if part is not Ellipsis)
    if get_origin(kind) in (Literal, Annotated):
        return options[0] if get_origin(kind) is Literal else fill(options[0], missing)
    if issubclass(kind, msgspec.Struct):
        return kind(**{f.name: fill(f.type, missing) for f in msgspec.structs.fields(kind)})
    if issubclass(kind, enum.Enum):
        return next(iter(kind))
    return kind(1)


@pytest.mark.parametrize("missing", [True, False])
@pytest.mark.parametrize("kind", RECORD_TYPES)
def test_a_record_matches_its_own_schema_and_is_read_back(kind: type[Record], missing: bool) -> None:
    record = fill(kind, missing)
    jsonschema.validate(json.loads(encode(record)), schema(kind))
    assert decode(encode(record), msgspec.json.Decoder(kind)) == record


@pytest.mark.parametrize("kind", RECORD_TYPES)
def test_every_schema_has_only_single_types(kind: type[Record]) -> None:
    """Foxglove shows no message of a topic whose schema has alternatives."""

    def check(part: dict[str, Any]) -> None:
        assert part["type"] in FOXGLOVE_TYPES
        for nested in (*part.get("properties", {}).values(), *([part["items"]] if "items" in part else [])):
            check(nested)

    check(schema(kind))
