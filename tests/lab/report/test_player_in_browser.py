"""The animation of a page in a browser; without a browser, one line says that all these tests are skipped."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from dart_flight.lab.report.recorded_flight import RecordedFlight
from tests.lab.report.browser import Browser, find_browser

EXECUTABLE = find_browser()
if EXECUTABLE is None:
    pytest.skip("no Chromium found: install one, or name it in DART_BROWSER", allow_module_level=True)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    assert EXECUTABLE is not None
    with Browser(EXECUTABLE) as opened:
        yield opened


@pytest.fixture(scope="module")
def file(page: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pages") / "flight.html"
    path.write_text(page, encoding="utf-8")
    return path


FRAMES = "new Promise(done => { let n = %d; const f = () => --n ? requestAnimationFrame(f) : done(1); f(); })"
WHERE = "document.querySelector('.vehicle').getAttribute('transform')"
NOW = "Number(document.getElementById('time').value)"


def test_the_animation_does_not_move_before_user_input(browser: Browser, file: Path) -> None:
    for reduced in (False, True):
        browser.emulate(1280, reduced_motion=reduced)
        browser.open(file)
        begin = browser.evaluate(WHERE)
        browser.evaluate(FRAMES % 20)
        assert browser.evaluate(WHERE) == begin
        assert browser.evaluate("document.getAnimations().length") == 0
        assert browser.evaluate("document.getElementById('player').hidden") is False
        assert browser.problems() == []
        assert browser.requested() == []
        browser.evaluate("document.getElementById('time').focus()")
        browser.press("End", 35)
        assert browser.evaluate(WHERE) != begin


def test_keys_move_the_slider_by_steps_and_between_impacts(
    browser: Browser, file: Path, flight: RecordedFlight
) -> None:
    browser.emulate(1280)
    browser.open(file)
    browser.evaluate("document.getElementById('time').focus()")
    begin = browser.evaluate(NOW)
    browser.press("ArrowRight", 39)
    assert browser.evaluate(NOW) == pytest.approx(begin + 0.01, abs=1e-6)
    for impact in flight.impacts:
        browser.press("PageDown", 34)
        assert browser.evaluate(NOW) == pytest.approx(impact.at_s, abs=0.006)
        caption = browser.evaluate("document.querySelector('.said').textContent")
        assert caption.startswith(f"hit {impact.verdict.index}: {impact.verdict.wall}, {impact.verdict.mode}")
        lock = browser.evaluate("document.querySelector('.vehicle').getAttribute('class')")
        assert lock == f"vehicle {impact.verdict.mode}"
    browser.press("PageUp", 33)
    assert browser.evaluate(NOW) == pytest.approx(flight.impacts[0].at_s, abs=0.006)
    browser.press("Home", 36)
    assert browser.evaluate(NOW) == begin


def test_the_animation_plays_at_the_selected_rate_and_pauses(browser: Browser, file: Path) -> None:
    browser.emulate(1280)
    browser.open(file)
    browser.evaluate("document.getElementById('time').focus()")
    for rate in ("1", "0.1"):
        browser.evaluate(f"document.getElementById('rate').value = '{rate}'")
        browser.press(" ", 32)
        browser.evaluate(FRAMES % 4)
        went, took = browser.evaluate(
            f"new Promise(done => {{ const begin = performance.now(), from = {NOW}; const f = () =>"
            f" performance.now() - begin > 400 ? done([{NOW} - from, (performance.now() - begin) / 1000])"
            " : requestAnimationFrame(f); f(); })"
        )
        browser.press(" ", 32)
        assert went == pytest.approx(float(rate) * took, abs=0.04 + 0.1 * float(rate))
        paused = browser.evaluate(NOW)
        browser.evaluate(FRAMES % 5)
        assert browser.evaluate(NOW) == paused
        assert browser.evaluate("document.getElementById('play').getAttribute('aria-pressed')") == "false"


def test_touch_controls_work_on_a_phone(browser: Browser, file: Path, flight: RecordedFlight) -> None:
    browser.emulate(390, 844, touch=True)
    browser.open(file)
    assert browser.evaluate("document.documentElement.scrollWidth") <= 390
    sizes = browser.evaluate(
        "[...document.querySelectorAll('#player button, #player select, #time')]"
        ".map(e => e.getBoundingClientRect().height)"
    )
    assert min(sizes) >= 44
    browser.tap("[data-hit='2']")
    assert browser.evaluate(NOW) == pytest.approx(flight.impacts[1].at_s, abs=0.006)
    before = browser.evaluate(NOW)
    browser.tap("#play")
    browser.evaluate(FRAMES % 20)
    browser.tap("#play")
    assert browser.evaluate(NOW) > before
    browser.tap(".whole")
    span = browser.evaluate(
        "[Number(document.getElementById('time').min), Number(document.getElementById('time').max)]"
    )
    assert browser.evaluate(NOW) == pytest.approx(sum(span) / 2, rel=0.1)


def test_colours_follow_the_light_or_dark_preference(browser: Browser, file: Path) -> None:
    def brightness(expression: str) -> float:
        colour = browser.evaluate(expression)
        return float(np.mean([float(v) for v in re.findall(r"[\d.]+", colour)][:3]))

    paper = "getComputedStyle(document.body).backgroundColor"
    path = "getComputedStyle(document.querySelector('.flown')).stroke"
    for dark in (False, True):
        browser.emulate(1280, dark=dark)
        browser.open(file)
        assert (brightness(paper) < 60) is dark
        assert (brightness(path) > 180) is dark


def test_only_the_player_is_missing_without_scripts(browser: Browser, file: Path) -> None:
    browser.emulate(1280, scripts=False)
    try:
        browser.open(file)
        assert browser.evaluate("document.getElementById('player').getBoundingClientRect().height") == 0
        widths = browser.evaluate("[...document.images].map(i => i.complete && i.naturalWidth)")
        assert len(widths) >= 6
        assert min(widths) > 0
    finally:
        browser.emulate(1280)
