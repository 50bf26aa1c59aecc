"""Names between backticks on a page exist: files, folders, modules, classes, functions, keys."""

from __future__ import annotations

import functools
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.docs.snippets import PAGES, ROOT, name_of

SOURCES = ("dart_flight", "tools", "tests", "configs", "missions", "deploy", "docs/schemas")
_TEXT = {".py", ".yaml", ".json", ".params", ".service", ".rules", ".conf", ".sh", ".c", ".csv"}
_FENCED = re.compile(r"^ *```.*?^ *```\s*$", re.MULTILINE | re.DOTALL)
_QUOTED = re.compile(r"(?<!`)`([^`\n]+)`(?!`)(?!\s+at\s+commit)")
_FILE = re.compile(
    r"[\w./-]+\.(?:py|md|c|yaml|json|csv|toml|params|service|txt|html|js)|[\w.-]+(?:/[\w.-]+)*/"
)
_PYTHON = re.compile(r"(?:dart_flight|tools|tests)(?:\.\w+)+")
_NAME = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*(?:\(\))?")
_RECORDING = re.compile(r".*\.(?:ulg|mcap|bin|log)")
_ITEM = re.compile(r"\w+_(?:N|NAME)|rate_\w+|\w+_clearance")  # items of `check`, which composes these names


def quoted(page: Path) -> Iterator[str]:
    """Yield the text between backticks on a page, outside of fenced blocks."""
    yield from _QUOTED.findall(_FENCED.sub("", page.read_text(encoding="utf-8")))


@functools.cache
def paths() -> tuple[str, ...]:
    """Return every file and folder of the repository, each with a leading slash."""
    tops = [ROOT / name for name in (*SOURCES, "docs", "flights")]
    below = [path for top in tops for path in (top, *top.rglob("*")) if "__pycache__" not in path.parts]
    found = [path.relative_to(ROOT).as_posix() for path in (*below, *ROOT.glob("*"))]
    return tuple(f"/{path}" for path in found)


@functools.cache
def source() -> str:
    """Return the text of all sources."""
    files = [path for top in SOURCES for path in (ROOT / top).rglob("*") if path.suffix in _TEXT]
    files = [
        path for path in files if not {ROOT / "tests" / "docs", ROOT / "tests" / "data"} & {*path.parents}
    ]
    return "\n".join(path.read_text(encoding="utf-8") for path in (*files, ROOT / "pyproject.toml"))


@functools.cache
def words() -> frozenset[str]:
    """Return every word of the sources."""
    return frozenset(re.findall(r"[A-Za-z_]\w*", source()))


@functools.cache
def written_names() -> frozenset[str]:
    """Return the quoted names in the sources, such as files that the program writes, without endings."""
    return frozenset(re.findall(r"\"([\w-]+)(?:\.\w+)?\"", source()))


def is_python(name: str) -> bool:
    """Return whether a dotted name is that of a module or of something in a module."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:end]))
        except ModuleNotFoundError as error:
            if error.name is not None and error.name.split(".")[0] not in {"dart_flight", "tools", "tests"}:
                return True  # a package that the module needs is not installed
            continue
        for part in parts[end:]:
            found = getattr(found, part, None) or getattr(found, "__annotations__", {}).get(part)
        return found is not None
    return False


def exists(name: str) -> bool:
    """Return whether a name exists; true for text that is no name of this project."""
    if name.startswith("/") or _RECORDING.fullmatch(name) or _ITEM.fullmatch(name):
        return True
    if _PYTHON.fullmatch(name):
        return is_python(name)
    if _FILE.fullmatch(name):
        path = name.strip("/").removeprefix("./")
        is_stored = any(stored.endswith(f"/{path}") for stored in paths())
        last = path if name.endswith("/") else path.rpartition("/")[2].partition(".")[0]
        return is_stored or (not name.endswith((".py", ".md")) and last in written_names())
    if _NAME.fullmatch(name):
        return all(part in words() or part.isupper() for part in name.removesuffix("()").split("."))
    return True


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_name_quoted_on_a_page_exists(page: Path) -> None:
    assert sorted({name for name in quoted(page) if not exists(name)}) == []


def test_removed_names_are_detected() -> None:
    removed = [
        "config/vehicle.py",
        "tests/flight/",
        "dart_flight.recording.read_log",
        "closed_loop.ATTITUDE_LAG_S",
    ]
    assert [name for name in removed if exists(name)] == []
    present = ["core/pace.py", "tests/core/", "dart_flight.read_log", "ImuSample", "guard.deadman_s"]
    assert [name for name in present if not exists(name)] == []
