"""The wheel in an environment of its own, without any extra: it imports, flies, and has its types.

The environment has the wheel, installed by pip, and links to the runtime dependencies of this one: what is no
dependency (SciPy, matplotlib, pymavlink, pandas) is not there, and no network is needed.
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


def closure(name: str) -> set[str]:
    """Names of what a distribution depends on here, without extras."""
    found: set[str] = set()
    waiting = [name]
    while waiting:
        for text in distribution(waiting.pop()).requires or []:
            requirement = Requirement(text)
            wanted = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
            if wanted and requirement.name not in found:
                found.add(requirement.name)
                waiting.append(requirement.name)
    return found


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("hatchling", reason="hatchling, which builds the wheel, is not installed: make")
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True, timeout=120)
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def bare(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Python with the wheel and its dependencies."""
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
    subprocess.run([*pip, str(wheel)], check=True, capture_output=True, timeout=120, env=clean())
    (site,) = folder.glob("lib/python*/site-packages")
    for name in closure("dart-flight"):
        here = distribution(name)
        for top in {file.parts[0] for file in here.files or []} - {"..", "__pycache__"}:
            target = site / top
            if not target.exists():
                target.symlink_to(Path(str(here.locate_file(top))))
    return python


def clean() -> dict[str, str]:
    """The environment without what leads to the checkout."""
    return {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "DART_"))}


def run(python: Path, folder: Path, *words: str) -> str:
    done = subprocess.run(
        [str(python), *words],
        cwd=folder,
        env=clean(),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def test_the_wheel_says_that_it_has_types(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert "dart_flight/py.typed" in names
    assert {f"dart_flight/lab/report/{name}" for name in ("page.css", "player.js")} < set(names)
    assert "dart_flight/lab/report/templates/flight.html" in names
    assert not [name for name in names if name.startswith(("tests/", "tools/"))]


def test_a_callers_ten_lines_run_without_extras(bare: Path, tmp_path: Path) -> None:
    for extra in ("scipy", "matplotlib", "pymavlink", "pandas"):
        assert (
            run(bare, tmp_path, "-c", f"import importlib.util as u; print(u.find_spec({extra!r}))")
            == "None\n"
        )
    where = run(bare, tmp_path, "-c", "import dart_flight; print(dart_flight.__file__)")
    assert str(bare.parents[1]) in where, "not the checkout"
    assert run(bare, tmp_path, str(CALLER)) == "completed True True True\n"


def test_a_folder_to_start_from_comes_out_of_the_wheel(bare: Path, tmp_path: Path) -> None:
    run(bare, tmp_path, "-m", "dart_flight", "init", "lab")
    assert (tmp_path / "lab" / "configs" / "dart.yaml").exists()
    run(bare, tmp_path / "lab", "-m", "dart_flight", "check", "missions/single_wall.yaml")


def test_mypy_strict_passes_a_callers_ten_lines(bare: Path, tmp_path: Path) -> None:
    caller = tmp_path / "caller.py"
    caller.write_text(CALLER.read_text() + "reveal_type(flight.verdict.goal_miss_m)\n")
    words = ["-m", "mypy", "--strict", "--python-executable", str(bare), str(caller)]
    said = run(Path(sys.executable), tmp_path, *words)
    assert 'Revealed type is "float | None"' in said.replace("builtins.", ""), said
    caller.write_text(CALLER.read_text() + "flight.verdict.goal_mis_m\n")
    done = subprocess.run(
        [sys.executable, *words], cwd=tmp_path, env=clean(), capture_output=True, text=True, check=False
    )
    assert 'has no attribute "goal_mis_m"' in done.stdout, "the types are seen, not Any"
