"""The files a new user starts from: those of `configs/`, `missions/` and `docs/schemas/`, in the same places.

The places are kept because the files name each other by relative paths: a mission its configuration, and the
first line of each its schema for the editor.
"""

from __future__ import annotations

from pathlib import Path

from dart_flight.config.document import InputError
from dart_flight.config.vehicle import packaged

_PARTS = (("configs", ".yaml"), ("configs", ".params"), ("missions", ".yaml"), ("docs/schemas", ".json"))


def starter_files() -> dict[Path, Path]:
    """Relative path in the new folder -> packaged file, in order."""
    files = {}
    for folder, suffix in _PARTS:
        root = packaged(*folder.split("/"))
        for path in sorted(root.rglob(f"*{suffix}")):
            files[Path(folder) / path.relative_to(root)] = path
    return files


def write_starter(directory: Path) -> list[Path]:
    """Copy the starter files into a folder, which is made if need be. Returns what was written.

    Raises:
        InputError: a file is already there (then nothing is written), or the folder cannot be written.
    """
    files = {directory / relative: source for relative, source in starter_files().items()}
    there = [path for path in files if path.exists() or path.is_symlink()]
    if there:
        others = f" and {len(there) - 1} more" if len(there) > 1 else ""
        raise InputError(
            f"is already there{others}, nothing is overwritten; name an empty folder", source=str(there[0])
        )
    for path, source in files.items():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("xb") as file:
                file.write(source.read_bytes())
        except OSError as error:
            raise InputError(f"cannot write: {error.strerror or error}", source=str(path)) from None
    return list(files)
