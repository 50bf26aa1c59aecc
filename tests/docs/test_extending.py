"""Every recipe of docs/extending.md is applied to a copy of the project, where its check must pass."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
COPIED = ("dart_flight", "tests", "configs", "missions", "docs", "tools")
MAX_FILES = 6


class Change(NamedTuple):
    """Lines of a file and their replacement; without `before`, a new file."""

    path: str
    before: str
    after: str


class Recipe(NamedTuple):
    """One section of the page."""

    title: str
    changes: list[Change]
    check: list[str]

    @property
    def package_files(self) -> set[str]:
        """The changed files outside of tests and pages."""
        return {change.path for change in self.changes if change.path.startswith(("dart_flight/", "tools/"))}


def changes_in(diff: str) -> list[Change]:
    found = []
    for part in re.split(r"^\+\+\+ ", diff, flags=re.MULTILINE)[1:]:
        path, _, body = part.partition("\n")
        for hunk in re.split(r"^@@\n", body, flags=re.MULTILINE) if body.startswith("@@") else [body]:
            lines = hunk.splitlines(keepends=True)
            before = "".join(line[1:] or "\n" for line in lines if not line.startswith("+"))
            after = "".join(line[1:] or "\n" for line in lines if not line.startswith("-"))
            if after or before:
                found.append(Change(path, before, after))
    return found


def recipes() -> list[Recipe]:
    found = []
    for section in re.split(r"^## ", PAGE, flags=re.MULTILINE)[1:]:
        diffs = re.findall(r"^```diff\n(.*?)^```$", section, re.MULTILINE | re.DOTALL)
        check = re.search(r"^Check: `python (.+)`$", section, re.MULTILINE)
        assert check, section.splitlines()[0]
        changes = [change for diff in diffs for change in changes_in(diff)]
        found.append(Recipe(section.splitlines()[0], changes, shlex.split(check[1])))
    return found


RECIPES = recipes()


def apply(change: Change, root: Path) -> None:
    path = root / change.path
    if not change.before:
        assert not path.exists(), f"{change.path} exists already"
        path.write_text(change.after, encoding="utf-8")
        return
    text = "\n" + path.read_text(encoding="utf-8")
    count = text.count("\n" + change.before)
    assert count == 1, f"{change.path} has these lines {count} times, expected once:\n{change.before}"
    path.write_text(text.replace("\n" + change.before, "\n" + change.after)[1:], encoding="utf-8")


def test_the_page_lists_every_recipe_with_its_number_of_files() -> None:
    rows = re.findall(r"^\| \[(.+?)\]\(#.+?\) \| (\d+) \|$", PAGE, re.MULTILINE)
    assert [(r.title.lower(), str(len(r.package_files))) for r in RECIPES] == rows
    assert all(len(r.package_files) <= MAX_FILES for r in RECIPES)


def copy_project(root: Path) -> None:
    for name in COPIED:
        ignored = shutil.ignore_patterns("__pycache__", "img", *(["data"] if name == "tests" else []))
        shutil.copytree(ROOT / name, root / name, ignore=ignored)
    (root / "tests" / "data").symlink_to(ROOT / "tests" / "data")
    shutil.copy(ROOT / "pyproject.toml", root)


def python(root: Path, *arguments: str) -> tuple[int, str]:
    """Run Python in the copy and return exit status and output."""
    environment = {**os.environ, "PYTHONPATH": str(root)}
    done = subprocess.run(
        [sys.executable, *arguments], cwd=root, env=environment, capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout + done.stderr


def test_the_lines_that_a_recipe_changes_exist_once(tmp_path: Path) -> None:
    copy_project(tmp_path)
    for recipe in RECIPES:
        for change in recipe.changes:
            path, text = tmp_path / change.path, "\n" + change.before
            assert path.exists() == bool(change.before), f"{recipe.title}: {change.path}"
            assert not change.before or ("\n" + path.read_text("utf-8")).count(text) == 1, recipe.title


def selection(check: list[str]) -> str:
    """Return the tests of a check as an expression for `-k`."""
    files = " or ".join(Path(word).stem for word in check if word.endswith(".py"))
    return f"(({files}) and ({check[check.index('-k') + 1]}))" if "-k" in check else f"({files})"


@pytest.mark.rest
def test_the_recipes_work_as_written(tmp_path: Path) -> None:
    """All are applied to one copy, whose checks run in one process: no recipe disturbs another."""
    copy_project(tmp_path)
    for change in (change for recipe in RECIPES for change in recipe.changes):
        apply(change, tmp_path)
    for arguments in (["check"], ["format", "--check"]):
        status, output = python(tmp_path, "-m", "ruff", *arguments, "--no-cache")
        assert status == 0, output
    checks = [recipe.check for recipe in RECIPES]
    assert all(check[:2] == ["-m", "pytest"] for check in checks)
    files = dict.fromkeys(word for check in checks for word in check if word.endswith(".py"))
    words = ["-vv", "-p", "no:cacheprovider", "-p", "no:xdist", "-k", " or ".join(map(selection, checks))]
    status, output = python(tmp_path, "-m", "pytest", *files, *words)
    assert status == 0, output
    assert {line.partition("::")[0] for line in output.splitlines() if " PASSED" in line} == set(files)


MOTION_CAPTURE = next(recipe for recipe in RECIPES if recipe.title == "A motion-capture system")


@pytest.mark.rest
@pytest.mark.parametrize("left_out", sorted({change.path for change in MOTION_CAPTURE.changes}))
def test_a_motion_capture_system_without_one_of_its_parts_fails_its_check(
    left_out: str, tmp_path: Path
) -> None:
    copy_project(tmp_path)
    for change in MOTION_CAPTURE.changes:
        if change.path != left_out:
            apply(change, tmp_path)
    status, output = python(tmp_path, *MOTION_CAPTURE.check, "-x", "-p", "no:cacheprovider")
    assert status == 1, output
    assert "1 failed" in output


def test_a_lock_driver_without_an_entry_is_rejected_on_import(tmp_path: Path) -> None:
    copy_project(tmp_path)
    for change in next(r for r in RECIPES if r.title == "A lock driver").changes:
        if change.path != "dart_flight/lock/drivers/__init__.py":
            apply(change, tmp_path)
    status, output = python(tmp_path, "-c", "import dart_flight.cli.options")
    assert status == 1
    assert "lock drivers without an entry in DRIVERS" in output
