"""The files a new user starts from: those of `configs/`, `missions/` and `docs/schemas/`, in the same places.

The places are kept because the files name each other by relative paths: a mission its configuration, and the
first line of each its schema for the editor. What is called as a vehicle (`configs/rigid_cage.yaml`, the
folder `missions/rigid_cage`) is that vehicle's, and so is what its configuration extends; what is called as
none is DART's, PX4's parameters and the schemas are everybody's.
"""

from __future__ import annotations

from pathlib import Path

from dart_flight.config.document import InputError, unknown_name, writing
from dart_flight.config.vehicle import packaged
from dart_flight.config.vehicle.configuration import base_of

DART = "dart"
# DART, and those that have missions of their own.
VEHICLES = (DART, "rigid_cage", "ring_guard_250g")

_PARTS = (("configs", ".yaml"), ("configs", ".params"), ("missions", ".yaml"), ("docs/schemas", ".json"))
_SHARED = (".params", ".json")


def starter_files(vehicle: str = DART) -> dict[Path, Path]:
    """Relative path in the new folder -> packaged file, in order.

    Raises:
        InputError: there is no such vehicle.
    """
    if vehicle not in VEHICLES:
        raise InputError(unknown_name(vehicle, list(VEHICLES), "vehicle"), key=("--vehicle",))
    files = {}
    for folder, suffix in _PARTS:
        root = packaged(*folder.split("/"))
        for path in sorted(root.rglob(f"*{suffix}")):
            relative = path.relative_to(root)
            if suffix in _SHARED or _owner(relative) == vehicle:
                files[Path(folder) / relative] = path
    own = packaged("configs", f"{vehicle}.yaml")
    while (base := base_of(own)) is not None:
        own = own.parent / base
        files[Path("configs") / base] = own
    return files


def _owner(relative: Path) -> str:
    """The vehicle that a file belongs to."""
    named = {*relative.parent.parts, relative.stem}
    return next((name for name in VEHICLES if name in named), DART)


def first_mission(vehicle: str) -> Path:
    """The mission to begin with, relative to the new folder."""
    return Path("missions/dual_collision.yaml" if vehicle == DART else f"missions/{vehicle}/single_wall.yaml")


def write_starter(directory: Path, vehicle: str = DART) -> list[Path]:
    """Copy the starter files of a vehicle into a folder, which is made if need be. Returns what was written.

    Raises:
        InputError: there is no such vehicle, a file is already there (then nothing is written), or the folder
            cannot be written.
    """
    files = {directory / relative: source for relative, source in starter_files(vehicle).items()}
    there = [path for path in files if path.exists() or path.is_symlink()]
    if there:
        others = f" and {len(there) - 1} more" if len(there) > 1 else ""
        raise InputError(
            f"is already there{others}, nothing is overwritten; name an empty folder", source=str(there[0])
        )
    for path, source in files.items():
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("xb") as file:
                file.write(source.read_bytes())
    return list(files)
