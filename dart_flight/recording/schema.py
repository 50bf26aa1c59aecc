"""Self-description of the log: a JSON Schema per kind of record, with the unit and frame of every number.

The only source is `base/records.py`: a record's docstring describes the record, the comment on a line
describes the field, and the name's end gives unit and frame (`FRAMES`). Foxglove and PlotJuggler show the
description.
"""

from __future__ import annotations

import inspect
import re
import types
from functools import cache
from typing import Any, Union, get_args, get_origin, get_type_hints

import msgspec

from dart_flight.base.records import Input, Note, Output, Record
from dart_flight.config.units import unit_from_name

INPUTS: tuple[type[Record], ...] = get_args(Input)
OUTPUTS: tuple[type[Record], ...] = get_args(Output)
NOTES: tuple[type[Record], ...] = get_args(Note)
RECORD_TYPES: tuple[type[Record], ...] = (*INPUTS, *OUTPUTS, *NOTES)

# The ending of a field's name determines the frame; the longest matching ending counts.
FRAMES = {
    "_frd_to_ned": "rotation body FRD to world NED, (w, x, y, z)",
    "_body_to_room": "rotation marker body to room, (w, x, y, z)",
    "_room": "motion-capture room (docs/motion_capture.md)",
    "_ned": "local NED: north, east, down",
    "_frd": "body FRD: forward, right, down",
    "_frd_nm": "body FRD: forward, right, down",
    "_mission": "mission frame: x along its heading, y left, z up",
    "_ned_rad": "heading, clockwise from north",
}
# Units of names that do not end with a unit, by the beginning of the name.
QUANTITIES = {
    "position_": "m",
    "velocity_": "m/s",
    "acceleration_": "m/s2",
    "specific_force_": "m/s2",
    "rate_": "rad/s",
    "force_": "N",
    "contact_force_": "N",
    "torque_": "N m",
    "contact_torque_": "N m",
    "q_": "unit quaternion",
    "motors": "0 (stopped) to 1",
    "normal": "unit vector, mission frame",
    "battery_remaining": "0 (empty) to 1",
}
CLOCKS = {
    "received_us": "host's monotonic clock",
    "trigger_received_us": "host's monotonic clock",
    "host_us": "host's monotonic clock",
    "sent_us": "host's monotonic clock",
    "offset_us": "autopilot's clock minus the host's",
    "latency_us": "a duration",
}


def describe(name: str, comment: str = "") -> str:
    """Return a field's unit, frame and comment; unit, clock and frame follow from the name."""
    parts = [_unit(name), _frame(name), comment]
    return "; ".join(part for part in parts if part)


def _longest(name: str, table: dict[str, str], ends: bool) -> str:
    fits = [key for key in table if (name.endswith(key) if ends else name.startswith(key))]
    return table[max(fits, key=len)] if fits else ""


def _unit(name: str) -> str:
    if name.endswith("_us"):
        return f"microseconds, {CLOCKS.get(name, 'autopilot clock')}"
    return unit_from_name(name) or _longest(name, QUANTITIES, ends=False)


def _frame(name: str) -> str:
    return _longest(name, FRAMES, ends=True)


@cache
def _comments(kind: type[Record]) -> dict[str, str]:
    """Return the comments on the fields' lines, or nothing if the source is not installed."""
    try:
        source = inspect.getsource(kind)
    except OSError:
        return {}
    return dict(re.findall(r"^ {4}(\w+): .*?  # (.*)$", source, re.MULTILINE))


def schema(kind: type[Record]) -> dict[str, Any]:
    """Return the JSON Schema of a record.

    Foxglove refuses references and unions, so the schema contains none. No field is required: a message omits
    the values that are missing.
    """
    properties = {}
    for name, type_ in get_type_hints(kind).items():
        if name not in kind.__struct_fields__:
            continue
        plain = _plain(type_)
        text = describe(name, _comments(kind).get(name, ""))
        properties[name] = {**plain, "description": text} if text else plain
    return {
        "title": kind.__name__,
        "description": " ".join((kind.__doc__ or "").split()),
        "type": "object",
        "properties": properties,
    }


def _plain(type_: Any) -> dict[str, Any]:
    if get_origin(type_) in (Union, types.UnionType):  # a value that may be missing; see `encoding`
        return _plain(next(part for part in get_args(type_) if part is not type(None)))
    if get_origin(type_) is tuple:
        return {"type": "array", "items": _plain(get_args(type_)[0])}
    if isinstance(type_, type) and issubclass(type_, msgspec.Struct):
        hints = get_type_hints(type_)
        return {"type": "object", "properties": {n: _plain(hints[n]) for n in type_.__struct_fields__}}
    names = {float: "number", int: "integer", bool: "boolean"}
    return {"type": names.get(type_, "string")}
