"""Where a vehicle's configuration came from: said by every command that computes with one."""

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
    """The vehicle that numbers are for, in the words of `--json`; None: built in Python.

    Attributes:
        source: the configuration's path, from the working directory where it lies below that.
        packaged: whether it is the one that comes with the program, and not this folder's own.
        mass_kg: the figure that most others hang on.
        set: keys that `--set` changed for this call, `KEY=VALUE`; left out where there are none.
    """

    source: str | None
    packaged: bool | None
    mass_kg: float
    set: tuple[str, ...] = ()


class FoundVehicle(NamedTuple):
    """A configuration and where it was found."""

    config: VehicleConfig
    source: VehicleSource


def find_vehicle(path: str | Path | None = None, settings: Sequence[str] = ()) -> FoundVehicle:
    """Load a vehicle configuration (`load_vehicle`), and say which one it is.

    Args:
        path: the file; by default that of `default_config_path`.
        settings: `KEY=VALUE` that differ from the file.

    Raises:
        InputError: as `load_vehicle`, or the file is of another kind.
    """
    taken = Path(path or default_config_path())
    try:
        config = load_vehicle(taken, settings)
    except InputError:
        refuse_other_kind(taken, FileKind.CONFIGURATION)
        raise
    mass_kg = config.airframe.mass_kg
    return FoundVehicle(
        config, VehicleSource(display_path(taken), _is_packaged(taken), mass_kg, tuple(settings))
    )


def display_path(path: str | Path) -> str:
    """A path as people name it: below the working directory without what leads there."""
    shown = path
    with contextlib.suppress(OSError):  # the working directory was removed
        whole = Path(path).resolve()
        if whole.is_relative_to(Path.cwd()):
            shown = whole.relative_to(Path.cwd())
        elif ".." in Path(path).parts:  # written by a mission file, not by a person
            shown = whole
    return printable(str(shown))


def _is_packaged(path: Path) -> bool:
    taken = path.resolve()
    # In a checkout the packaged file is the folder's own as well.
    return taken == packaged("configs", "dart.yaml").resolve() and taken != _LOCAL.resolve()


def passed_over(source: VehicleSource) -> list[str]:
    """Configurations that a person may have meant where the packaged one was taken.

    That of $DART_FLIGHT_CONFIG, and those in the working folder and its `configs/`, as paths; none where the
    packaged one was not taken.
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
    """Whether a file looks like a vehicle configuration: also one with a mistake in it is meant as one."""
    try:
        return kind_of_tree(Document.load(path).tree) is FileKind.CONFIGURATION
    except InputError:
        return False
