"""PX4 parameter files in QGroundControl's format, and their comparison with a vehicle's parameters.

A line is `vehicle-id component-id name value type`, separated by tabs, with type 6 for INT32 and 9 for
REAL32. Lines that start with # are comments. In the packaged files, a comment above each parameter gives the
reason for the parameter's value. If some builds of PX4 lack the parameter under this name, a separate
comment line lists these builds:

- `#? absent before v1.16` or `#? absent after v1.17`: these versions do not need the parameter.
- `#? absent without gyro_fft`: builds without the module gyro_fft do not need the parameter.
- `#? renamed NAME after v1.17`: these versions have the parameter under the name NAME.

`after v1.17` includes development versions of v1.18.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterable, Mapping
from enum import StrEnum
from pathlib import Path

import msgspec

from dart_flight.config.document import InputError, read_text
from dart_flight.config.vehicle import packaged

Value = int | float
Version = tuple[int, int]  # of PX4: major, minor

_TYPES = {"6": int, "9": float}
PX4_NAME = re.compile(r"[A-Z][A-Z0-9_]{0,15}\Z")
_INT32 = 1 << 31
_LISTED = re.compile(r"^\s*[x ] [ *+](?: [ l])? (?P<name>[A-Z][A-Z0-9_]*) \[.*\] : (?P<value>\S+)\s*$")
_VERSIONS = re.compile(
    r"#\?\s*(absent|renamed\s+(?P<name>[A-Z][A-Z0-9_]{0,15}))"
    r"\s+(?P<where>(?:before|after) v\d+\.\d+|without [a-z][a-z0-9_]*)$"
)


class PositionSource(StrEnum):
    """Source of PX4's position."""

    MOCAP = "mocap"  # motion capture
    RTK = "rtk"  # GPS with corrections
    PLAIN = "plain"  # GPS without corrections
    ANCHORED = "anchored"  # GPS without corrections; contacts with walls correct the position


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
        value: wanted value; an int for INT32, a float for REAL32.
        reason: comment lines directly above the parameter's line, joined; empty without a comment.
        absent: builds of PX4 that do not have the parameter under this name, such as "before v1.16" or
            "without gyro_fft"; empty for none.
        renamed: name of the parameter in the builds of `absent`; None if these builds do not need the
            parameter.
        tolerance: largest difference from the vehicle's value that counts as equal.
    """

    name: str
    value: Value
    reason: str
    absent: str = ""
    renamed: str | None = None
    tolerance: float = 0.0

    def is_absent_in(self, version: Version | None) -> bool:
        """Return whether a PX4 version lacks the parameter under this name; modules are not checked."""
        when, _, release = self.absent.partition(" v")
        if version is None or not release:
            return False
        major, minor = release.split(".")
        return version < (int(major), int(minor)) if when == "before" else version > (int(major), int(minor))


class ParameterDifference(msgspec.Struct, frozen=True):
    """A parameter of the vehicle that differs from the file; `actual` is None if the vehicle lacks it."""

    name: str
    wanted: Value
    actual: float | None
    reason: str

    def line(self) -> str:
        """Return the difference as one line."""
        shown = "not on this vehicle" if self.actual is None else f"{self.actual:g}"
        return f"{self.name} is {shown}, wanted {self.wanted:g}: {self.reason}"


def vehicle_files(position_from: PositionSource | None) -> list[Path]:
    """Return the packaged files for a vehicle, in order of application.

    With None, return only the files that apply to every vehicle.
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
    """Read a parameter file.

    Returns:
        The parameters by name, in the file's order.

    Raises:
        InputError: the file cannot be read, or a line is a duplicate, is out of range or is not a parameter.
    """
    text = read_text(path)
    parameters: dict[str, Parameter] = {}
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
        elif line.startswith("#"):
            reason.append(line.lstrip("# "))
        else:
            try:
                parameter = _parse(line, " ".join(reason), versions)
                if parameter.name in parameters:
                    raise ValueError(f"{parameter.name} appears twice")
            except ValueError as error:
                raise InputError(str(error), source=str(path), line=number) from None
            parameters[parameter.name] = parameter
            reason.clear()
            versions = ("", None)
    return parameters


def parse_listing(listing: str) -> dict[str, float]:
    """Return name and value of every parameter in the output of PX4's `param show`."""
    found = {}
    for line in listing.splitlines():
        match = _LISTED.match(line)
        if match is not None:
            with contextlib.suppress(ValueError):
                found[match["name"]] = float(match["value"])
    return found


def format_parameters(values: Mapping[str, Value], head: Iterable[str]) -> str:
    """Return one vehicle's values as a parameter file for QGroundControl; an int is written as INT32."""
    lines = [
        f"# {line}" for line in (*head, "vehicle-id\tcomponent-id\tname\tvalue\ttype (6 INT32, 9 REAL32)")
    ]
    lines.append("")  # the head is no parameter's reason
    for name, value in values.items():
        text, kind = (str(value), 6) if isinstance(value, int) else (f"{value:.9g}", 9)
        lines.append(f"1\t1\t{name}\t{text}\t{kind}")
    return "\n".join(lines) + "\n"


def _parse(line: str, reason: str, versions: tuple[str, str | None]) -> Parameter:
    fields = line.split("\t") if "\t" in line else line.split()
    if len(fields) != 5:
        raise ValueError(
            f"{len(fields)} fields, a parameter line has 5: vehicle id, component id, name, value, type"
        )
    _, _, name, text, kind = (field.strip() for field in fields)
    if not PX4_NAME.match(name):
        raise ValueError(f"{name!r} is not a PX4 parameter name")
    if kind not in _TYPES:
        raise ValueError(f"{name}: type {kind!r}, expected 6 (INT32) or 9 (REAL32)")
    try:
        value: Value = _TYPES[kind](text)
    except ValueError:
        raise ValueError(f"{name}: {text!r} is not a number of type {kind}") from None
    if not math.isfinite(value) or (kind == "6" and not -_INT32 <= value < _INT32):
        raise ValueError(f"{name}: {text} is out of range")
    return Parameter(name, value, reason, *versions)


def differences(wanted: Mapping[str, Parameter], actual: Mapping[str, float]) -> list[ParameterDifference]:
    """Return the vehicle's differences from a parameter file, in the file's order.

    Args:
        wanted: wanted parameters by name, from `load_parameters`.
        actual: the vehicle's parameters by name.
    """
    found = []
    for parameter in wanted.values():
        name = parameter.name
        if name not in actual and parameter.absent:
            if parameter.renamed is None:
                continue  # not needed in this build
            if parameter.renamed in actual:
                name = parameter.renamed
        value = actual.get(name)
        # A REAL32 has seven significant digits.
        near = max(1e-9, parameter.tolerance)
        if value is None or not math.isclose(value, parameter.value, rel_tol=1e-6, abs_tol=near):
            found.append(ParameterDifference(name, parameter.value, value, parameter.reason))
    return found
