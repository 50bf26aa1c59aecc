"""Compiles the modules named in pyproject.toml with mypyc, where DART_FLIGHT_COMPILE=1 asks for it.

Without it the wheel is pure Python and nothing here is needed (docs/speed.md).
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


def _wanted() -> bool:
    return os.environ.get("DART_FLIGHT_COMPILE") == "1"


class CompileHook(BuildHookInterface):
    """Puts the compiled modules beside their sources into the wheel, never into the source tree."""

    PLUGIN_NAME = "custom"

    def dependencies(self) -> list[str]:
        """What the build needs: mypyc must see the types of what the package imports."""
        return list(self.config["requires"]) if _wanted() else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile before the wheel is packed; an editable install stays as it is."""
        if not _wanted() or version != "standard":
            return
        os.chdir(self.root)
        # Kept: pip builds a wheel twice (the first time for its metadata), and what has not changed is not
        # compiled again.
        out = Path(self.root) / "build" / "mypyc"
        for library in _compile(self.config["modules"], out):
            build_data["force_include"][str(library)] = str(library.relative_to(out / "lib"))
        build_data["pure_python"] = False
        build_data["infer_tag"] = True


def _compile(modules: list[str], out: Path) -> list[Path]:
    from mypyc.build import mypycify  # noqa: PLC0415 - only where it is asked for
    from setuptools import Distribution  # noqa: PLC0415
    from setuptools.command.build_ext import build_ext  # noqa: PLC0415

    extensions = mypycify(
        ["--ignore-missing-imports", "--follow-imports=silent", *modules],
        opt_level="2",
        debug_level="0",
        target_dir=str(out / "c"),
    )
    command = build_ext(Distribution({"name": "dart_flight", "ext_modules": extensions}))
    command.build_lib, command.build_temp = str(out / "lib"), str(out / "temp")
    command.ensure_finalized()
    command.run()
    return [Path(path) for path in command.get_outputs()]
