"""Pages agree with the software: generated parts, snippets, links and completeness."""

from __future__ import annotations

import configparser
import itertools
import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from dart_flight.base.records import Phase
from dart_flight.cli import COMMANDS, build_parser, main
from dart_flight.config.document import Document
from dart_flight.config.file_kinds import EXTENDS
from dart_flight.config.mission import parse_mission
from dart_flight.config.mission_file import WallSpec
from dart_flight.config.vehicle import Material, VehicleConfig, load_vehicle
from dart_flight.lab.search.scenario import load_scenario
from tests.docs.snippets import MANUAL, PAGES, RESULTS, ROOT, Block, blocks, name_of

ALL = [block for page in PAGES for block in blocks(page)]
LANGUAGES = {"", "sh", "yaml", "json", "ini", "mermaid", "python", "diff", "math"}


def blocks_in(language: str) -> list[Block]:
    return [block for block in ALL if block.language == language]


def test_every_code_block_has_a_checked_language() -> None:
    assert {block.language for block in ALL} <= LANGUAGES


# --- generated -------------------------------------------------------------------------------------------


def test_the_generated_parts_are_up_to_date() -> None:
    """These are parts of pages, the JSON Schemas, and the comments of configs/dart.yaml."""
    command = [sys.executable, "-m", "tools.docs.generated", "--check"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, ""), f"run make docs: {done.stdout}{done.stderr}"


def test_every_phase_is_explained() -> None:
    page = (ROOT / "docs" / "mission_phases.md").read_text(encoding="utf-8")
    for phase in Phase:
        assert f"| `{phase}` |" in page


def test_every_configuration_key_is_in_the_table() -> None:
    """Keys of the shipped file, and keys that only the schema has."""
    page = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
    document = Document.load(ROOT / "configs" / "dart.yaml")
    keys = {".".join(map(str, key)) for key in document.lines if key and not isinstance(key[-1], int)}
    schema = json.loads((ROOT / "docs" / "schemas" / "configuration.json").read_text(encoding="utf-8"))
    waiting = [("", schema["$ref"])]
    while waiting:
        place, reference = waiting.pop()
        for name, value in schema["$defs"][reference.rpartition("/")[2]].get("properties", {}).items():
            keys.add(place + name)
            waiting += [
                (f"{place}{name}.", option["$ref"])
                for option in (value, *value.get("anyOf", []))
                if "$ref" in option
            ]
    assert "mocap.url" in keys
    assert [key for key in sorted(keys) if f"`{key}`" not in page] == []


