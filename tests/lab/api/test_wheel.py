"""The wheel in its own environment without extras: import, flight, types and the start folder.

pip installs the wheel there, and its runtime dependencies are links to the installed ones. Other packages
(SciPy, matplotlib, pymavlink, pandas) are missing there, and no network is needed.
"""

from __future__ import annotations

import os
import subprocess
import sys
import venv
import zipfile
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[3]
CALLER = Path(__file__).with_name("caller.py")


def dependencies_of(name: str) -> set[str]:
    """Return the names of all dependencies of a distribution, without extras."""
    found: set[str] = set()
    pending = [name]
    while pending:
        for text in distribution(pending.pop()).requires or []:
            requirement = Requirement(text)
            applies = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
            if applies and requirement.name not in found:
                found.add(requirement.name)
                pending.append(requirement.name)
    return found


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("hatchling", reason="hatchling, which builds the wheel, is not installed: make")
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True, timeout=120)
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def bare_python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a Python interpreter with only the wheel and its dependencies."""
    folder = tmp_path_factory.mktemp("bare")
    venv.create(folder, symlinks=True)
    python = folder / "bin" / "python"
    pip = [
        sys.executable,
        "-m",
        "pip",
        "--python",
        str(python),
        "install",
        "--quiet",
        "--no-index",
        "--no-deps",
    ]
    subprocess.run([*pip, str(wheel)], check=True, capture_output=True, timeout=120, env=clean_environment())
    (site,) = folder.glob("lib/python*/site-packages")
    for name in dependencies_of("dart-flight"):
        installed = distribution(name)
        for top in {file.parts[0] for file in installed.files or []} - {"..", "__pycache__"}:
            target = site / top
            if not target.exists():
                target.symlink_to(Path(str(installed.locate_file(top))))
    return python


def clean_environment() -> dict[str, str]:
    """Return the environment variables without those that point to the checkout."""
    return {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "DART_"))}


def run(python: Path, folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        [str(python), *arguments],
        cwd=folder,
        env=clean_environment(),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def test_the_wheel_contains_type_marker_templates_and_no_tests(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert "dart_flight/py.typed" in names
    assert {f"dart_flight/lab/report/{name}" for name in ("page.css", "player.js")} < set(names)
    assert "dart_flight/lab/report/templates/flight.html" in names
    assert not [name for name in names if name.startswith(("tests/", "tools/"))]


@pytest.mark.rest
def test_the_caller_runs_without_extras(bare_python: Path, tmp_path: Path) -> None:
    code = (
        "import dart_flight, importlib.util as u;"
        "extras = 'scipy', 'matplotlib', 'pymavlink', 'pandas';"
        "print([e for e in extras if u.find_spec(e)], dart_flight.__file__)"
    )
    installed, location = run(bare_python, tmp_path, "-c", code).split()
    assert installed == "[]"
    assert str(bare_python.parents[1]) in location, "the checkout was imported"
    assert run(bare_python, tmp_path, str(CALLER)) == "completed True True True\n"


@pytest.mark.rest
def test_init_creates_a_valid_folder_from_the_wheel(bare_python: Path, tmp_path: Path) -> None:
    run(bare_python, tmp_path, "-m", "dart_flight", "init", "lab")
    assert (tmp_path / "lab" / "configs" / "dart.yaml").exists()
    run(bare_python, tmp_path / "lab", "-m", "dart_flight", "check", "missions/single_wall.yaml")


@pytest.mark.rest
def test_the_caller_passes_mypy_strict_against_the_wheel(bare_python: Path, tmp_path: Path) -> None:
    caller = tmp_path / "caller.py"
    caller.write_text(CALLER.read_text() + "reveal_type(flight.verdict.goal_miss_m)\n")
    arguments = ["-m", "mypy", "--strict", "--python-executable", str(bare_python), str(caller)]
    output = run(Path(sys.executable), tmp_path, *arguments)
    assert 'Revealed type is "float | None"' in output.replace("builtins.", ""), output
    caller.write_text(CALLER.read_text() + "flight.verdict.goal_mis_m\n")
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=tmp_path,
        env=clean_environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert 'has no attribute "goal_mis_m"' in done.stdout, "the package is typed as Any"
