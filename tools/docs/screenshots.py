"""Takes the pictures of pages in docs/report.md, in a real browser, from flights made for them.

python -m tools.docs.screenshots [FOLDER] [--only NAME ...]

Needs a Chromium (tools/docs/browser.py says how it is found).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import packaged
from dart_flight.lab.report.page import comparison_page, flight_page
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.faults.fault_table import parse_fault
from tools.docs.browser import Browser, find_browser

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "img"
_TRIALS = 10
# Where there was no such hit: what the guard did.
_AT_HIT = "document.querySelector('#player [data-hit=\"{}\"], #player .jumps button')?.click()"


def _mission(name: str) -> Mission:
    return load_flyable(packaged("missions", f"{name}.yaml"), packaged("configs", "dart.yaml"))


def _flown(mission: Mission, folder: Path, seed: int = 1, fault: str | None = None) -> RecordedFlight:
    verdict = fly_fast(mission, seed, folder, fault=None if fault is None else parse_fault(fault))
    if verdict.log is None:
        raise RuntimeError(f"{mission.name}: no log")
    return RecordedFlight.read(verdict.log)


def _single(folder: Path) -> str:
    return flight_page(_flown(_mission("paper_single_wall"), folder))


def _dual(folder: Path) -> str:
    return flight_page(_flown(_mission("paper_dual_collision"), folder))


def _aborted(folder: Path) -> str:
    return flight_page(_flown(_mission("paper_dual_collision"), folder, fault="wall-missing@approach"))


def _ten_trials(folder: Path) -> str:
    mission = _mission("paper_dual_collision")
    return comparison_page([_flown(mission, folder, seed) for seed in range(1, _TRIALS + 1)])


class Shot(NamedTuple):
    """A picture of a page.

    Attributes:
        page: makes it.
        width: of the reader's window.
        height: of the picture; None: to the end.
        hit: the animation stands at it.
        section: heading of the section at which the picture begins; "": at the top.
        dark: what the reader prefers.
        css: put on the page.
    """

    page: Callable[[Path], str]
    width: int = 1280
    height: int | None = 2100
    hit: int = 1
    section: str = ""
    dark: bool = False
    css: str = ""


SHOTS = {
    "report_single": Shot(_single),
    "report_dual": Shot(_dual, hit=2, height=3600),
    "report_dual_dark": Shot(_dual, hit=2, height=1700, dark=True),
    "report_dual_phone": Shot(_dual, 390, 2600, hit=2),
    "report_dual_grey": Shot(_dual, height=1500, section="Force of each impact", css="filter: grayscale(1)"),
    "report_aborted": Shot(_aborted),
    "report_ten": Shot(_ten_trials, height=2400),
}


def take(shot: Shot, page: Path, browser: Browser, path: Path) -> None:
    """One picture of a page that is already made.

    Raises:
        RuntimeError: the page asked the network for something, or its script failed.
    """
    browser.emulate(shot.width, 900, dark=shot.dark, touch=shot.width < 600)
    browser.open(page)
    if browser.problems() or browser.requested():
        raise RuntimeError(f"{page.name}: {browser.problems()} {browser.requested()}")
    browser.evaluate(_AT_HIT.format(shot.hit))
    if shot.css:
        browser.evaluate(f"document.documentElement.style.cssText = {shot.css!r}")
    top = 0
    if shot.section:
        found = f"[...document.querySelectorAll('h2')].find(h => h.textContent === {shot.section!r})"
        top = int(browser.evaluate(f"{found}.getBoundingClientRect().top + scrollY")) - 12
    browser.screenshot(path, shot.height, top)
    small_png(path)


def small_png(path: Path) -> None:
    """Store a picture with a palette: pages have few colours."""
    from PIL import Image  # noqa: PLC0415  (comes with matplotlib)

    with Image.open(path) as image:
        small = image.convert("RGB").quantize(128, dither=Image.Dither.NONE)
    small.save(path, optimize=True)


def main() -> None:
    """Take all of them, or those that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER)
    parser.add_argument("--only", nargs="+", choices=sorted(SHOTS), default=list(SHOTS))
    arguments = parser.parse_args()
    executable = find_browser()
    if executable is None:
        raise SystemExit("no Chromium found: install one, or name it in DART_BROWSER")
    pages: dict[Callable[[Path], str], Path] = {}
    with tempfile.TemporaryDirectory() as scratch, Browser(executable) as browser:
        for name in arguments.only:
            shot = SHOTS[name]
            if shot.page not in pages:
                folder = Path(scratch) / name
                folder.mkdir()
                pages[shot.page] = folder / "page.html"
                pages[shot.page].write_text(shot.page(folder), encoding="utf-8")
            take(shot, pages[shot.page], browser, arguments.folder / f"{name}.png")
            print(name)


if __name__ == "__main__":
    main()
