"""The studio: connects the open file, the engine and the page.

Everything runs on one thread, in the order in which it happens; pages and the engine only put tasks into its
queue. Reading a flight and writing a report take long and have a thread of their own.
"""

from __future__ import annotations

import contextlib
import queue
import sys
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import yaml

from dart_flight.base.errors import FlightError
from dart_flight.base.geometry import Vec2
from dart_flight.config.document import InputError
from dart_flight.lab.map_model import MapKind
from dart_flight.lab.report.page import flight_page
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.lab.studio import edits
from dart_flight.lab.studio.canvas import Canvas, path_style, polyline
from dart_flight.lab.studio.engine import (
    Checked,
    Engine,
    EngineDied,
    EngineEvent,
    FlightsFlown,
    FlownOne,
    FlyProgress,
    FlyRequest,
    Planned,
    PlanProgress,
    PlanRow,
)
from dart_flight.lab.studio.fields import fields_of, object_ids
from dart_flight.lab.studio.objects import entry_of
from dart_flight.lab.studio.open_file import DiskState, Edit, OpenFile, StudioKind
from dart_flight.lab.studio.page_server import open_server, stop_server
from dart_flight.lab.studio.panels import FlyPanel, HeadPanel, ObjectPanel, PlanPanel, Wiring
from dart_flight.lab.studio.playback import playback_of
from dart_flight.lab.studio.player_view import Player
from dart_flight.lab.studio.room_view import RoomView
from dart_flight.lab.studio.scene_model import Scene, build_scene, scene_of_mission
from dart_flight.lab.studio.watching import WatchedFlight, growing_log

