"""Benchmark of the studio: its page in Chromium, with the browser's drawing (docs/studio.md).

The baseline of the start is `dart-flight --help`, and that of a flight the same flight by `dart-flight
dry-run --fast`. `python -m tools.bench studio` writes the figures into docs/results/studio.md.
"""

from __future__ import annotations

import itertools
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from playwright.sync_api import Page

from dart_flight.config.vehicle import packaged
from dart_flight.lab.studio import edits
from dart_flight.lab.studio.open_file import OpenFile, StudioKind
from dart_flight.lab.studio.studio import Studio
from tools.bench.latency import percentile
from tools.studio_browser import COMPILING_S, browser_page, shown_studio, wait_for_verdict

_EDITS, _FLIGHTS = 10, 50
_MORE_EDITS = 500  # of one mission, for the memory
_VERDICT_AFTER = """undo => {
    const text = document.body.innerText;
    return text.includes(undo) && /^(go|no-go|error)/m.test(text);
}"""


def rows() -> list[dict[str, Any]]:
    """Return rows for the benchmark table; they need Chromium and Playwright."""
    with tempfile.TemporaryDirectory() as folder, browser_page(1280, 800) as page:
        room = Path(folder)
        for name in ("missions", "configs"):
            shutil.copytree(packaged(name), room / name)
        return [_start(page, room), *_use(page, room)]


def _start(page: Page, room: Path) -> dict[str, Any]:
    """Measure the time from the command to a verdict in the page."""
    command = [sys.executable, "-m", "dart_flight"]
    began_s = time.perf_counter()
    subprocess.run([*command, "--help"], stdout=subprocess.DEVNULL, check=True)
    bare = time.perf_counter() - began_s
    began_s = time.perf_counter()
    studio = [*command, "studio", "missions/dual_collision.yaml", "--no-browser", "--port", "0"]
    with subprocess.Popen(studio, cwd=room, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        page.goto(process.stderr.readline().split()[1].rstrip(";"))
        wait_for_verdict(page)
        value = time.perf_counter() - began_s
        process.terminate()
    return _row("studio, command to verdict", value, "s", bare)


def _use(page: Page, room: Path) -> Iterator[dict[str, Any]]:
    """Measure edits, flights and memory, in a studio of this process."""
    times = []
    for path in sorted((room / "missions").glob("**/*.yaml")):
        opened = OpenFile.load(path)
        if opened.kind is StudioKind.MISSION:
            with shown_studio(page, opened, room / "flights") as studio:
                time.sleep(COMPILING_S)
                times += _edit(page, studio, _EDITS)
    yield _row(f"studio, edit checked and drawn, p50 of {len(times)}", percentile(times, 0.5), "s")
    yield _row(f"studio, edit checked and drawn, p95 of {len(times)}", percentile(times, 0.95), "s")

    mission = room / "missions/dual_collision.yaml"
    began_s = time.perf_counter()
    fast = [sys.executable, "-m", "dart_flight", "dry-run", "--fast", "missions/dual_collision.yaml"]
    subprocess.run(fast, cwd=room, capture_output=True, check=True)
    command_s = time.perf_counter() - began_s
    with shown_studio(page, OpenFile.load(mission), room / "flights") as studio:
        _edit(page, studio, 1)
        before = _memory_mb()
        page.get_by_role("tab", name="Fly", exact=True).click()
        plays = []
        for _ in range(_FLIGHTS):
            began_s = time.perf_counter()
            page.get_by_role("button", name="Fly", exact=True).click()
            _until(lambda: studio.player.is_moving)
            plays.append(time.perf_counter() - began_s)
            studio.page.post(studio.player.close)
            _until(lambda: not studio.player.is_moving)
        yield _row("studio, Fly to play, first", plays[0], "s", command_s)
        yield _row(f"studio, Fly to play, p95 of {len(plays)}", percentile(plays, 0.95), "s", command_s)
        _edit(page, studio, _MORE_EDITS)
        yield _row(
            f"studio, memory of {_FLIGHTS} flights, {_MORE_EDITS} edits",
            _memory_mb() - before,
            "MB",
        )
        yield _row("studio, Cancel of 1,000 flights", _cancelled(page), "s")


def _cancelled(page: Page) -> float:
    """Return how long Cancel takes after the progress of 1,000 flights has been seen."""
    page.locator("xpath=//label[.='flights']/following::input[not(@type='hidden')][1]").fill("1000")
    page.get_by_role("button", name="Fly", exact=True).click()
    page.get_by_text(re.compile(r"^[1-9]\d* of 1000 flights")).first.wait_for()
    began_s = time.perf_counter()
    page.get_by_role("button", name="Cancel", exact=True).click()
    page.get_by_role("button", name="Fly", exact=True).wait_for()
    return time.perf_counter() - began_s


def _edit(page: Page, studio: Studio, count: int) -> list[float]:
    """Move the objects of the room in turn, and return the times until the page shows the verdict."""
    scene = studio.page.scene
    assert scene is not None
    times = list[float]()
    for i, handle in zip(range(count), itertools.cycle(scene.handles), strict=False):
        x, y, _ = handle.position
        what = f"edit {i}"
        step_m = 0.001 * (1 + i)  # two corners of the bounds share a coordinate
        edit = edits.drag(handle.id, (x + step_m, y), handle.yaw_rad)._replace(what=what)
        began_s = time.perf_counter()
        studio.page.post(studio.page.apply, edit)
        page.wait_for_function(_VERDICT_AFTER, arg=f"undo: {what}", polling=10)
        times.append(time.perf_counter() - began_s)
    return times


def _until(condition: Any) -> None:
    while not condition():
        time.sleep(0.005)


def _memory_mb() -> float:
    """Return the resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
    return 1e-6 * pages * os.sysconf("SC_PAGE_SIZE")


def _row(name: str, value: float, unit: str, baseline: float | None = None) -> dict[str, Any]:
    ratio = None if baseline is None else baseline / value
    return {"name": name, "value": value, "unit": unit, "baseline": baseline, "ratio": ratio}
