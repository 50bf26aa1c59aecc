"""Check that every pinned runtime dependency has a wheel for the Raspberry Pi; requires the network.

python -m tools.check_wheels

The target is Pi OS 64-bit: aarch64 with glibc, Python 3.11 (bookworm) and 3.13 (trixie). pip downloads each
wheel and must not build anything. Dependencies are followed from the project's own metadata, with the extras
that the Pi uses, and are pinned by `constraints.txt`.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = {"3.11": "bookworm", "3.13": "trixie"}
# Wheels must suit the older C library: bookworm has glibc 2.36, and trixie has 2.41.
PLATFORMS = [f"manylinux_2_{minor}_aarch64" for minor in range(36, 16, -1)] + ["manylinux2014_aarch64"]
EXTRAS = ("sim", "identify", "report", "live")


def pins() -> dict[str, str]:
    """Return the pinned version of each package in `constraints.txt`, by canonical name."""
    rows = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pairs = (row.split("==") for row in rows if row and not row.startswith("#"))
    return {canonicalize_name(name): version for name, version in pairs}


def direct_dependencies() -> set[str]:
    """Return the canonical names of the direct dependencies of the package and its extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    required = [*project["dependencies"], *(item for extra in EXTRAS for item in extras[extra])]
    return {canonicalize_name(Requirement(item).name) for item in required}


def required_by(wheel: Path, python: str) -> set[str]:
    """Return the canonical names of a wheel's dependencies on the Pi."""
    from importlib.metadata import PathDistribution  # noqa: PLC0415
    from zipfile import Path as ZipPath  # noqa: PLC0415

    information = next(path for path in ZipPath(str(wheel)).iterdir() if path.name.endswith(".dist-info"))
    environment = {key: str(value) for key, value in default_environment().items()}
    environment |= {"platform_machine": "aarch64", "python_version": python, "extra": ""}
    listed = [Requirement(item) for item in PathDistribution(information).requires or []]
    return {canonicalize_name(r.name) for r in listed if r.marker is None or r.marker.evaluate(environment)}


def download(name: str, version: str, python: str, folder: Path) -> Path | str:
    """Return the downloaded wheel, or the last line of pip's error."""
    platforms = [part for platform in PLATFORMS for part in ("--platform", platform)]
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check"]
    command += ["--only-binary=:all:", "--no-deps", "--python-version", python, *platforms]
    done = subprocess.run(
        [*command, "-d", str(folder), f"{name}=={version}"], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        return (done.stderr.strip().splitlines() or ["pip failed"])[-1]
    stem = name.replace("-", "_")
    return next(
        path
        for path in folder.iterdir()
        if canonicalize_name(path.name.split("-")[0]) == canonicalize_name(stem)
    )


def check(python: str, folder: Path) -> int:
    """Follow the dependencies for one Python, print each, and return the number of missing wheels."""
    versions, waiting, seen, missing = pins(), sorted(direct_dependencies()), set[str](), 0
    while waiting:
        name = waiting.pop(0)
        if name in seen:
            continue
        seen.add(name)
        found = (
            download(name, versions[name], python, folder) if name in versions else "not in constraints.txt"
        )
        if isinstance(found, str):
            missing += 1
            print(f"{python}  {name:18} MISSING  {found}")
            continue
        print(f"{python}  {name:18} {found.name}")
        waiting += sorted(required_by(found, python))
    return missing


def main() -> int:
    """Check every Python of `PYTHONS`; return 1 if a wheel is missing."""
    total = 0
    for python, system in PYTHONS.items():
        with tempfile.TemporaryDirectory() as folder:
            missing = check(python, Path(folder))
        print(f"Python {python} ({system}): {missing} without a wheel")
        total += missing
    return 1 if total else 0


if __name__ == "__main__":
    sys.exit(main())