@pytest.mark.rest
@pytest.mark.usefixtures("every_package")
def test_the_concept_figures_can_be_drawn(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-m", "tools.docs.concept_figures", tmp_path], cwd=ROOT, check=True)
    drawn = {path.name for path in tmp_path.iterdir()}
    page = (ROOT / "docs" / "concepts.md").read_text(encoding="utf-8")
    assert drawn == set(re.findall(r"img/(concept_\w+\.png)", page))
    assert drawn <= {path.name for path in (ROOT / "docs" / "img").iterdir()}


def test_the_slow_pictures_exist_and_are_small() -> None:
    """Drawing them takes minutes, so `make docs` does it."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "(docs/img/dual_collision.gif)" in readme
    assert (ROOT / "docs" / "img" / "dual_collision.gif").stat().st_size < 1_500_000
    page = (ROOT / "docs" / "using_walls.md").read_text(encoding="utf-8")
    using_collisions = ("shuttle", "touch_and_return", "hairpin", "limited_sight")
    for name, ending in itertools.product(using_collisions, ("png", "gif")):
        assert f"(img/both_{name}.{ending})" in page
        assert (ROOT / "docs" / "img" / f"both_{name}.{ending}").stat().st_size < 300_000


# --- snippets --------------------------------------------------------------------------------------------


def _merged(base: Any, change: Any) -> Any:
    if isinstance(base, dict) and isinstance(change, dict):
        return base | {key: _merged(base.get(key), value) for key, value in change.items()}
    return change


@pytest.mark.parametrize("block", blocks_in("yaml"), ids=lambda b: b.place)
def test_a_yaml_block_is_accepted_by_the_loader(block: Block, tmp_path: Path) -> None:
    document = Document(block.text, block.place)
    tree = document.tree
    tree.pop(EXTENDS, None)  # the block is merged into dart.yaml below
    if "collisions" in tree:
        parse_mission(document, load_vehicle(ROOT / "configs" / "dart.yaml"))
    elif "sequence" in tree:
        path = tmp_path / "scenario.yaml"
        path.write_text(block.text)
        load_scenario(path, ROOT / "configs" / "dart.yaml")
    elif set(tree) <= {field.encode_name for field in msgspec.structs.fields(VehicleConfig)}:
        whole = Document.load(ROOT / "configs" / "dart.yaml")
        whole.tree = _merged(whole.tree, tree)
        whole.convert(VehicleConfig)
    elif set(tree) == {"walls"}:
        msgspec.convert(tree["walls"], dict[str, WallSpec])
    else:
        msgspec.convert(tree, dict[str, Material])


@pytest.mark.parametrize("block", blocks_in("ini"), ids=lambda b: b.place)
def test_an_ini_block_parses_and_has_sections(block: Block) -> None:
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.read_string(block.text)
    assert parser.sections()


@pytest.mark.rest
@pytest.mark.usefixtures("every_package")
@pytest.mark.parametrize("block", blocks_in("python"), ids=lambda b: b.place)
def test_a_python_block_runs_without_leaving_files(
    block: Block, recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.chdir(recorded)
    before = set(recorded.rglob("*"))
    exec(compile(block.text, block.place, "exec"), {"__name__": "__main__"})
    assert set(recorded.rglob("*")) == before, "the block leaves files behind"


# Objects whose keys are data, so that a page may show other ones.
OPEN = {"refused", "reasons", "residuals", "coefficients", "figures"}


def _shape_differences(shown: Any, real: Any, place: str) -> Iterator[str]:
    """Yield the differences between an object on a page and the real one in keys and types, not values."""
    if isinstance(shown, dict) and isinstance(real, dict):
        missing = set(shown) - set(real)
        undocumented = set() if place.rpartition(".")[2] in OPEN else set(real) - set(shown)
        yield from (f"{place}.{key} does not exist" for key in sorted(missing))
        yield from (f"{place}.{key} is not on the page" for key in sorted(undocumented))
        for key in set(shown) & set(real):
            yield from _shape_differences(shown[key], real[key], f"{place}.{key}")
    elif isinstance(shown, list) and isinstance(real, list):
        if shown and real:
            yield from _shape_differences(shown[0], real[0], f"{place}[]")
    elif shown is not None and real is not None:
        kinds = [
            float if isinstance(v, int | float) and not isinstance(v, bool) else type(v)
            for v in (shown, real)
        ]
        if kinds[0] is not kinds[1]:
            yield f"{place} is {real!r}, on the page {shown!r}"


def test_differences_of_shape_are_detected() -> None:
    assert not list(_shape_differences({"a": [1], "b": None}, {"a": [2.5, 3], "b": {"c": 1}}, ""))
    assert len(list(_shape_differences({"a": 1, "b": True}, {"a": "1", "c": 2, "b": 0.0}, ""))) == 3


@pytest.fixture(scope="module")
def recorded(laboratory: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder made by `init`, with one flight in its folder `demo`."""
    folder = shutil.copytree(laboratory, tmp_path_factory.mktemp("recorded") / "lab")
    return (folder / "flights").rename(folder / "demo").parent


_SLOW = re.compile("dry-run .*--runs|survey|plan|identify|campaign|report")


def _json_blocks() -> Iterator[object]:
    """Yield the JSON blocks; those of commands that take a second or more run in the rest."""
    for block in blocks_in("json"):
        if block.produced_by:
            marks = [pytest.mark.rest] if _SLOW.match(block.produced_by) else []
            yield pytest.param(block, marks=marks, id=block.place)


@pytest.mark.parametrize("block", list(_json_blocks()))
def test_a_json_block_has_the_shape_of_the_commands_output(
    block: Block,
    recorded: Path,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    if _SLOW.match(block.produced_by):
        request.getfixturevalue("every_package")
    shown = json.loads(block.text)
    monkeypatch.chdir(recorded)
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path))
    words = []
    for word in shlex.split(block.produced_by):
        words += [str(path) for path in recorded.glob(word)] if "*" in word else [word]
    assert main([*words, "--json"]) == 0
    real = json.loads(capsys.readouterr().out)
    assert list(_shape_differences(shown, real, "")) == []


# --- completeness ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_a_row_in_the_table(command: str) -> None:
    page = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    assert re.search(rf"^\| `{command}` \|", page, re.MULTILINE), (
        f"docs/commands.md needs a row for {command}"
    )


def test_every_option_named_in_commands_md_exists() -> None:
    page = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    parser = build_parser(list(COMMANDS))
    choices = parser._subparsers._group_actions[0].choices  # type: ignore[union-attr]
    options = {o for command in choices.values() for a in command._actions for o in a.option_strings}  # type: ignore[union-attr]
    assert set(re.findall(r"`(--[a-z][\w-]*)", page)) <= options


# --- links -----------------------------------------------------------------------------------------------

_LINK = re.compile(r"\]\(([^)\s]+)\)")
_NAMED = re.compile(r"\bdocs/[\w./-]+\.(?:md|png|svg|json)\b")
SOURCES = ("dart_flight", "tools", "tests", "configs", "missions", "deploy", "docs")


def _anchors(page: Path) -> set[str]:
    heads = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_link_has_a_target(page: Path) -> None:
    for target in _LINK.findall(page.read_text(encoding="utf-8")):
        if re.match(r"https?:|mailto:", target):
            continue
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        assert path.exists(), f"{name_of(page)}: {target}"
        assert not anchor or anchor in _anchors(path), f"{name_of(page)}: {target}"


def test_every_page_is_linked_from_the_index() -> None:
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    linked = {target.partition("#")[0] for target in _LINK.findall(index)}
    pages = {page.relative_to(ROOT / "docs").as_posix() for page in [*MANUAL[1:], *RESULTS]}
    assert pages - {"index.md"} <= linked


def test_every_page_named_in_the_sources_exists() -> None:
    files = [path for folder in SOURCES for path in (ROOT / folder).rglob("*") if path.suffix in _TEXT]
    # Recorded flights keep the names of their time.
    files = [path for path in files if ROOT / "tests" / "data" not in path.parents]
    files += [ROOT / name for name in ("README.md", "Makefile", "pyproject.toml")]
    missing = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in files
        for name in _NAMED.findall(path.read_text(encoding="utf-8"))
        if not (ROOT / name).exists()
    }
    assert not missing


_TEXT = {".py", ".md", ".yaml", ".params", ".sh", ".rules", ".conf", ".service"}
