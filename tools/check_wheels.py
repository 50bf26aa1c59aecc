"""Whether every runtime dependency, as pinned, has a wheel for the Raspberry Pi; needs the network.

python -m tools.check_wheels

Pi OS 64-bit: aarch64 with glibc, Python 3.11 (bookworm) and 3.13 (trixie). pip is asked to download each
wheel, and may build nothing. Dependencies are followed from the project's own metadata, with the extras that
the Pi uses, and pinned by `constraints.txt`.
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
# Oldest C library of the two: bookworm has glibc 2.36, trixie 2.41.
PLATFORMS = [f"manylinux_2_{minor}_aarch64" for minor in range(36, 16, -1)] + ["manylinux2014_aarch64"]
EXTRAS = ("sim", "identify", "report", "live")


def pins() -> dict[str, str]:
    """Canonical name -> version, of `constraints.txt`."""
    rows = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pairs = (row.split("==") for row in rows if row and not row.startswith("#"))
    return {canonicalize_name(name): version for name, version in pairs}


def direct() -> set[str]:
    """Canonical names of what the package and its extras ask for."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    asked = [*project["dependencies"], *(item for extra in EXTRAS for item in extras[extra])]
    return {canonicalize_name(Requirement(item).name) for item in asked}


def required_by(wheel: Path, python: str) -> set[str]:
    """Canonical names of what a wheel depends on, on the Pi."""
    from importlib.metadata import PathDistribution  # noqa: PLC0415
    from zipfile import Path as ZipPath  # noqa: PLC0415

    information = next(path for path in ZipPath(str(wheel)).iterdir() if path.name.endswith(".dist-info"))
    environment = {key: str(value) for key, value in default_environment().items()}
    environment |= {"platform_machine": "aarch64", "python_version": python, "extra": ""}
    asked = [Requirement(item) for item in PathDistribution(information).requires or []]
    return {canonicalize_name(r.name) for r in asked if r.marker is None or r.marker.evaluate(environment)}


def download(name: str, version: str, python: str, folder: Path) -> Path | str:
    """The wheel as a file, or pip's last line where there is none."""
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
    """Follow the dependencies for one Python; prints a line each, returns how many are without a wheel."""
    versions, waiting, seen, missing = pins(), sorted(direct()), set[str](), 0
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
    """Every Python of `PYTHONS`; 1 where something is missing."""
    total = 0
    for python, system in PYTHONS.items():
        with tempfile.TemporaryDirectory() as folder:
            missing = check(python, Path(folder))
        print(f"Python {python} ({system}): {missing} without a wheel")
        total += missing
    return 1 if total else 0


if __name__ == "__main__":
    sys.exit(main())
