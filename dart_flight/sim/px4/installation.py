"""Finding PX4: an installation or a SITL build, from the argument of `--px4` and the environment.

PX4's packages, containers and builds have the same layout: the program `bin/px4`, its clients beside it, and
the folder `etc`. `python -m dart_flight.sim.px4.installation` prints a line if there is a PX4.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import msgspec

from dart_flight.config.document import InputError

ENVIRONMENT = "DART_PX4_DIR"
MODEL = "none_iris"  # PX4's airframe for an external simulator: a quadrotor in X
CLIENT = "px4-param"
HOW_TO_GET = (
    "  package for Ubuntu: download px4_*.deb from https://github.com/PX4/PX4-Autopilot/releases, then run "
    "sudo apt install ./px4_*.deb",
    "  container: docker create --name px4 px4io/px4-sitl; docker cp px4:/opt/px4 ~/px4; then use "
    "--px4 ~/px4",
    "  build: run make px4_sitl_default in PX4's source folder, ~/PX4-Autopilot (docs/px4.md)",
)
PACKAGES = ("opt/px4", "opt/px4-gazebo")  # where PX4's packages are installed
_SOURCE = "PX4-Autopilot"


class Install(msgspec.Struct, frozen=True):
    """PX4's program and its `etc` folder."""

    program: Path
    etc: Path

    @property
    def folder(self) -> Path:
        """The folder with `bin` and `etc`."""
        return self.program.parents[1]


def find_install(
    named: str | Path | None, environ: Mapping[str, str] = os.environ, root: Path = Path("/")
) -> Install:
    """Return the PX4 that the user has named, or the first PX4 that is found.

    The search order is: `$DART_PX4_DIR`, `px4` on the PATH, PX4's packages, and `~/PX4-Autopilot`.

    Args:
        named: PX4's program, an installation, a build folder, a source folder with builds, or a folder with
            an unpacked package. If it is None or empty, PX4 is searched for.
        environ: environment variables.
        root: folder in which packages are installed.

    Raises:
        InputError: the named PX4 is missing or not usable, or the search has found no PX4.
    """
    if named:
        return _install_at(named, "")
    if environ.get(ENVIRONMENT):
        return _install_at(environ[ENVIRONMENT], f"{ENVIRONMENT}=")
    problems = []
    for place in _usual_places(environ, root):
        try:
            return _install_at(place, "")
        except InputError as error:
            if os.path.lexists(place):
                problems.append(f"; {error.one_line()}")
    raise InputError(
        f"no PX4 found: not in ${ENVIRONMENT}, on the PATH, in /opt/px4, /opt/px4-gazebo or "
        f"~/{_SOURCE}{''.join(problems)}",
        hints=HOW_TO_GET,
    )


def _usual_places(environ: Mapping[str, str], root: Path) -> Iterator[Path]:
    program = shutil.which("px4", path=environ.get("PATH", ""))
    if program is not None:
        yield Path(program)
    yield from (root / package for package in PACKAGES)
    if environ.get("HOME"):
        yield Path(environ["HOME"], _SOURCE)


def _install_at(named: str | Path, prefix: str) -> Install:
    """Return the usable PX4 at a path; `prefix` precedes the path in the error."""
    path = Path(os.path.realpath(os.path.expanduser(named)))  # the package's /usr/bin/px4 is a link
    problem = ""
    for folder in _folders(path):
        install = Install(folder / "bin" / "px4", folder / "etc")
        if os.path.isfile(install.program):  # unlike Path.is_file, this never raises
            found = _problem_of(install)
            if found is None:
                return install
            problem = problem or f"{found} ({folder})"
    if not problem and os.path.isfile(path):
        problem = "this file is not PX4's program: name bin/px4 of an installation or a build"
    raise InputError(
        problem or "no PX4 SITL in this folder: neither bin/px4 nor build/px4_sitl_*/bin/px4",
        source=f"{prefix}{path}",
    )


def _folders(path: Path) -> Iterator[Path]:
    """Yield the folders that may contain `bin` and `etc`, in order of preference."""
    if os.path.isfile(path):
        yield path.parents[1]
        return
    yield path
    if path.name == "bin":
        yield path.parent
    builds = [*path.glob("px4_sitl_*"), *path.glob("build/px4_sitl_*")]
    yield from sorted(builds, key=_preference)
    yield from (path / package for package in PACKAGES)


def _preference(build: Path) -> tuple[bool, bool, float]:
    """Return the sorting key of a build: `default` first, `nolockstep` last, otherwise the newest first."""
    program = build / "bin" / "px4"
    age_s = -os.path.getmtime(program) if os.path.isfile(program) else 0.0
    return build.name != "px4_sitl_default", "nolockstep" in build.name, age_s


def _problem_of(install: Install) -> str | None:
    """Return why this PX4 cannot be used, or None."""
    airframes = (install.etc / "init.d-posix" / "airframes").glob(f"*_{MODEL}")
    for present, text in (
        (os.access(install.program, os.X_OK, effective_ids=True), "bin/px4 is not executable"),
        (os.path.exists(install.program.parent / CLIENT), f"has bin/px4 but no bin/{CLIENT}"),
        (
            os.path.isfile(install.etc / "init.d-posix" / "rcS"),
            "has bin/px4 but no etc/init.d-posix/rcS: not a SITL build",
        ),
        (any(airframes), f"has no airframe {MODEL}: unsupported version of PX4"),
    ):
        if not present:
            return text
    return None


def main() -> None:
    """Print how to fly with the PX4 of this computer; print nothing if there is none."""
    try:
        folder = find_install(None).folder
    except InputError:
        return
    sys.stdout.write(
        f"next: `dart-flight dry-run missions/dual_collision.yaml --px4` flies the PX4 in {folder}\n"
    )


if __name__ == "__main__":
    main()
