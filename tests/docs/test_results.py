"""Pages of results: every figure comes from a command that exists, and README's figures from these pages."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs.snippets import RESULTS, ROOT, name_of
from tests.docs.test_extending import copy_project, python

KEPT = ("real_data", "raspberry_pi", "hitl")
CAMPAIGNS = {path.stem for path in (ROOT / "tools" / "campaigns").glob("*.yaml")}
BENCHES = {f"bench {path.stem}" for path in (ROOT / "tools" / "bench").glob("*.py")}
_BLOCK = re.compile(r"^<!-- measured: (.+?) -->\n(.*?)^<!-- end: \1 -->$", re.DOTALL | re.MULTILINE)
_LINE = re.compile(r"Measured on \d{4}-\d{2}-\d{2} by `[^`]+` at commit [0-9a-f]{7,}: ")
_LINKED = re.compile(r"\((docs/results/\w+\.md)\)")


@pytest.mark.parametrize("page", RESULTS, ids=name_of)
def test_every_results_page_has_measured_blocks(page: Path) -> None:
    """A block begins with date, command and commit. Three pages keep an older measurement, and say why."""
    text = page.read_text(encoding="utf-8")
    if page.stem in KEPT:
        assert re.search(r"\n\nKept: measured on [\d-]+ by `[^`]+` at commit [0-9a-f]+, because", text)
        return
    blocks = _BLOCK.findall(text)
    assert blocks
    assert len(blocks) == text.count("<!-- measured:") == text.count("<!-- end:")
    for name, measured in blocks:
        assert name in CAMPAIGNS | BENCHES
        assert _LINE.match(measured), name


def test_every_campaign_has_a_block() -> None:
    written = {name for page in RESULTS for name, _ in _BLOCK.findall(page.read_text(encoding="utf-8"))}
    assert written >= CAMPAIGNS


@pytest.mark.parametrize("page", RESULTS, ids=name_of)
def test_every_results_page_is_short(page: Path) -> None:
    """Date, command, table, meaning and limits suffice; git has the rest."""
    assert len(page.read_text(encoding="utf-8").split()) <= 400


def test_the_list_names_a_measurement_of_every_page() -> None:
    if not (ROOT / ".git").exists() or (ROOT / ".git" / "shallow").exists():
        pytest.skip("needs the history of the project")
    command = [sys.executable, "-m", "tools.campaigns", "--list"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    assert {line.split()[0] for line in done.stdout.splitlines()[1:]} == {page.stem for page in RESULTS}


@pytest.mark.rest
@pytest.mark.usefixtures("every_package")
def test_a_campaign_writes_its_block_and_names_the_commit(tmp_path: Path) -> None:
    copy_project(tmp_path)

    def git(*arguments: str) -> str:
        words = ["git", "-c", "user.name=test", "-c", "user.email=test@localhost", *arguments]
        return subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.strip()

    git("init", "-q")
    git("add", "-A")
    git("commit", "-qm", "All files")
    page = tmp_path / "docs" / "results" / "identification.md"
    before = page.read_text(encoding="utf-8")
    measure = ("-m", "tools.campaigns", "identification", "--runs", "1", "--jobs", "1")
    assert python(tmp_path, *measure, "--out", str(tmp_path / "out"))[0] == 0
    assert page.read_text(encoding="utf-8") == before
    assert python(tmp_path, *measure)[0] == 0
    ((name, measured),) = _BLOCK.findall(page.read_text(encoding="utf-8"))
    assert name == "identification"
    assert f"at commit {git('rev-parse', '--short=8', 'HEAD')}: 8 runs" in measured
    assert "`python -m tools.campaigns identification --runs 1`" in measured
    assert _BLOCK.sub("", page.read_text(encoding="utf-8")) == _BLOCK.sub("", before)
    with open(tmp_path / "tools" / "__init__.py", "a", encoding="utf-8") as file:
        file.write("# changed\n")
    status, output = python(tmp_path, *measure, "--resume")
    assert status == 2
    assert "commit first; changed: tools/__init__.py" in output


def figures_without_a_page(readme: str) -> list[str]:
    """Return the figures in the README's list of results that do not stand on a page linked beside them."""
    section = readme.partition("## Results in simulation\n")[2].partition("\n## ")[0]
    lost = []
    for item in section.split("\n- ")[1:]:
        pages = [(ROOT / name).read_text(encoding="utf-8") for name in _LINKED.findall(item)]
        for figure in re.findall(r"\d[\d,.]*\d|\d", re.sub(r"\]\([^)]*\)", "]", item)):
            pattern = rf"(?<![\d.,]){re.escape(figure)}(?![\d])"
            lost += [] if any(re.search(pattern, page) for page in pages) else [figure]
    return lost


def test_the_figures_of_the_readme_stand_on_the_linked_pages() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert readme.count("\n- ", readme.index("## Results in simulation")) >= 3
    assert figures_without_a_page(readme) == []


def test_a_figure_that_is_not_on_the_linked_page_is_found() -> None:
    text = "## Results in simulation\n\n- All [7,654,321](docs/results/force.md) hits.\n"
    assert figures_without_a_page(text) == ["7,654,321"]


@pytest.mark.rest
def test_a_run_without_a_result_is_counted_and_no_fault(tmp_path: Path) -> None:
    """The wall of seed 9097 has a tenth of the configured stiffness, so the flight ends without a contact."""
    options = ("--only", "set=wood-all", "--seed", "9097", "--runs", "1", "--out", str(tmp_path / "out"))
    status, output = python(ROOT, "-m", "tools.campaigns", "contact_fit", *options)
    assert status == 0
    assert "Without a result: 1 of 1 runs (no contact 1)." in output
