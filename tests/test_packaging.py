"""The wheel and the source distribution outside a checkout, and the versions that several files state."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
import tomllib
from collections.abc import Iterator
from pathlib import Path
from zipfile import ZipFile

import pytest
import yaml

import dart_flight
from tests.accounts import NOBODY, open_to_all

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def run(*words: object, **options: object) -> subprocess.CompletedProcess[str]:
    """Run a program that must succeed."""
    done: subprocess.CompletedProcess[str] = subprocess.run(
        [str(word) for word in words], capture_output=True, text=True, check=False, **options
    )  # type: ignore[call-overload]
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Wheel and source distribution."""
    folder = tmp_path_factory.mktemp("built")
    run(sys.executable, "-m", "hatchling", "build", "-d", folder, "-t", "wheel", "-t", "sdist", cwd=ROOT)
    return next(folder.glob("*.whl")), next(folder.glob("*.tar.gz"))


def other_account() -> dict[str, object]:
    """Return the options of `subprocess` for an ordinary account: root becomes nobody."""
    return {"user": NOBODY, "group": NOBODY, "extra_groups": []} if os.geteuid() == 0 else {}


def interpreters() -> Iterator[str]:
    """Yield interpreters of this version that an ordinary account can start."""
    for python in (Path(sys.base_prefix, "bin", "python3"), Path("/usr/bin/python3")):
        version = f"import sys, venv; sys.exit(sys.version_info[:2] != {sys.version_info[:2]})"
        try:
            done = subprocess.run([python, "-c", version], check=False, **other_account())  # type: ignore[call-overload]
        except OSError:
            continue
        if done.returncode == 0:
            yield str(python)


@pytest.mark.rest
def test_a_wheel_flies_without_a_mission_for_an_ordinary_user_in_an_empty_folder(
    built: tuple[Path, Path], tmp_path: Path
) -> None:
    python = next(interpreters(), None)
    if python is None:
        pytest.skip("no interpreter of this version that another account can start")
    run(python, "-m", "venv", "--without-pip", tmp_path / "venv")
    packages = next((tmp_path / "venv" / "lib").glob("python*/site-packages"))
    with ZipFile(built[0]) as wheel:
        wheel.extractall(packages)
    # The dependencies are those of this test's environment.
    (packages / "dependencies.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    open_to_all(tmp_path)
    empty = tmp_path / "empty"
    empty.mkdir()
    empty.chmod(0o777)
    environment = {"PATH": os.environ["PATH"], "HOME": str(empty)}
    program = (tmp_path / "venv" / "bin" / "python", "-m", "dart_flight")
    flown = run(*program, "dry-run", "--fast", "--json", cwd=empty, env=environment, **other_account())
    assert '"outcome": "completed"' in re.sub(r'":"', '": "', flown.stdout)
    assert "flying the packaged dual collision" in flown.stderr
    assert run(*program, "--version", cwd=empty, env=environment).stdout.split()[-1] == PROJECT["version"]
    assert {path.name for path in empty.iterdir()} <= {"flights", ".local"}


@pytest.mark.rest
def test_the_source_distribution_gives_the_same_wheel(built: tuple[Path, Path], tmp_path: Path) -> None:
    wheel, sources = built
    command = ("-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index", "-w", tmp_path)
    run(sys.executable, *command, sources)
    again = next(tmp_path.glob("*.whl"))
    assert ZipFile(again).namelist() == ZipFile(wheel).namelist()


def test_the_version_is_the_same_everywhere() -> None:
    assert dart_flight.__version__ == PROJECT["version"]
    page = (ROOT / "docs" / "interfaces.md").read_text(encoding="utf-8")
    assert f"(`dart-flight --version`) | {PROJECT['version']} |" in page


def pins() -> dict[str, str]:
    """Return name -> version of constraints.txt."""
    rows = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return dict(row.split("==") for row in rows if "==" in row)


def test_a_commit_is_checked_by_the_versions_of_make_test() -> None:
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))["repos"]
    found = {hook["id"]: (repo, hook) for repo in hooks for hook in repo["hooks"]}
    for name in ("ruff-format", "ruff-check"):
        assert found[name][0]["rev"] == f"v{pins()['ruff']}"
    # mypy runs in the environment of `make test`, which has the pinned version and the packages it reads.
    repo, hook = found["mypy"]
    assert (repo["repo"], hook["entry"], hook["stages"]) == ("local", ".venv/bin/mypy", ["pre-push"])


def test_the_workflow_tests_the_stated_versions_of_python() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yaml").read_text(encoding="utf-8"))
    matrix = workflow["jobs"]["test"]["strategy"]["matrix"]
    assert matrix["python"] == ["3.11", "3.13", "3.14"]
    stated = {text.rpartition(" ")[2] for text in PROJECT["classifiers"] if ":: Python :: 3." in text}
    assert stated <= set(matrix["python"])
