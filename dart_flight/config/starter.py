"""The files of a new project, copied from `configs/`, `missions/` and `docs/schemas/` to equal paths.

The paths are preserved because the files contain relative paths: a mission names its configuration, and the
first line of each file names its schema. A file named after a vehicle (`configs/rigid_cage.yaml`, the folder
`missions/rigid_cage`) belongs to that vehicle. If the vehicle's configuration extends another configuration,
that configuration is copied too. Other files belong to DART, except PX4's parameters and the schemas, which
are copied for every vehicle.
"""

from __future__ import annotations

from pathlib import Path

from dart_flight.config.document import InputError, report_write_errors, unknown_name
from dart_flight.config.vehicle import packaged
from dart_flight.config.vehicle.configuration import extended_file

DART = "dart"
# DART, then the other vehicles that have missions
VEHICLES = (DART, "rigid_cage", "ring_guard_250g")

_PARTS = (("configs", ".yaml"), ("configs", ".params"), ("missions", ".yaml"), ("docs/schemas", ".json"))
_SHARED = (".params", ".json")


def starter_files(vehicle: str = DART) -> dict[Path, Path]:
    """Return the packaged files to copy; the keys are the relative paths in the new folder.

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
    while (base := extended_file(own)) is not None:
        own = own.parent / base
        files[Path("configs") / base] = own
    return files


def _owner(relative: Path) -> str:
    named = {*relative.parent.parts, relative.stem}
    return next((name for name in VEHICLES if name in named), DART)


def first_mission(vehicle: str) -> Path:
    """Return the path of the introductory mission, relative to the new folder."""
    return Path("missions/dual_collision.yaml" if vehicle == DART else f"missions/{vehicle}/single_wall.yaml")


def write_starter(directory: Path, vehicle: str = DART) -> list[Path]:
    """Copy the starter files of a vehicle into a folder, and return the written paths.

    If one of the files exists already, nothing is written, and the function raises InputError.
    """
    files = {directory / relative: source for relative, source in starter_files(vehicle).items()}
    there = [path for path in files if path.exists() or path.is_symlink()]
    if there:
        others = f", and {len(there) - 1} more files exist" if len(there) > 1 else ""
        raise InputError(f"already exists{others}; name an empty folder", source=str(there[0]))
    for path, source in files.items():
        with report_write_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("xb") as file:
                file.write(source.read_bytes())
    return list(files)
