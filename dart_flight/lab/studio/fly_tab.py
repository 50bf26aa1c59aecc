"""The upper part of the tab *Fly*: flights in simulated time, and the list of many flights."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dart_flight.base.summary import cause_of
from dart_flight.config.document import InputError
from dart_flight.lab.studio.canvas import BLUE, GREEN, RED, Node, segments
from dart_flight.lab.studio.engine import AllFlown, EngineEvent, Failed, FlownOne, FlyRequest, Progress
from dart_flight.lab.studio.open_file import StudioKind
from dart_flight.lab.studio.playback import flown_from, outcome_line
from dart_flight.lab.studio.studio_page import NO_GO, QUIET, StudioPage, block, distinct, line

_COLOURS = {"completed": GREEN, "aborted": RED, "released": BLUE}
_NOTHING, _ALL, _TYPED = "nothing", "all", "as typed"
# An octahedron: enough for a marker.
_BALL = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], dtype=np.float32)
_FACES = np.array(
    [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)], dtype=np.uint32
)


class FlyTab:
    """The controls, in the present container of the page.

    Attributes:
        landed: the flights so far; after the last, the failed ones first. A refused request keeps them.
        play, clear: play the flight of a log, and remove it; the studio sets them.
    """

    def __init__(self, page: StudioPage) -> None:
        self._page = page
        self.play: Callable[[Path], None] = lambda log: None
        self.clear: Callable[[], None] = lambda: None
        self._number = self._again = 0  # of the request, and of that for one flight again, with a log
        self._flown: tuple[str, Path, FlyRequest] | None = None  # text, file and request of the flights
        self._asked: tuple[str, Path, FlyRequest] | None = None  # the same of flights that have not begun
        self._is_old = False  # whether the room has changed since
        self._first = ""  # log of the first recorded flight
        self.landed: list[FlownOne] = []
        gui = page.gui
        if page.editable:
            self._seed = gui.add_number("seed", 1, min=0, max=2**31 - 1001, step=1)
            self._flights = gui.add_number(
                "flights", 1, min=1, max=1000, step=1, hint="with consecutive seeds"
            )
            hint = "what differs at random from the mission in each flight, as dry-run --vary"
            self._vary = gui.add_dropdown("vary", (_NOTHING, _ALL, _TYPED), hint=hint)
            self._typed = gui.add_text("typed", "", hint="such as: mass contact=0.3", visible=False)
            self._fault = gui.add_text(
                "fault", "", hint="NAME[=VALUE][@PHASE] as --fault; for a single flight"
            )
            self._fly = page.button("Fly", self._start)
            self._cancel = page.button("Cancel", self._stop, color="gray", visible=False)
            page.when_changed(self._vary, lambda value: setattr(self._typed, "visible", value == _TYPED))
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._html = gui.add_html("", visible=False)
        self._choice = gui.add_dropdown("flight", ("-",), visible=False)
        self._open = page.button("Open this flight", self._open_chosen, color="gray", visible=False)

    # --- flying ---------------------------------------------------------------------------------------------

    def _start(self) -> None:
        page = self._page
        page.settle()
        file, engine = page.open_file(), page.engine
        assert engine is not None
        if file.kind is not StudioKind.MISSION:
            raise InputError("a scenario cannot be flown: plan it, make the mission, and fly the mission")
        typed = tuple(str(self._typed.value).replace(",", " ").split())
        vary = {_NOTHING: (), _ALL: ("all",)}.get(self._vary.value, typed)
        flights, fault = int(self._flights.value), str(self._fault.value).strip() or None
        # A flight without a log is flown again when it is opened.
        request = FlyRequest(int(self._seed.value), flights, vary, fault, log=flights == 1)
        self._asked = (file.text, file.path, request)
        self._number = engine.fly(file.text, file.path, request)
        self._show_running(True, Progress(0, flights))

    def _stop(self) -> None:
        if self._page.engine is not None:
            self._page.engine.cancel()

    def handle(self, event: EngineEvent) -> None:
        """Show an event of the engine."""
        what = event.what
        if event.number == self._again:
            if isinstance(what, Progress):
                for flight in what.landed:
                    self.open_flight(flight)
            elif isinstance(what, Failed):
                self._page.note(what.message, bad=not what.cancelled)
        elif event.number == self._number and isinstance(what, Progress):
            if self._asked is not None:
                self._begin()
            self._add(what)
        elif event.number == self._number and isinstance(what, Failed | AllFlown):
            failed = what if isinstance(what, Failed) else None
            if failed is not None and self._asked is not None:  # refused before the first flight
                self._asked = None
                self._page.note(failed.message, bad=not failed.cancelled)
                self._show_result()
            else:
                self._end(failed)

    def _begin(self) -> None:
        """Replace the flights before."""
        self._flown, self._asked, self.landed = self._asked, None, []
        self.show_room(self._page.open_file().text)  # it may have changed since *Fly*
        self.clear()
        self._show_lines()
        self._choice.visible = self._open.visible = False

    def show_room(self, text: str) -> None:
        """Show whether the flights were flown in the room of this text; draw their lines only there."""
        is_old = self._flown is not None and self._flown[0] != text
        if is_old != self._is_old:
            self._is_old = is_old
            self._show_lines()
            if not self._bar.visible:
                self._show_result()

    def _add(self, what: Progress) -> None:
        self.landed += what.landed
        self._show_running(True, what)

    def _show_running(self, running: bool, what: Progress) -> None:
        if self._page.editable:
            self._fly.visible, self._cancel.visible = not running, running
        self._bar.visible, self._html.visible = running, True
        self._bar.value = 100.0 * what.done / max(1, what.of or 0)
        share = f", {self._completed()} completed" if what.done else ""
        self._html.content = block(line(f"{what.done} of {what.of} flights{share}", QUIET))

    def _completed(self) -> int:
        return sum(flight.outcome == "completed" for flight in self.landed)

    def _end(self, failed: Failed | None = None) -> None:
        """Show the result, and the list with the failed flights first."""
        self.landed.sort(key=lambda flight: (flight.outcome == "completed", flight.seed))
        landed = self.landed
        if landed:
            self._choice.options = distinct(map(_label, landed))
            playing = [i for i, flight in enumerate(landed) if flight.log == self._first]
            self._choice.value = self._choice.options[playing[0] if playing else 0]
        self._choice.visible = self._open.visible = len(landed) > 1
        self._show_result(failed)
        if len(landed) == 1 and self._page.editable:
            self.open_flight(landed[0])
        self._show_lines()

    def _show_result(self, failed: Failed | None = None) -> None:
        landed, completed = self.landed, self._completed()
        self._show_running(False, Progress(len(landed), None))
        lines = list[str]()
        if failed is not None:
            lines.append(line(failed.message, QUIET if failed.cancelled else NO_GO))
        if self._is_old and landed:
            lines.append(line("flown before the room was changed", QUIET))
        if len(landed) == 1:
            lines.append(line(_label(landed[0])))
        elif landed:
            share = f"{completed} of {len(landed)} flights completed: {100.0 * completed / len(landed):.0f} %"
            lines.append(line(share, strong=True))
            causes = Counter(cause_of(flight.reason) for flight in landed if flight.reason is not None)
            lines += [line(f"{count} × {cause}", NO_GO) for cause, count in causes.most_common()]
        self._html.content = block(*lines)

    # --- recorded flights -----------------------------------------------------------------------------------

    def read(self, logs: list[Path]) -> None:
        """Show recorded flights as a list; they are read one after the other, while the first one plays."""
        self._first = str(logs[0])
        for log in logs:
            self._page.in_background(partial(flown_from, log), partial(self._add_read, len(logs)))

    def _add_read(self, of: int, flight: FlownOne) -> None:
        self._add(Progress(len(self.landed) + 1, of, [flight]))
        if len(self.landed) == of:
            self._end()

    # --- one of many ----------------------------------------------------------------------------------------

    def _open_chosen(self) -> None:
        self.open_flight(self.landed[self._choice.options.index(self._choice.value)])

    def open_flight(self, flight: FlownOne) -> None:
        """Play a flight from its log; a flight without a log is flown again with one."""
        for label, landed in zip(self._choice.options, self.landed, strict=False):
            if landed is flight:
                self._choice.value = label
        if flight.log is not None:
            self.play(Path(flight.log))
        elif self._flown is not None and self._page.engine is not None:
            text, path, request = self._flown
            self._page.note(f"flying seed {flight.seed} again, with a log")
            again = FlyRequest(flight.seed, 1, request.vary, request.fault)
            self._again = self._page.engine.fly(text, path, again)

    def _show_lines(self) -> None:
        """Draw the flights as thin lines, in one object for each outcome, with a marker at each end."""
        nodes: list[Node] = []
        radius_m = 0.0 if self._page.scene is None else 0.008 * self._page.scene.size_m
        for outcome, colour in _COLOURS.items():
            flights = [f for f in self.landed if f.outcome == outcome and len(f.path) > 1]
            if flights and len(self.landed) > 1 and not self._is_old:
                lines = np.concatenate([np.stack([f.path[:-1], f.path[1:]], axis=1) for f in flights])
                nodes.append(segments(f"/flights/{outcome}", lines, colour, 1.0))
                props = {
                    "vertices": _BALL * np.float32(radius_m),
                    "faces": _FACES,
                    "batched_wxyzs": np.tile(
                        np.array([1.0, 0.0, 0.0, 0.0], dtype=np.float32), (len(flights), 1)
                    ),
                    "batched_positions": np.array([f.path[-1] for f in flights], dtype=np.float32),
                    "batched_colors": colour,
                    "cast_shadow": False,
                }
                name, attach = f"/flights/{outcome}_ends", self._attach_to(flights)
                nodes.append(Node("batched_meshes_simple", name, props, attach))
        self._page.canvas.draw("flights", nodes)

    def _attach_to(self, flights: list[FlownOne]) -> Callable[[Any], None]:
        def clicked(event: Any) -> None:
            if event.instance_index is not None and event.instance_index < len(flights):
                self._page.post(self.open_flight, flights[event.instance_index])

        return lambda made: made.on_click(clicked)


def _label(flight: FlownOne) -> str:
    return f"seed {flight.seed}, {outcome_line(flight.outcome, flight.reason)}"[:90]
