"""PX4 parameter files in QGroundControl's format, and their comparison with a vehicle's parameters.

A line is `vehicle-id component-id name value type`, separated by tabs, with type 6 for INT32 and 9 for
REAL32. Lines that start with # are comments. In the packaged files, a comment above each parameter gives the
reason for the parameter's value. If some builds of PX4 lack the parameter under this name, a separate
comment line lists these builds:

- `#? absent before v1.16` or `#? absent after v1.17`: these versions do not need the parameter.
- `#? absent without gyro_fft`: builds without the gyro_fft module do not need the parameter. - `#? renamed
NAME after v1.17`: these versions have the parameter under the name NAME.

`after v1.17` includes development versions of v1.18.
"""

from __future__ import annotations

import contextlib
import math
import re
import struct
from collections.abc import Iterable, Mapping
from enum import StrEnum
from pathlib import Path

import msgspec

from dart_flight.config.document import InputError, read_text
from dart_flight.config.vehicle import packaged

Value = int | float
Version = tuple[int, int]  # PX4's major and minor version

_TYPES = {"6": int, "9": float}
PX4_NAME = re.compile(r"[A-Z][A-Z0-9_]{0,15}\Z")
AUTOPILOT_COMPONENT = "1"  # component id, as written in a file
_INT32 = 1 << 31
_LISTED = re.compile(r"^\s*[x ] [ *+](?: [ l])? (?P<name>[A-Z][A-Z0-9_]*) \[.*\] : (?P<value>\S+)\s*$")
_COLUMNS = re.compile(r"#\s*vehicle-id\s+component-id\s+name\s+value\b", re.IGNORECASE)
_VERSIONS = re.compile(
    r"#\?\s*(absent|renamed\s+(?P<name>[A-Z][A-Z0-9_]{0,15}))"
    r"\s+(?P<where>(?:before|after) v\d+\.\d+|without [a-z][a-z0-9_]*)$"
)


class PositionSource(StrEnum):
    """Source of PX4's position."""

    MOCAP = "mocap"  # motion capture
    RTK = "rtk"  # GPS with corrections
    PLAIN = "plain"  # GPS without corrections
    ANCHORED = "anchored"  # GPS without corrections, but contacts with walls correct the frame


_PLACE_FILES = {
    PositionSource.MOCAP: ("indoor",),
    PositionSource.RTK: ("outdoor",),
    PositionSource.PLAIN: ("outdoor", "plain_gps"),
    PositionSource.ANCHORED: ("outdoor", "plain_gps", "anchored_gps"),
}


class Parameter(msgspec.Struct, frozen=True):
    """One PX4 parameter of a file.

    Attributes:
        name: PX4's name, at most 16 characters.
        value: desired value; an int for INT32, a float for REAL32.
        reason: comment lines directly above the parameter's line, joined; empty without a comment.
        absent: builds of PX4 that do not have the parameter under this name, such as "before v1.16" or
            "without gyro_fft"; empty for none.
        renamed: name of the parameter in the builds of `absent`; or None if these builds do not need the
            parameter.
        tolerance: maximum difference from the vehicle's value at which the values still count as equal.
    """

    name: str
    value: Value
    reason: str
    absent: str = ""
    renamed: str | None = None
    tolerance: float = 0.0

    def is_absent_in(self, version: Version | None) -> bool:
        """Return whether a PX4 version lacks the parameter under this name, whatever its modules."""
        when, _, release = self.absent.partition(" v")
        if version is None or not release:
            return False
        major, minor = release.split(".")
        return version < (int(major), int(minor)) if when == "before" else version > (int(major), int(minor))


class ParameterFile(msgspec.Struct, frozen=True):
    """A parameter file.

    Attributes:
        parameters: the autopilot's parameters by name, in the file's order.
        skipped: number of rows of other components than the autopilot, by component id.
        vehicles: ids of the vehicles in the file.
    """

    parameters: dict[str, Parameter]
    skipped: dict[str, int] = {}
    vehicles: frozenset[str] = frozenset()


class ParameterDifference(msgspec.Struct, frozen=True):
    """A parameter of the vehicle that differs from the file; `actual` is None for a missing parameter."""

    name: str
    wanted: Value
    actual: float | None
    reason: str

    def line(self) -> str:
        shown = "not on this vehicle" if self.actual is None else show_value(self.actual)
        return f"{self.name} is {shown}, wanted {show_value(self.wanted)}: {self.reason}"


def to_float32(value: float) -> float:
    """Round a number to a REAL32; the result is infinite if the number is out of range."""
    try:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return math.copysign(math.inf, value)


def is_storable(value: Value) -> bool:
    """Return whether an INT32 parameter (for an int) or a REAL32 parameter can hold the value."""
    return -_INT32 <= value < _INT32 if isinstance(value, int) else math.isfinite(to_float32(value))


def is_same_value(a: float, b: float, tolerance: float = 0.0) -> bool:
    """Return whether two values of a parameter count as equal.

    Values that differ by at most `tolerance`, and REAL32 that are equal after rounding, count as equal.
    """
    whole = isinstance(a, int) or isinstance(b, int)
    return abs(a - b) <= tolerance or (not whole and to_float32(a) == to_float32(b))


def show_value(value: float) -> str:
    """Return an INT32 in full, and any other number with the fewest digits that give the same REAL32."""
    if isinstance(value, int):
        return str(value)
    texts = (f"{value:.{digits}g}" for digits in range(6, 10))
    return next((text for text in texts if to_float32(float(text)) == to_float32(value)), f"{value:.9g}")


