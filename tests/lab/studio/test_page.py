"""The studio's page in Debian's Chromium: skipped where the browser, viser or Playwright is missing."""

import contextlib
import math
import re
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

CHROMIUM = shutil.which("chromium")
if CHROMIUM is None:
    pytest.skip("the page of the studio needs chromium", allow_module_level=True)
pytest.importorskip("viser", reason="the page of the studio needs viser (extra studio)")
sync_api = pytest.importorskip("playwright.sync_api", reason="the tests of the page need playwright")

from dart_flight.config.vehicle import packaged  # noqa: E402
from dart_flight.lab.studio import edits  # noqa: E402
from dart_flight.lab.studio.open_file import OpenFile  # noqa: E402
from dart_flight.lab.studio.scene_model import WallShape  # noqa: E402
from dart_flight.lab.studio.studio import Studio  # noqa: E402

pytestmark = pytest.mark.browser
LAUNCH = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
# The browser draws with the processor here: fewer frames leave time for the rest.
FEW_FRAMES = """{
    const request = window.requestAnimationFrame.bind(window);
    window.requestAnimationFrame = draw => setTimeout(() => request(draw), 200);
}"""
WAIT_MS = 120_000  # on a busy computer
_TRIES = 4
_DRAGS = 6  # a slow browser may not have drawn the wall when the mouse is pressed


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=list(LAUNCH))
        yield started
        started.close()


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """A copy of the shipped folders, in which missions find their vehicle."""
    for folder in ("missions", "configs"):
        shutil.copytree(packaged(folder), tmp_path / folder)
    return tmp_path


class Shown(NamedTuple):
    """A studio, and its page in the browser."""

    studio: Studio
    page: Any

    def button(self, name: str) -> Any:
        return self.page.get_by_role("button", name=name, exact=True)

    def press(self, name: str) -> None:
        """Click a button; Playwright may wait for ever for two frames of a browser that compiles shaders."""
        for _ in range(_TRIES):
            with contextlib.suppress(sync_api.TimeoutError):
                self.button(name).click(timeout=WAIT_MS / _TRIES)
                return
        raise AssertionError(f"the button {name} could not be clicked")

    def tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name, exact=True).click()

    def wait_for(self, text: str | re.Pattern[str]) -> None:
        self.page.get_by_text(text).first.wait_for(timeout=WAIT_MS)

    def number(self, label: str) -> Any:
        """Return the input beside a label."""
        return self.page.locator(f"xpath=//label[.='{label}']/following::input[not(@type='hidden')][1]")

    def choose(self, label: str, option: str) -> None:
        self.page.locator(f"xpath=//label[.='{label}']/following::input[1]").click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def pixel_of(self, x: float, y: float, z: float) -> tuple[float, float]:
        """Return where a point of the room is in the page, seen from above."""
        camera = next(iter(self.studio.server.get_clients().values())).camera
        (cx, _, cz), cy = camera.position, camera.look_at[1]
        scale = 0.5 * camera.image_height / math.tan(0.5 * camera.fov) / (cz - z)
        return 0.5 * camera.image_width + (x - cx) * scale, 0.5 * camera.image_height - (y - cy) * scale

    def drag(self, begin: tuple[float, float], end: tuple[float, float]) -> None:
        mouse = self.page.mouse
        mouse.move(*begin)
        mouse.down()
        for i in range(1, 11):
            share = 0.1 * i
            mouse.move(*((1.0 - share) * a + share * b for a, b in zip(begin, end, strict=True)))
            time.sleep(0.03)
        mouse.up()

    def look_from_above(self, tab: str) -> None:
        """Aim the camera again, which a drag beside an object turns, and return to a tab."""
        self.tab("View")
        self.press("From above")
        self.tab(tab)


@contextlib.contextmanager
def shown(browser: Any, opened: OpenFile | list[Path], logs: Path, **options: Any) -> Iterator[Shown]:
    studio = Studio(opened, logs, ("127.0.0.1", 0), **options)
    thread = threading.Thread(target=studio.run, daemon=True)
    thread.start()
    context = browser.new_context(viewport={"width": 1000, "height": 700})
    context.set_default_timeout(WAIT_MS)
    context.add_init_script(FEW_FRAMES)
    try:
        page = context.new_page()
        page.goto(f"http://127.0.0.1:{studio.server.get_port()}")
        page.get_by_role("tab").first.wait_for()
        until(studio.server.get_clients)
        try:
            yield Shown(studio, page)
        except BaseException:
            page.screenshot(path=logs.parent / "failed.png")
            raise
    finally:
        context.close()
        studio.stop()
        thread.join(1e-3 * WAIT_MS)
        assert not thread.is_alive()


