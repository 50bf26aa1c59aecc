"""The studio of this process in a headless Chromium, for its benchmark and its pictures."""

from __future__ import annotations

import contextlib
import re
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from dart_flight.lab.studio.open_file import OpenFile
from dart_flight.lab.studio.studio import Studio

COMPILING_S = 6.0  # a browser without a graphics processor stalls for 4 s while it compiles shaders
_OPTIONS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
_WAIT_MS = 60_000


@contextlib.contextmanager
def browser_page(width: int, height: int) -> Iterator[Page]:
    """Provide an empty page of a new browser."""
    with sync_playwright() as playwright:
        path = shutil.which("chromium")
        browser = playwright.chromium.launch(executable_path=path, args=list(_OPTIONS))
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(_WAIT_MS)
        yield page
        browser.close()


@contextlib.contextmanager
def shown_studio(page: Page, opened: OpenFile, log_dir: Path) -> Iterator[Studio]:
    """Show a studio in the page, and wait for the first verdict."""
    studio = Studio(opened, log_dir, ("127.0.0.1", 0))
    thread = threading.Thread(target=studio.run, daemon=True)
    thread.start()
    try:
        page.goto(f"http://127.0.0.1:{studio.server.get_port()}")
        wait_for_verdict(page)
        yield studio
    finally:
        studio.stop()
        thread.join()


def wait_for_verdict(page: Page) -> None:
    page.get_by_text(re.compile("^(go|no-go|error)")).first.wait_for()
