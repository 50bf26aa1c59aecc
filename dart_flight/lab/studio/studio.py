"""The studio: connects the open file, the engine, the room and the tabs of the page."""

from __future__ import annotations

import threading
import time
from pathlib import Path

from dart_flight.config.document import InputError
from dart_flight.lab.studio import edits
from dart_flight.lab.studio.canvas import DARK, LIGHT
from dart_flight.lab.studio.engine import Checked, EngineEvent, Failed, Finding
from dart_flight.lab.studio.fly_tab import FlyTab
from dart_flight.lab.studio.open_file import DiskState, OpenFile
from dart_flight.lab.studio.page_server import open_server, stop_server
from dart_flight.lab.studio.plan_tab import PlanTab
from dart_flight.lab.studio.player_view import Player
from dart_flight.lab.studio.room_tab import RoomTab
from dart_flight.lab.studio.room_view import RoomView
from dart_flight.lab.studio.scene_model import build_scene
from dart_flight.lab.studio.studio_page import GO, NO_GO, QUIET, StudioPage, line

_FRAME_S, _IDLE_S, _DISK_S = 0.04, 0.25, 1.0
_PANEL_PX = 340.0
_PATH_CHARS = 48


class Studio:
    """A page and what is open in it.

    Args:
        opened: the mission or scenario to edit, or the logs of flights to play.
        log_dir: folder for the logs of flown missions.
        address: host and port; port 0 takes a free one.
    """

    def __init__(
        self,
        opened: OpenFile | list[Path],
        log_dir: Path,
        address: tuple[str, int],
        *,
        read_only: bool = False,
        dark: bool = False,
    ) -> None:
        self._stopped = threading.Event()
        reports: dict[str, str] = {}
        self.server = open_server(*address, "DART studio", reports.get)
        self.server.gui.main_panel.dock_right()
        self.server.gui.main_panel.set_width(_PANEL_PX)
        self._logs = [] if isinstance(opened, OpenFile) else opened
        file = opened if isinstance(opened, OpenFile) else None
        self.page = StudioPage(self.server, file, log_dir, read_only=read_only)
        self.page.on_event, self.page.draw, self.page.refresh = self._handle, self._show, self._refresh
        self.checked: Checked | None = None
        self._shown_file: OpenFile | None = None
        self._number = 0  # of the last request to check
        self._checks_again = True
        self._problem = ""
        self._disk: DiskState | None = None
        self._build(reports, dark=dark)

    def _build(self, reports: dict[str, str], *, dark: bool) -> None:
        page, gui = self.page, self.server.gui
        self._room = RoomView(
            self.server,
            page.canvas,
            (lambda *moved: page.post(self._dragged, *moved)) if page.editable else None,
            lambda object_id: page.post(self._clicked, object_id),
        )
        # The labels fit the size of the page.
        self.server.on_client_connect(lambda client: page.post(self._draw))
        if page.editable:
            page.button_group("", {"Undo": self._undo, "Redo": self._redo})
            self._saves = page.button("Save", self._save, disabled=True)
            self._reloads = page.button("Reload from the disk", self._reload, color="orange", visible=False)
            self._overwrites = page.button(
                "Overwrite the file", self._overwrite, color="orange", visible=False
            )
            for label, key, run in (
                ("Undo", "z", self._undo),
                ("Redo", "y", self._redo),
                ("Save", "s", self._save),
            ):
                command = gui.add_command(label, hotkey=key, modifier="cmd/ctrl")
                command.on_trigger(lambda event, run=run: page.post(run))
        tabs = gui.add_tab_group()
        self.tab: RoomTab | None = None
        self._plan: PlanTab | None = None
        if page.file is not None:
            with tabs.add_tab("Room"):
                self.tab = RoomTab(page)
        if page.editable:
            with tabs.add_tab("Plan"):
                self._plan = PlanTab(page)
        with tabs.add_tab("Fly" if page.file is not None else "Flights"):
            self.flights = FlyTab(page)
            self.player = Player(page, reports)
            self.flights.play, self.flights.clear = self.player.play, self.player.close
        with tabs.add_tab("View"):
            page.button("From above", self._room.look_from_above, color="gray")
            self._dark = gui.add_checkbox("dark", dark)
            page.when_changed(self._dark, self.use_dark)
            hint = "through its log, read-only; nothing here reaches a vehicle"
            self._watch = page.button(
                self.player.watch_label, self.player.watch_or_stop, color="gray", hint=hint
            )
        self.use_dark(dark)

    def stop(self) -> None:
        """End `run`, from any thread or a signal."""
        self._stopped.set()

    def run(self) -> None:
        """Serve the page until `stop`."""
        page, looked_s = self.page, time.monotonic()
        page.perform(self._refresh if page.file is not None else self._open_logs)
        try:
            while not self._stopped.is_set():
                page.run_tasks(_FRAME_S if self.player.is_moving else _IDLE_S)
                if self.player.is_moving:
                    page.perform(self.player.tick)
                if self._watch.label != self.player.watch_label:  # a watched flight has begun or ended
                    self._watch.label = self.player.watch_label
                if time.monotonic() - looked_s > _DISK_S:
                    looked_s = time.monotonic()
                    page.perform(self._look_at_disk)
        finally:
            self.close()

    def close(self) -> None:
        self.page.close()
        stop_server(self.server)

    # --- the room -------------------------------------------------------------------------------------------

    def _open_logs(self) -> None:
        """Play the first flight at once, and list several."""
        several = len(self._logs) > 1
        self.page.show_title(line(f"{len(self._logs)} flights" if several else "flight", strong=True))
        self.player.play(self._logs[0])
        if several:
            self.flights.read(self._logs)

    def _refresh(self) -> None:
        """Draw the present text, and have it checked."""
        page, file = self.page, self.page.open_file()
        assert page.engine is not None
        if file is not self._shown_file:
            self._shown_file, self._disk, self.checked = file, None, None
        self._number = page.engine.check(file.text, file.path)
        self.flights.show_room(file.text)
        try:
            scene = build_scene(file.text, file.path)
        except InputError as error:
            self._problem = error.one_line()
        else:
            self._problem = scene.problem or ""
            last = None if self.checked is None else self.checked.scene
            if last is not None and last.predicted and not scene.problem:
                # Until the check is done, the page keeps the prediction.
                scene.paths, scene.hits, scene.predicted = last.paths, last.hits, True
            page.scene = scene
        self._show()
        self._show_head()

    def _show(self) -> None:
        """Draw the room, and show the selected object."""
        if self.tab is not None and self.page.scene is not None:
            self.tab.show(self.page.scene.bounds)
        self._draw()

    def _draw(self) -> None:
        scene = self.page.scene
        if scene is None or self._room.is_dragging:
            return
        problems = dict[str, str]()
        for finding in () if self.checked is None else self.checked.findings:
            if not finding.go and finding.objects:
                problems.setdefault(finding.objects[0], self.page.short(finding.message))
        self._room.show(scene, self.page.palette, problems, "" if self.tab is None else self.tab.selected)

    def _dragged(self, object_id: str, *moved: object) -> None:
        assert self.tab is not None
        self.tab.selected = object_id
        self.page.apply(edits.drag(object_id, *moved))  # type: ignore[arg-type]

    def _clicked(self, object_id: str) -> None:
        if self.tab is not None:
            self.tab.select(object_id)

    def _show_head(self) -> None:
        file, checked, page = self.page.open_file(), self.checked, self.page
        unsaved = file.is_changed or self._disk is DiskState.MISSING
        path = str(file.path)
        path = path if len(path) < _PATH_CHARS else str(Path("…", *file.path.parts[-2:]))
        state = [file.kind.value, path, "not saved" if unsaved else "saved"]
        state += [f"undo: {file.can_undo}"] if file.can_undo else []
        state += [f"redo: {file.can_redo}"] if file.can_redo else []
        verdict, colour = "checking", QUIET
        if self._problem:
            verdict, colour = f"error: {page.short(self._problem)}", NO_GO
        elif checked is not None and self._number == 0:
            bad = next((f": {page.short(f.message)}" for f in checked.findings if not f.go), "")
            verdict, colour = ("go", GO) if checked.go else (f"no-go{bad}", NO_GO)
        name = file.path.name if page.scene is None else page.scene.name
        page.show_title(
            line(name, strong=True), line(" · ".join(state), QUIET), line(verdict, colour, strong=True)
        )
        if page.editable:
            self._saves.disabled = not unsaved
            self._reloads.visible = self._overwrites.visible = self._disk is DiskState.BOTH_CHANGED

    # --- the file -------------------------------------------------------------------------------------------

    def _undo(self) -> None:
        self.page.settle()
        self._step(self.page.open_file().undo(), "undone")

    def _redo(self) -> None:
        self.page.settle()
        self._step(self.page.open_file().redo(), "repeated")

    def _step(self, what: str | None, word: str) -> None:
        self.page.note("" if what is None else f"{word}: {what}")
        if what is not None:
            self._refresh()

    def _save(self, *, overwrite: bool = False) -> None:
        self.page.settle()
        file = self.page.open_file()
        file.save(overwrite=overwrite)
        self._disk = DiskState.SAME
        self.page.note(f"saved {file.path}")
        self._show_head()

    def _overwrite(self) -> None:
        self._save(overwrite=True)

    def _reload(self) -> None:
        self.page.open_file().reload()
        self._disk = DiskState.SAME
        self.page.note("reloaded from the disk; Undo restores the text before")
        self._refresh()

    def _look_at_disk(self) -> None:
        """Follow a file that another program changes; if both have changed, ask."""
        file = self.page.file
        if file is None or (state := file.disk_state()) is self._disk:
            return
        self._disk = state
        if state is DiskState.CHANGED:
            self._reload()
        elif state is not DiskState.SAME and file.saved:
            self.page.note(state.value, bad=True)
        self._show_head()

    # --- the engine -----------------------------------------------------------------------------------------

    def _handle(self, event: EngineEvent) -> None:
        what = event.what
        if event.number == self._number and self._number:
            self._show_checked(what)
        elif isinstance(what, Failed) and not event.number:
            self.page.note(what.message, bad=True)
        elif self._plan is None or not self._plan.handle(event):
            self.flights.handle(event)

    def _show_checked(self, what: object) -> None:
        if isinstance(what, Failed):
            self.page.note(what.message, bad=True)
            if self._checks_again:  # once, because the text may be what ends the process
                self._checks_again = False
                self._refresh()
                return
            what = Checked(findings=[Finding("check", False, False, what.message, [])])
        assert isinstance(what, Checked)
        self.checked, self._number, self._checks_again = what, 0, True
        if what.scene is not None:
            self.page.scene = what.scene
            self._problem = what.scene.problem or ""
        if self.tab is not None:
            self.tab.show_findings(what)
        self._draw()
        self._show_head()
        if self._plan is not None:
            self._plan.explain(what.stale)

    # --- view -----------------------------------------------------------------------------------------------

    def use_dark(self, dark: bool) -> None:
        self.server.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)
        self.page.palette = DARK if dark else LIGHT
        self._draw()
        self.player.redraw()