def happens(condition: Any, timeout_s: float = 10.0) -> bool:
    """Wait for something that may not happen."""
    end = time.monotonic() + timeout_s
    while not (found := bool(condition())) and time.monotonic() < end:
        time.sleep(0.02)
    return found


def until(condition: Any) -> None:
    assert happens(condition, 1e-3 * WAIT_MS), "timeout"


def wall_of(at: Shown, name: str) -> WallShape:
    scene = at.studio.page.scene
    assert scene is not None
    return next(wall for wall in scene.walls if wall.id == f"wall/{name}")


def grip_of(at: Shown, wall: WallShape) -> tuple[float, float]:
    """Return a pixel on top of a wall's solid, away from its knob."""
    x, y = wall.drawn.outline.mean(axis=0)
    along = (-math.sin(wall.yaw_rad), math.cos(wall.yaw_rad))
    scene = at.studio.page.scene
    assert scene is not None
    return at.pixel_of(x + 0.5 * along[0], y + 0.5 * along[1], scene.bounds.z[1])


def test_a_wall_is_moved_with_the_mouse_typed_undone_and_saved(browser: Any, room: Path) -> None:
    path = room / "missions/dual_collision.yaml"
    before = path.read_bytes()
    with shown(browser, OpenFile.load(path), room / "flights") as at:
        at.wait_for(re.compile("^go$"))
        file = at.studio.page.file
        assert file is not None
        wall = wall_of(at, "acrylic")
        for _ in range(_DRAGS):
            begin = grip_of(at, wall)
            beside = at.pixel_of(-0.8, 0.0, 1.0)[0] - at.pixel_of(0.0, 0.0, 1.0)[0]
            at.drag(begin, (begin[0] + beside, begin[1]))
            if happens(lambda: file.is_changed):
                break
            at.look_from_above("Room")
        x, y = file.tree["walls"]["acrylic"]["point_m"]
        assert x == pytest.approx(0.85, abs=0.03)
        assert y == pytest.approx(0.0, abs=0.03)
        at.wait_for(re.compile("^error: line 10: goal"))  # the goal is behind the wall
        at.number("x, m").fill("1.6123")
        until(lambda: file.tree["walls"]["acrylic"]["point_m"][0] == 1.6123)
        assert path.read_bytes() == before
        for _ in range(2):
            at.press("Undo")
        until(lambda: not file.is_changed)
        at.number("x, m").fill("1.66")
        until(lambda: file.tree["walls"]["acrylic"]["point_m"][0] == 1.66)
        at.press("Save")
        until(lambda: path.read_bytes() != before)
    changed = [
        (a, b) for a, b in zip(before.splitlines(), path.read_bytes().splitlines(), strict=True) if a != b
    ]
    assert len(changed) == 1
    assert changed[0][1] == changed[0][0].replace(b"1.65", b"1.66")


def test_a_changed_file_on_the_disk_is_shown_and_two_changes_are_asked_about(
    browser: Any, room: Path
) -> None:
    path = room / "missions/dual_collision.yaml"
    text = path.read_text()
    with shown(browser, OpenFile.load(path), room / "flights") as at:
        at.wait_for(re.compile("^go$"))
        path.write_text(text.replace("length_m: 3.0", "length_m: 2.5"))
        at.wait_for(re.compile("reloaded from the disk"))
        at.number("altitude, m").fill("1.1")
        file = at.studio.page.file
        assert file is not None
        until(lambda: "altitude_m: 1.1" in file.text)
        path.write_text("walls: {")  # not YAML any more
        at.wait_for(re.compile("changed on the disk, and here"))
        at.press("Reload from the disk")
        at.wait_for(re.compile("expected|could not find|YAML"))
        assert "altitude_m: 1.1" in file.text  # no edit is lost
        at.press("Overwrite the file")
        at.wait_for(re.compile("^saved"))
        assert "altitude_m: 1.1" in path.read_text()
        at.button("Reload from the disk").wait_for(state="hidden")


