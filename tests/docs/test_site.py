"""The manual as static pages: what the build refuses, what it contains, and what its search finds."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import dart_flight
from tests.docs.snippets import MANUAL, RESULTS, ROOT

pytestmark = [
    pytest.mark.rest,
    pytest.mark.skipif(
        importlib.util.find_spec("sphinx") is None,
        reason="the generator of the site (extra `site`) is missing",
    ),
]


def build(site: Path, *docs: Path) -> subprocess.CompletedProcess[str]:
    """Build the site of docs/, or of other pages."""
    command = [sys.executable, "-m", "tools.site", str(site), *map(str, docs)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("manual") / "site"
    done = build(folder)
    assert (done.returncode, done.stderr) == (0, "")
    return folder


def test_the_site_has_every_page_and_every_name_of_the_python_interface(site: Path) -> None:
    from bs4 import BeautifulSoup

    entries = [
        link["href"]
        for page in ("index", "all_results")
        for link in BeautifulSoup((site / f"{page}.html").read_text("utf-8"), "html.parser").select(
            ".sidebar-tree a"
        )
    ]
    pages = [
        page.relative_to(ROOT / "docs").with_suffix(".html").as_posix() for page in (*MANUAL[1:], *RESULTS)
    ]
    assert [page for page in pages if page not in (*entries, "index.html")] == []
    reference = (site / "reference.html").read_text("utf-8")
    assert [name for name in dart_flight.__all__ if f'id="dart_flight.{name}"' not in reference] == []


def test_the_site_needs_no_other_address(site: Path) -> None:
    from bs4 import BeautifulSoup

    for path in site.rglob("*.html"):
        page = BeautifulSoup(path.read_text("utf-8"), "html.parser")
        loaded = [tag.get("src") or tag.get("href") for tag in page.select("[src], link[href]")]
        assert [address for address in loaded if "//" in str(address)] == [], path.name
    assert "<math" in (site / "contact.html").read_text("utf-8")
    assert "<svg" in (site / "mission_phases.html").read_text("utf-8")


def test_mistakes_in_the_pages_fail_the_build(tmp_path: Path) -> None:
    mistakes = "[a page](missing.md) [a heading](index.md#missing-heading) ![a picture](missing.png)"
    docs = tmp_path / "docs"
    docs.mkdir()
    (docs / "index.md").write_text("# Index\n\n[A page](page.md)\n\n## Results\n\n| subject | page |\n")
    (docs / "page.md").write_text(f"# A page\n\n{mistakes}\n")
    (docs / "unreached.md").write_text("# A page that the index does not name\n")
    done = build(tmp_path / "site", docs)
    assert done.returncode != 0
    found = [line for line in done.stderr.splitlines() if "page.md" in line or "unreached.md" in line]
    for name in ("missing.md", "missing-heading", "missing.png", "unreached.md"):
        assert any(name in line for line in found), name


@pytest.fixture(scope="module")
def search_page(site: Path) -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("Chromium is not installed")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page()
        page.goto((site / "search.html").as_uri())
        yield page
        browser.close()


@pytest.mark.parametrize(
    ("question", "address", "answer"),
    [
        (
            "how to change the servo's pulse for rigid",
            "configuration.html#every-key",
            "lock.servo.rigid_pulse_us",
        ),
        (
            "what does reset_step mean",
            "guard.html#the-estimator-after-an-impact",
            "measures how far the reset moved",
        ),
        (
            "which port does QGroundControl use",
            "ground_station.html#the-port-of-qgroundcontrol",
            "UDP port 14550",
        ),
        ("how to read a force from a log in Python", "python.html#from-python", '["/estimate/force"]'),
        ("how to read the force from a log", "python.html#from-python", '["/estimate/force"]'),
        ("exit code", "commands.html#exit-status", "how it ended"),
        ("QGC port", "ground_station.html#the-port-of-qgroundcontrol", "UDP port 14550"),
        ("lock.servo.rigid_pulse_us", "configuration.html#every-key", "lock.servo.rigid_pulse_us"),
        (
            "measure room walls by hand carrying the vehicle",
            "room.html#measure-the-walls-with-the-vehicle",
            "hold the vehicle by hand",
        ),
    ],
)
def test_the_first_result_of_the_search_answers(
    search_page: Any, question: str, address: str, answer: str
) -> None:
    search_page.fill(".sidebar-search", question)
    first = search_page.locator("ul.search li").first
    assert first.locator("a").get_attribute("href").partition(":~:")[0] == address
    assert answer in first.inner_text()


_BROKEN_WORDS = """() => {
  const broken = [], range = document.createRange();
  for (const cell of document.querySelectorAll("article td, article th")) {
    const walker = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT);
    while (walker.nextNode())
      for (const word of walker.currentNode.textContent.matchAll(/[A-Za-z0-9]{3,}/g)) {
        range.setStart(walker.currentNode, word.index);
        range.setEnd(walker.currentNode, word.index + word[0].length);
        if (range.getClientRects().length > 1) broken.push(word[0]);
      }
  }
  return broken;
}"""


@pytest.mark.parametrize("width", [1280, 400])
def test_words_of_tables_stay_whole(site: Path, search_page: Any, width: int) -> None:
    """A word of the guard's table that is broken in the middle is higher than a line."""
    page = search_page.context.browser.new_page()
    page.set_viewport_size({"width": width, "height": 900})
    page.goto((site / "guard.html").as_uri())
    broken = page.evaluate(_BROKEN_WORDS)
    page.close()
    assert broken == []


def test_attributes_that_share_a_line_are_apart(site: Path) -> None:
    text = (site / "reference.html").read_text("utf-8")
    assert "(normal_out_m_s,)" not in text
    assert "<strong>normal_out_m_s</strong>" in text
