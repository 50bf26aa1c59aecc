"""Draw the pictures of docs/studio.md: the room of the dual collision, and a flight at its second hit.

python -m tools.docs.studio_pictures
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import time
from pathlib import Path

from dart_flight.config.vehicle import packaged
from dart_flight.lab.studio.open_file import OpenFile
from tools.campaigns.results import ROOT
from tools.studio_browser import COMPILING_S, browser_page, shown_studio

_SIZE = (1100, 980)
_SECOND_HIT_S = "10.28"  # at the greatest force


def main() -> None:
    pictures = ROOT / "docs" / "img"
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder), browser_page(*_SIZE) as page:
        for name in ("missions", "configs"):
            shutil.copytree(packaged(name), name)
        opened = OpenFile.load(Path("missions/dual_collision.yaml"))
        with shown_studio(page, opened, Path("flights")):
            time.sleep(COMPILING_S)
            page.locator(".mantine-Notification-closeButton").click()  # software WebGL
            time.sleep(1.0)
            page.screenshot(path=pictures / "studio_room.png")
            page.get_by_role("tab", name="Fly", exact=True).click()
            page.get_by_role("button", name="Fly", exact=True).click()
            page.get_by_role("button", name="Pause", exact=True).click()
            time.sleep(COMPILING_S)  # the last frames would overwrite the time
            page.locator("xpath=//label[.='time, s']/following::input[not(@type='hidden')][1]").fill(
                _SECOND_HIT_S
            )
            time.sleep(COMPILING_S)
            page.screenshot(path=pictures / "studio_flight.png")


if __name__ == "__main__":
    main()