def test_two_tabs_show_the_same_room_and_a_closed_or_reloaded_one_keeps_the_edits(
    browser: Any, room: Path
) -> None:
    with shown(browser, OpenFile.load(room / "missions/hover.yaml"), room / "flights") as at:
        second = at.page.context.new_page()
        second.goto(at.page.url)
        other = Shown(at.studio, second)
        at.wait_for(re.compile("^go$"))
        at.number("x, m").fill("0.25")
        other.wait_for(re.compile("undo: set start"))
        until(lambda: other.number("x, m").input_value() == "0.25")
        at.page.close()
        second.reload()
        until(lambda: other.number("x, m").input_value() == "0.25")
        other.press("Undo")
        until(lambda: other.number("x, m").input_value() == "0")


def test_a_flight_is_flown_and_played_to_its_end(browser: Any, room: Path) -> None:
    with shown(browser, OpenFile.load(room / "missions/single_wall.yaml"), room / "flights") as at:
        at.tab("Fly")
        at.press("Fly")
        at.wait_for(re.compile("completed"))
        until(lambda: at.studio.player.flight is not None)
        at.press("Next hit")  # pauses
        at.wait_for(re.compile("normal force"))
        hit = at.studio.player.flight.hits[0]  # type: ignore[union-attr]
        until(lambda: abs(at.studio.player.at_s - (hit.at_s - 0.3)) < 0.05)
        at.number("speed").fill("4")
        at.press("Play")
        end = at.studio.player.flight.time_s[-1]  # type: ignore[union-attr]
        until(lambda: at.studio.player.at_s == end)
        at.press("Report")
        at.wait_for("open the report")
        (log,) = (room / "flights").glob("*/flight.mcap")
    shutil.copytree(log.parent, room / "again")
    for logs in ([log], [log, room / "again/flight.mcap"]):  # the same flight, from its file, and twice
        with shown(browser, logs, room / "flights") as at:
            at.wait_for(re.compile("completed"))
            until(lambda at=at: at.studio.player.flight is not None)
            if len(logs) > 1:
                at.wait_for(re.compile("100 %"))


def test_many_flights_are_lines_and_one_of_them_is_opened(browser: Any, room: Path) -> None:
    with shown(browser, OpenFile.load(room / "missions/single_wall.yaml"), room / "flights") as at:
        at.tab("Fly")
        at.number("flights").fill("4")
        at.choose("vary", "all")
        at.press("Fly")
        at.wait_for(re.compile("4 of 4 flights completed|[0-3] of 4 flights completed:"))
        assert len(at.studio.flights.landed) == 4
        at.press("Open this flight")
        until(lambda: at.studio.player.flight is not None)
        at.studio.page.post(at.studio.page.apply, edits.move("start", (1.6, 0.0)))  # in front of the wall
        at.wait_for("flown before the room was changed")
        at.wait_for(re.compile("^no-go|^error"))
        at.press("Fly")
        at.wait_for(re.compile("start is|start.position_m|blocks"))
        assert len(at.studio.flights.landed) == 4
        at.press("Undo")
        at.page.get_by_text("flown before the room was changed").wait_for(state="hidden")
        at.number("flights").fill("1000")
        at.press("Fly")
        at.wait_for(re.compile("of 1000 flights"))
        at.press("Cancel")
        at.wait_for("cancelled")


def test_a_scenario_is_planned_and_its_mission_saved(browser: Any, room: Path) -> None:
    with shown(browser, OpenFile.load(room / "missions/scenarios/one_wall.yaml"), room / "flights") as at:
        at.tab("Plan")
        at.press("Plan")
        at.press("Make the mission")
        at.wait_for(re.compile("one_wall_plan.yaml"))
        at.wait_for(re.compile("^go$"))
        at.press("Save")
        at.wait_for(re.compile("^saved"))
        assert (room / "missions/scenarios/one_wall_plan.yaml").exists()
        at.press("Back to the scenario")
        at.wait_for(re.compile("^scenario"))


def test_a_page_for_other_computers_cannot_edit_plan_or_fly(browser: Any, room: Path) -> None:
    path = room / "missions/dual_collision.yaml"
    with shown(browser, OpenFile.load(path), room / "flights", read_only=True) as at:
        at.wait_for(re.compile("^go$"))
        for name in ("Save", "Undo", "Add"):
            assert at.button(name).count() == 0
        assert at.page.get_by_role("tab", name="Plan").count() == 0
        at.tab("Fly")
        assert at.button("Fly").count() == 0
