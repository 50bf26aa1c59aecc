"""Folders of pytest for tests that run as another account."""

import tempfile
from pathlib import Path

NOBODY = 65534


def open_to_all(folder: Path) -> None:
    """Let other accounts reach a folder of pytest, which pytest closes to them."""
    for one in (folder, *folder.parents):
        if one != Path(tempfile.gettempdir()) and one.is_relative_to(tempfile.gettempdir()):
            one.chmod(0o755)
