"""The origin of a vehicle's configuration; every command that uses a configuration reports its origin."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from dart_flight.base.text import printable
from dart_flight.config.document import Document, InputError
from dart_flight.config.file_kinds import FileKind, kind_of_tree, refuse_other_kind
from dart_flight.config.vehicle import VehicleConfig, default_config_path, load_vehicle, packaged

_LOCAL = Path("configs/dart.yaml")
_MAX_LOOKED_AT = 100


class VehicleSource(msgspec.Struct, frozen=True, omit_defaults=True):
    """Identification of the vehicle and its configuration in the output of `--json`.

    Attributes:
        source: path of the configuration; None if built in Python. A path inside the working directory is
            relative.
        packaged: whether the configuration is the packaged file and not a file of the user.
        mass_kg: the vehicle's mass; most results depend on it.
        set: keys changed by `--set` for this call, `KEY=VALUE`; omitted if there are none.
    """

    source: str | None
    packaged: bool | None
    mass_kg: float
    set: tuple[str, ...] = ()


class LoadedVehicle(NamedTuple):
    """A configuration with its origin."""

    config: VehicleConfig
    source: VehicleSource


def find_vehicle(path: str | Path | None = None, settings: Sequence[str] = ()) -> LoadedVehicle:
    """Load a vehicle configuration and identify it.

    Args:
        path: the file; default: `default_config_path`.
        settings: `KEY=VALUE` pairs that override the file.
    """
    taken = Path(path or default_config_path())
    try:
        config = load_vehicle(taken, settings)
    except InputError:
        refuse_other_kind(taken, FileKind.CONFIGURATION)
        raise
    mass_kg = config.airframe.mass_kg
    return LoadedVehicle(
        config, VehicleSource(display_path(taken), _is_packaged(taken), mass_kg, tuple(settings))
    )


def display_path(path: str | Path) -> str:
    """Return a path for display; a path inside the working directory becomes relative to it."""
    shown = path
    with contextlib.suppress(OSError):  # the working directory may have been removed
        whole = Path(path).resolve()
        if whole.is_relative_to(Path.cwd()):
            shown = whole.relative_to(Path.cwd())
        elif ".." in Path(path).parts:  # the path comes from a mission file, not from the operator
            shown = whole
    return printable(str(shown))


def _is_packaged(path: Path) -> bool:
    taken = path.resolve()
    # In a checkout, the packaged file is also the working folder's own file.
    return taken == packaged("configs", "dart.yaml").resolve() and taken != _LOCAL.resolve()


def unused_configurations(source: VehicleSource) -> list[str]:
    """Return other configurations that the operator may have meant when the packaged one is used.

    Candidates are the file that $DART_FLIGHT_CONFIG names, and the files in the working folder and in its
    subfolder `configs/`. If another configuration is used, the result is empty.
    """
    if not source.packaged:
        return []
    named = os.environ.get("DART_FLIGHT_CONFIG")
    candidates = [Path(named)] if named else []
    for folder in (Path("configs"), Path()):
        with contextlib.suppress(OSError):
            candidates += sorted(p for p in folder.iterdir() if p.suffix in (".yaml", ".yml"))
    found = [display_path(p) for p in candidates[:_MAX_LOOKED_AT] if not _is_packaged(p) and _is_vehicle(p)]
    return list(dict.fromkeys(found))


def _is_vehicle(path: Path) -> bool:
    """Return whether a file looks like a vehicle configuration, even one with an error."""
    try:
        return kind_of_tree(Document.load(path).tree) is FileKind.CONFIGURATION
    except InputError:
        return False