def vehicle_files(position_from: PositionSource | None) -> list[Path]:
    """Return the packaged files in order of application.

    Without a position source, return only the files that apply to every vehicle.
    """
    place = () if position_from is None else _PLACE_FILES[position_from]
    return [packaged("configs", "px4", f"{name}.params") for name in ("collision", *place)]


def vehicle_parameters(position_from: PositionSource | None) -> dict[str, Parameter]:
    """Return the parameters of `vehicle_files` by name; a later file overrides an earlier one."""
    wanted: dict[str, Parameter] = {}
    for path in vehicle_files(position_from):
        wanted |= load_parameters(path)
    return wanted


def load_parameters(path: str | Path) -> dict[str, Parameter]:
    """Return the autopilot's parameters of a file by name, in the file's order."""
    return read_parameter_file(path).parameters


def read_parameter_file(path: str | Path) -> ParameterFile:
    """Read a parameter file.

    Raise InputError if the file has no parameter of the autopilot, or if a line is a duplicate, is out of
    range or is not a parameter.
    """
    text = read_text(path)
    parameters: dict[str, Parameter] = {}
    skipped: dict[str, int] = {}
    vehicles: set[str] = set()
    reason: list[str] = []
    versions: tuple[str, str | None] = ("", None)
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if not line:
            reason.clear()
            versions = ("", None)
        elif line.startswith("#?"):
            found = _VERSIONS.match(line)
            if found is None:
                raise InputError(
                    f"{line!r}, expected `#? absent before v1.16`, `#? absent without MODULE` and "
                    "`#? renamed NAME after v1.17`",
                    source=str(path),
                    line=number,
                )
            versions = (found["where"], found["name"])
        elif _COLUMNS.match(line):
            reason.clear()  # the lines above are the header, not the reason for a parameter
        elif line.startswith("#"):
            reason.append(line.lstrip("# "))
        else:
            try:
                vehicle, component, *fields = _fields(line)
                if component == AUTOPILOT_COMPONENT:
                    parameter = _parse(fields, " ".join(reason), versions)
                    if parameter.name in parameters:
                        raise ValueError(f"{parameter.name} appears twice")
                    parameters[parameter.name] = parameter
                    vehicles.add(vehicle)
                else:
                    skipped[component] = skipped.get(component, 0) + 1
            except ValueError as error:
                raise InputError(str(error), source=str(path), line=number) from None
            reason.clear()
            versions = ("", None)
    if not parameters:
        others = f"; its rows belong to component {', '.join(skipped)}" if skipped else ""
        raise InputError(
            f"no parameter of the autopilot (component {AUTOPILOT_COMPONENT}) in this file{others}",
            source=str(path),
        )
    return ParameterFile(parameters, skipped, frozenset(vehicles))


def parse_listing(listing: str) -> dict[str, float]:
    """Return the value of every parameter in the output of PX4's `param show`, by name."""
    found = {}
    for line in listing.splitlines():
        match = _LISTED.match(line)
        if match is not None:
            with contextlib.suppress(ValueError):
                found[match["name"]] = float(match["value"])
    return found


def format_parameters(values: Mapping[str, Value], head: Iterable[str], vehicle: int = 1) -> str:
    """Return one vehicle's values as a parameter file for QGroundControl; an int is written as INT32.

    `vehicle` is the vehicle's MAVLink system id.
    """
    lines = [
        f"# {line}" for line in (*head, "vehicle-id\tcomponent-id\tname\tvalue\ttype (6 INT32, 9 REAL32)")
    ]
    lines.append("")  # separates the header from the reason for the first parameter
    for name, value in values.items():
        kind = 6 if isinstance(value, int) else 9
        lines.append(f"{vehicle}\t{AUTOPILOT_COMPONENT}\t{name}\t{show_value(value)}\t{kind}")
    return "\n".join(lines) + "\n"


def _fields(line: str) -> list[str]:
    fields = line.split("\t") if "\t" in line else line.split()
    if len(fields) != 5:
        raise ValueError(
            f"{len(fields)} fields, a parameter line has 5: vehicle id, component id, name, value, type"
        )
    return [field.strip() for field in fields]


def _parse(fields: Iterable[str], reason: str, versions: tuple[str, str | None]) -> Parameter:
    name, text, kind = fields
    if not PX4_NAME.match(name):
        raise ValueError(f"{name!r} is not a PX4 parameter name")
    if kind not in _TYPES:
        raise ValueError(f"{name}: type {kind!r}, expected 6 (INT32) or 9 (REAL32)")
    try:
        value: Value = _TYPES[kind](text)
    except ValueError:
        raise ValueError(f"{name}: {text!r} is not a number of type {kind}") from None
    if not is_storable(value):
        raise ValueError(f"{name}: {text} is out of range for {'INT32' if kind == '6' else 'REAL32'}")
    return Parameter(name, value, reason, *versions)


def differences(wanted: Mapping[str, Parameter], actual: Mapping[str, float]) -> list[ParameterDifference]:
    """Return the differences of the vehicle's parameters from the desired ones, in the file's order."""
    found = []
    for parameter in wanted.values():
        name = parameter.name
        if name not in actual and parameter.absent:
            if parameter.renamed is None:
                continue  # this build does not need the parameter
            if parameter.renamed in actual:
                name = parameter.renamed
        value = actual.get(name)
        if value is None or not is_same_value(value, parameter.value, parameter.tolerance):
            found.append(ParameterDifference(name, parameter.value, value, parameter.reason))
    return found