_SETTLED_S = 0.25  # a typed number is complete after so long without a further key
_FRAME_S, _WATCH_S, _IDLE_S, _DISK_S = 0.04, 0.1, 0.25, 1.0
_PANEL_PX = 340.0
_PATH_CHARS = 48
_REPORTS = 5  # kept pages
_NEAR_M = 0.5  # a new object appears so far from the middle of the room


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
        self._tasks: queue.SimpleQueue[tuple[Callable[..., Any], tuple[Any, ...]]] = queue.SimpleQueue()
        self._waiting: dict[Any, tuple[float, Callable[..., Any], tuple[Any, ...]]] = {}
        self._background = ThreadPoolExecutor(1)
        self._stopped = threading.Event()
        self._pages: dict[str, str] = {}
        self._log_dir = log_dir
        self._file = opened if isinstance(opened, OpenFile) else None
        self._before: OpenFile | None = None  # the scenario of a mission that was planned here
        self._logs = [] if isinstance(opened, OpenFile) else opened
        self._engine: Engine | None = None
        if self._file is not None:
            self._engine = Engine(self._file.path, lambda event: self.post(self._handle, event), log_dir)
        self._checked: Checked | None = None
        self._number = 0  # of the last request to check
        self._selected = ""
        self._scene: Scene | None = None
        self._log: Path | None = None  # of the flight that is shown
        self._plans: dict[int, PlanRow] = {}
        self._flown: tuple[str, FlyRequest] | None = None
        self._flies_again = False  # one of many flights, to get its log
        self._disk: DiskState | None = None
        self._watched: WatchedFlight | None = None
        self._problem = ""
        self.server = open_server(*address, "DART studio", self._pages.get)
        self._wiring = Wiring(self.server, self.post, self._later, read_only)
        self._build(dark=dark)

    def _build(self, *, dark: bool) -> None:
        wiring, gui = self._wiring, self.server.gui
        read_only, flights = wiring.read_only, self._file is None
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_PANEL_PX)
        self.server.scene.configure_default_lights(True, cast_shadow=False)
        self._canvas = Canvas(self.server)
        editable = not read_only and not flights
        self._room = RoomView(
            self.server,
            self._canvas,
            (lambda *moved: self.post(self._dragged, *moved)) if editable else None,
            lambda object_id: self.post(self._select, object_id),
        )
        self._head = HeadPanel(
            wiring._replace(read_only=not editable),
            {
                "undo": self._undo,
                "redo": self._redo,
                "save": self._save,
                "reload": self._reload,
                "overwrite": lambda: self._save(overwrite=True),
            },
        )
        tabs = gui.add_tab_group()
        self._plan: PlanPanel | None = None
        self._fly: FlyPanel | None = None
        if not flights:
            with tabs.add_tab("Room"):
                self._objects = ObjectPanel(
                    wiring._replace(read_only=not editable), self._select, self._apply, self._act
                )
            if not read_only:
                with tabs.add_tab("Plan"):
                    self._plan = PlanPanel(
                        wiring,
                        self._search,
                        self._cancel,
                        self._show_plan,
                        self._make_mission,
                    )
                    self._back = wiring.button("Back to the scenario", self._go_back, visible=False)
        with tabs.add_tab("Flights" if flights else "Fly"):
            if not read_only or flights:
                self._fly = FlyPanel(
                    wiring, self._start_flights, self._cancel, self._open_flown, only_list=flights
                )
            self._player = Player(wiring, self._canvas, self._report, self._open_flown)
        with tabs.add_tab("View"):
            wiring.button("From above", self._room.look_from_above, color="gray")
            self._dark = gui.add_checkbox("dark", dark)
            wiring.when_changed(self._dark, self._use_dark)
            self._watch = wiring.button(
                "Watch a flight in progress",
                self._watch_or_stop,
                color="gray",
                hint="through its log, read-only; nothing here reaches a vehicle",
            )
        self._use_dark(dark, draw=False)

    # --- the thread -----------------------------------------------------------------------------------------

    def post(self, run: Callable[..., Any], *arguments: Any) -> None:
        """Run a function on the studio's thread; may be called from any thread."""
        self._tasks.put((run, arguments))

    def _later(self, key: Any, run: Callable[..., Any], *arguments: Any) -> None:
        self.post(self._wait, key, run, arguments)

    def _wait(self, key: Any, run: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        self._waiting[key] = (time.monotonic() + _SETTLED_S, run, arguments)

    def stop(self) -> None:
        """End `run`, from any thread or a signal."""
        self._stopped.set()

    def run(self) -> None:
        """Serve the page until `stop`."""
        self._perform(self._open, ())
        looked_s = watched_s = time.monotonic()
        try:
            while not self._stopped.is_set():
                moves = self._player.is_playing or self._watched is not None
                wait = _FRAME_S if moves or self._waiting else _IDLE_S
                with contextlib.suppress(queue.Empty):
                    self._perform(*self._tasks.get(timeout=wait))
                now = time.monotonic()
                self._run_waiting(now)
                if self._player.is_playing:
                    self._perform(self._player.tick, ())
                if self._watched is not None and now - watched_s > _WATCH_S:
                    watched_s = now
                    self._perform(self._show_watched, (self._watched,))
                if now - looked_s > _DISK_S:
                    looked_s = now
                    self._perform(self._look_at_disk, ())
        finally:
            self.close()

    def close(self) -> None:
        if self._engine is not None:
            self._engine.close()
        self._background.shutdown(wait=False, cancel_futures=True)
        stop_server(self.server)

    def _run_waiting(self, before_s: float) -> None:
        for key in [key for key, (due, _, _) in self._waiting.items() if due <= before_s]:
            _, run, arguments = self._waiting.pop(key)
            self._perform(run, arguments)

    def _perform(self, run: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        """Run a task; whatever fails is one line in the page, and the page stays."""
        try:
            run(*arguments)
        except InputError as error:
            self._head.note(error.one_line(), bad=True)
        except FlightError as error:
            self._head.note(str(error), bad=True)
        except Exception as error:  # the page must outlive a fault of the studio
            traceback.print_exc(file=sys.stderr)
            self._head.note(f"fault of the studio: {type(error).__name__}: {error}", bad=True)

    def _in_background(self, work: Callable[[], Any], then: Callable[[Any], None]) -> None:
        def run() -> None:
            try:
                result = work()
            except Exception as error:  # raised again on the studio's thread
                self.post(_raise, error)
            else:
                self.post(then, result)

        self._background.submit(run)

    # --- the file -------------------------------------------------------------------------------------------

    def _open(self) -> None:
        if self._file is None:
            self._open_logs()
            return
        self._selected = next(iter(object_ids(self._file.tree)), "")
        if self._engine is not None:
            self._engine.path = self._file.path
        self._refresh()

    def _refresh(self) -> None:
        """Draw the present text, and have it checked."""
        file = self._file
        assert file is not None
        if self._engine is not None:
            self._number = self._engine.check(file.text)
        try:
            scene = build_scene(file.text, file.path)
        except InputError as error:
            self._problem = error.one_line()
        else:
            self._problem = scene.problem or ""
            last = None if self._checked is None else self._checked.scene
            if last is not None and last.predicted and not scene.problem:
                # Until the check is done, the page keeps the prediction.
                scene.paths, scene.hits, scene.predicted = last.paths, last.hits, True
            self._scene = scene
        self._draw()
        self._show_object()
        self._show_head()

    def _draw(self) -> None:
        if self._scene is None or self._room.is_dragging:
            return
        findings = [] if self._checked is None else self._checked.findings
        problems = dict[str, str]()
        for finding in findings:
            if not finding.go and finding.object:
                problems.setdefault(finding.object, self._short(finding.message))
        self._room.show(self._scene, problems, self._selected)

    def _show_object(self) -> None:
        file = self._file
        if file is None:
            return
        tree = file.tree
        ids = object_ids(tree)
        if entry_of(tree, self._selected or "start") is None:
            self._selected = next(iter(ids), "")
        checked = self._checked or Checked()
        fields = fields_of(tree, self._selected, checked.materials, checked.modes)
        places = ("visit",) if file.kind is StudioKind.SCENARIO else ("waypoint",)
        self._objects.show(ids, self._selected, fields, ("wall", "post", *places, "hit"))

    def _show_head(self) -> None:
        file, checked = self._file, self._checked
        if file is None:
            return
        unsaved = file.is_changed or self._disk is DiskState.MISSING
        path = str(file.path)
        path = path if len(path) < _PATH_CHARS else str(Path("…", *file.path.parts[-2:]))
        state = [file.kind.value, path, "not saved" if unsaved else "saved"]
        steps = [f"undo: {file.can_undo}"] if file.can_undo else []
        steps += [f"redo: {file.can_redo}"] if file.can_redo else []
        verdict, go = "checking", None
        if self._problem:
            verdict, go = f"error: {self._short(self._problem)}", False
        elif checked is not None and checked.number == self._number:
            bad = [f for f in checked.findings if not f.go]
            go = checked.go
            verdict = "go" if go else f"no-go: {self._short(bad[0].message)}" if bad else "no-go"
        name = file.path.name if self._scene is None else self._scene.name
        self._head.show(name, " · ".join([*state, *steps]), verdict, go)
        self._head.show_steps(unsaved=unsaved, asks=self._disk is DiskState.BOTH_CHANGED)

    def _short(self, message: str) -> str:
        """Return a line of a command without the path of the open file."""
        path = "" if self._file is None else str(self._file.path)
        return message.replace(f"{path}: ", "").replace(f"{path}:", "line ") if path else message

    def _apply(self, edit: Edit) -> None:
        assert self._file is not None
        try:
            self._file.edit(edit)
        except InputError:
            self._draw()  # what was dragged goes back
            self._show_object()
            raise
        self._head.note("")
        self._refresh()

    def _dragged(self, object_id: str, position: Vec2, yaw_rad: float | None) -> None:
        self._selected = object_id
        self._apply(edits.drag(object_id, position, yaw_rad))

    def _select(self, object_id: str) -> None:
        if object_id:
            self._selected = "corner/0" if object_id.startswith("corner/") else object_id
            self._draw()
            self._show_object()

    def _act(self, what: str) -> None:
        """Copy or delete the selected object, or add one."""
        file, kind = self._file, what.removeprefix("add ")
        assert file is not None
        before = set(object_ids(file.tree))
        if what == "copy":
            self._apply(edits.copy_object(self._selected))
        elif what == "delete":
            self._apply(edits.delete(self._selected))
        else:
            self._apply(self._addition(kind))
        new = [one for one in object_ids(file.tree) if one not in before]
        self._select(new[0] if new else self._selected)

    def _addition(self, kind: str) -> Edit:
        assert self._file is not None
        if self._scene is None:
            raise InputError("nothing can be added before the file loads")
        (x0, y0, _), (x1, y1, _) = self._scene.bounds
        middle = (round(0.5 * (x0 + x1), 2), round(0.5 * (y0 + y1), 2))
        materials = [] if self._checked is None else self._checked.materials
        material = materials[0] if materials else "wood"
        if kind == "wall":
            return edits.add_wall((middle[0], y1), -90.0, round(0.5 * (x1 - x0), 1), material)
        if kind == "post":
            return edits.add_post((middle[0] + _NEAR_M, middle[1]), 0.1, material)
        if kind == "waypoint":
            return edits.add_waypoint((middle[0] - _NEAR_M, middle[1]))
        if kind == "visit":
            return edits.add_visit((middle[0] - _NEAR_M, middle[1]))
        walls = self._file.tree.get("walls") or {}
        chosen = self._selected.partition("/")[2] if self._selected.startswith("wall/") else ""
        wall = chosen or next(iter(walls), "")
        if not wall:
            raise InputError("add a wall first, then a hit on it")
        return edits.add_hit(wall)

    def _undo(self) -> None:
        self._step(OpenFile.undo, "undone")

    def _redo(self) -> None:
        self._step(OpenFile.redo, "repeated")

    def _step(self, step: Callable[[OpenFile], str | None], word: str) -> None:
        assert self._file is not None
        self._run_waiting(float("inf"))
        what = step(self._file)
        self._head.note("" if what is None else f"{word}: {what}")
        if what is not None:
            self._refresh()

    def _save(self, *, overwrite: bool = False) -> None:
        assert self._file is not None
        self._run_waiting(float("inf"))
        self._file.save(overwrite=overwrite)
        self._disk = DiskState.SAME
        self._head.note(f"saved {self._file.path}")
        self._show_head()

    def _reload(self) -> None:
        assert self._file is not None
        self._file.reload()
        self._disk = DiskState.SAME
        self._head.note("reloaded from the disk; Undo restores the text before")
        self._refresh()

    def _look_at_disk(self) -> None:
        """Follow a file that another program changes; if both have changed, ask."""
        file = self._file
        if file is None:
            return
        state = file.disk_state()
        if state is self._disk:
            return
        self._disk = state
        if state is DiskState.CHANGED:
            self._reload()
        elif state is not DiskState.SAME:
            self._head.note(state.value, bad=True)
        self._show_head()

    # --- the engine -----------------------------------------------------------------------------------------

    def _handle(self, event: EngineEvent) -> None:
        if isinstance(event, Checked):
            self._show_checked(event)
        elif isinstance(event, EngineDied):
            self._head.note(event.message, bad=True)
            if self._plan is not None:
                self._plan.done(Planned(error=event.message))
            if self._fly is not None:
                self._fly.done(FlightsFlown(error=event.message))
            self._refresh()
        elif self._plan is not None and isinstance(event, PlanProgress):
            self._plan.running(event.done / event.of if event.of else None, event.message)
        elif self._plan is not None and isinstance(event, Planned):
            self._plans = {row.rank: row for row in [*event.plans, *([event.free] if event.free else [])]}
            self._plan.done(event)
            if event.plans:
                self._show_plan(event.plans[0].rank)
        elif self._flies_again and isinstance(event, FlyProgress):
            for flight in event.landed:
                self._open_flown(flight)
        elif self._flies_again and isinstance(event, FlightsFlown):
            self._flies_again = False
            self._head.note(event.error or "", bad=True)
        elif self._fly is not None and isinstance(event, FlyProgress):
            self._fly.progress(event)
        elif self._fly is not None and isinstance(event, FlightsFlown):
            self._show_flown(self._fly, event)

    def _show_checked(self, event: Checked) -> None:
        if event.number != self._number:
            return  # the text has changed since
        known = self._checked
        self._checked = event
        if event.scene is not None:
            self._scene = event.scene
            self._problem = event.scene.problem or ""
        self._draw()
        shown = [msgspec.structs.replace(f, message=self._short(f.message)) for f in event.findings]
        self._objects.findings.show(shown, event.stale)
        if known is None or (known.materials, known.modes) != (event.materials, event.modes):
            self._show_object()
        self._show_head()
        self._explain_plan(event.stale)

    def _explain_plan(self, stale: str | None) -> None:
        if self._plan is None or self._file is None:
            return
        if self._file.kind is StudioKind.SCENARIO:
            self._plan.explain("Plan searches walls, velocities and modes for this scenario.")
        elif stale is not None:
            self._plan.explain(f"The plan of this mission is stale: {stale}. Plan makes a new one.")
        else:
            self._plan.explain("Plan searches this mission again: the same walls in the same order.")
        self._back.visible = self._before is not None

    def _search(self, objective: str | None, within_s: float) -> None:
        file, engine = self._file, self._engine
        assert file is not None
        assert engine is not None
        assert self._plan is not None
        text = file.text
        if file.kind is StudioKind.MISSION:
            tree = edits.scenario_of(file.tree, file.path.stem)
            text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=None)
        self._plan.running(None, "planning")
        engine.plan(text, objective, within_s)

    def _show_plan(self, rank: int) -> None:
        row = self._plans.get(rank)
        style = path_style(MapKind.REPLANNED, self._room.palette)
        lines = [] if row is None else [line for line in row.paths if len(line) > 1]
        self._canvas.draw("plan", [polyline(f"/plan/{i}", line, *style) for i, line in enumerate(lines)])

    def _make_mission(self, rank: int) -> None:
        file, row = self._file, self._plans.get(rank)
        assert file is not None
        if row is None or not row.mission:
            raise InputError("this plan is no mission")
        self._canvas.draw("plan", [])
        if file.kind is StudioKind.MISSION:
            self._apply(edits.use_plan(row.mission, rank))
            return
        self._before = file
        self._file = OpenFile.new(_free_name(file.path), row.mission)
        self._disk = self._checked = None
        self._open()
        self._head.note(f"the mission of plan {rank}; Save writes {self._file.path.name}")

    def _go_back(self) -> None:
        if self._before is not None:
            self._file, self._before = self._before, None
            self._disk = self._checked = None
            self._head.note("")
            self._open()

    def _cancel(self) -> None:
        if self._engine is not None:
            self._engine.cancel()

    # --- flights --------------------------------------------------------------------------------------------

    def _start_flights(self, request: FlyRequest) -> None:
        file, engine = self._file, self._engine
        assert file is not None
        assert engine is not None
        assert self._fly is not None
        if file.kind is not StudioKind.MISSION:
            raise InputError("a scenario cannot be flown: plan it, and make the mission")
        self._run_waiting(float("inf"))
        self._player.close()
        self._player.show_many([])
        self._flown = (file.text, request)
        self._fly.begin(request.flights)
        engine.fly(file.text, request)

    def _show_flown(self, panel: FlyPanel, event: FlightsFlown) -> None:
        panel.done(event)
        if len(panel.landed) == 1:
            self._open_flown(panel.landed[0])
        else:
            self._player.show_many(panel.landed)

    def _open_flown(self, flight: FlownOne) -> None:
        """Play a flight from its log; a flight without a log is flown again with one."""
        if self._fly is not None:
            self._fly.select(flight)
        if flight.log is not None:
            self._play(Path(flight.log))
        elif self._flown is not None and self._engine is not None:
            text, request = self._flown
            self._head.note(f"flying seed {flight.seed} again, with a log")
            self._flies_again = True
            self._engine.fly(text, FlyRequest(flight.seed, 1, request.vary, request.fault))

    def _play(self, log: Path) -> None:
        def read() -> Any:
            flight = RecordedFlight.read(log)
            return playback_of(flight), scene_of_mission(flight.mission, flight.planned)

        def play(found: Any) -> None:
            playback, scene = found
            if playback is None:
                raise InputError("the log contains no motion in the air", source=str(log))
            self._log = log
            if self._file is None:
                self._scene = scene
                self._draw()
            (x0, y0, _), (x1, y1, _) = scene.bounds
            size_m = max(x1 - x0, y1 - y0)
            self._player.open(playback, scene.vehicle, size_m, self._room.palette)

        self._in_background(read, play)

    def _open_logs(self) -> None:
        """Read the flights one after the other; the first is shown at once."""
        assert self._fly is not None
        self._head.show(f"{len(self._logs)} flights" if len(self._logs) > 1 else "flight", "", "", None)
        self._play(self._logs[0])
        if len(self._logs) == 1:
            return
        for log in self._logs:
            self._in_background(lambda log=log: _flown_from(log), self._add_flight)  # type: ignore[misc]

    def _add_flight(self, flight: FlownOne) -> None:
        assert self._fly is not None
        landed = [*self._fly.landed, flight]
        done, completed = len(landed), sum(f.outcome == "completed" for f in landed)
        self._fly.progress(FlyProgress(done=done, of=len(self._logs), completed=completed, landed=[flight]))
        if done == len(self._logs):
            reasons = dict[str, int]()
            for one in landed:
                if one.reason is not None:
                    reasons[one.reason] = reasons.get(one.reason, 0) + 1
            self._fly.done(
                FlightsFlown(done=done, completed=completed, reasons=reasons, summary=f"{done} flights")
            )
            self._player.show_many(landed)

    def _watch_or_stop(self) -> None:
        if self._watched is not None:
            self._stop_watching("stopped watching")
            return
        watched = WatchedFlight(growing_log(self._log_dir))
        scene = scene_of_mission(watched.mission)
        if self._file is None:
            self._scene = scene
            self._draw()
        (x0, y0, _), (x1, y1, _) = scene.bounds
        self._player.watch(scene.vehicle, max(x1 - x0, y1 - y0), self._room.palette)
        self._watched = watched
        self._watch.label = "Stop watching"

    def _show_watched(self, watched: WatchedFlight) -> None:
        try:
            state = watched.update()
        except InputError:
            self._stop_watching("")
            raise
        self._player.show_live(f"{watched.mission.name}, in progress", state)
        if watched.ended is not None:
            self._stop_watching(f"the flight has ended: {watched.ended}")
            self._play(watched.log)

    def _stop_watching(self, message: str) -> None:
        self._watched = None
        self._watch.label = "Watch a flight in progress"
        self._head.note(message)
        self._player.close()

    def _report(self) -> None:
        log = self._log
        if log is None:
            return
        self._head.note("writing the report")

        def show(page: str) -> None:
            path = f"/report/{log.parent.name}"
            self._pages[path] = page
            for old in list(self._pages)[:-_REPORTS]:
                del self._pages[old]
            self._head.note("")
            self._player.show_report(path)

        self._in_background(lambda: flight_page(RecordedFlight.read(log)), show)

    # --- view -----------------------------------------------------------------------------------------------

    def _use_dark(self, dark: bool, *, draw: bool = True) -> None:
        self.server.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)
        self._room.use_dark(dark)
        self._player.use_palette(self._room.palette)
        if draw:
            self._draw()


def _raise(error: Exception) -> None:
    raise error


def _free_name(scenario: Path) -> Path:
    """Return the name of the mission of a scenario, beside it, that no file has."""
    names = (scenario.with_name(f"{scenario.stem}_plan{n}.yaml") for n in ("", *range(2, 1000)))
    return next(path for path in names if not path.exists())


def _flown_from(log: Path) -> FlownOne:
    """Return the line and the end of a recorded flight."""
    flight = RecordedFlight.read(log)
    motion = flight.course.true if flight.course.true.time_s.size else flight.course.estimated
    verdict = flight.verdict
    path = motion.position[:: max(1, len(motion.position) // 300)]
    return FlownOne(
        flight.log.seed or 0,
        verdict.outcome.value,
        verdict.reason,
        path,
        [impact.verdict.onset.position_mission for impact in flight.impacts],
        str(log),
    )
