"""What the parts of a studio page share: server, drawing, open file, engine, message line, and one thread."""

from __future__ import annotations

import contextlib
import html
import queue
import sys
import time
import traceback
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import viser

from dart_flight.base.errors import FlightError
from dart_flight.config.document import InputError
from dart_flight.lab.studio.canvas import LIGHT, Canvas, Palette
from dart_flight.lab.studio.engine import Engine, EngineEvent
from dart_flight.lab.studio.open_file import Edit, OpenFile
from dart_flight.lab.studio.scene_model import Scene

GO, NO_GO, QUIET = "#22964a", "#d9372c", "#888888"  # legible on light and dark
_STYLE = "padding:0 0.8em;font-size:0.85em;line-height:1.45;overflow-wrap:anywhere"
# viser's panel is 20 em wide in a narrow window, whatever the width of the window.
_NARROW = (
    "<style>@media (max-width:36em){.mantine-ScrollArea-root[style*='position: fixed'],"
    ".mantine-ScrollArea-root[style*='position: fixed'] [style*='width: 20em']{width:100%!important}}</style>"
)
_SETTLED_S = 0.6  # a typed number is complete after so long without a further key


class StudioPage:
    """A page; everything of it runs on the thread that calls `run_tasks`, one task after the other.

    Attributes:
        file: the mission or scenario to edit, or None.
        engine: it checks, plans and flies the file's text; None without a file.
        read_only: whether everything that writes or computes is left out.
        scene, palette: the room that is drawn, and its colours.
        draw: draws what has been selected; the studio sets it.
        refresh: draws a changed text, and has it checked; the studio sets it.
    """

    def __init__(
        self, server: viser.ViserServer, file: OpenFile | None, log_dir: Path, *, read_only: bool
    ) -> None:
        self._tasks: queue.SimpleQueue[tuple[Callable[..., Any], tuple[Any, ...]]] = queue.SimpleQueue()
        self._waiting: dict[Any, tuple[float, Callable[..., Any], tuple[Any, ...]]] = {}
        self._background = ThreadPoolExecutor(1)
        self.server, self.gui, self.canvas = server, server.gui, Canvas(server)
        self.file, self.log_dir, self.read_only = file, log_dir, read_only
        self.on_event: Callable[[EngineEvent], None] = lambda event: None
        self.engine = None if file is None else Engine(lambda event: self.post(self.on_event, event), log_dir)
        self.scene: Scene | None = None
        self.palette: Palette = LIGHT
        self.draw: Callable[[], None] = lambda: None
        self.refresh: Callable[[], None] = lambda: None
        self.title = self.gui.add_html(_NARROW + block(line("loading")))
        self._note = self.gui.add_html("", visible=False)

    @property
    def editable(self) -> bool:
        return self.file is not None and not self.read_only

    def open_file(self) -> OpenFile:
        """Return the open file; raise InputError if the page shows flights."""
        if self.file is None:
            raise InputError("no mission or scenario is open")
        return self.file

    def apply(self, edit: Edit) -> None:
        """Edit the file; after an InputError, what was dragged or typed goes back."""
        try:
            self.open_file().edit(edit)
        except InputError:
            self.draw()
            raise
        self.note("")
        self.refresh()

    # --- the thread -----------------------------------------------------------------------------------------

    def post(self, run: Callable[..., Any], *arguments: Any) -> None:
        """Run a function on the page's thread; may be called from any thread."""
        self._tasks.put((run, arguments))

    def run_tasks(self, patience_s: float) -> None:
        """Run the next task, if one comes, and what has waited long enough."""
        wait_s = min(patience_s, 0.2 * _SETTLED_S) if self._waiting else patience_s
        with contextlib.suppress(queue.Empty):
            self.perform(*self._tasks.get(timeout=wait_s))
        self.settle(time.monotonic())

    def settle(self, before_s: float = float("inf")) -> None:
        """Run what waits for a further key, because the present value is needed."""
        for key in [key for key, (due, _, _) in self._waiting.items() if due <= before_s]:
            _, run, arguments = self._waiting.pop(key)
            self.perform(run, arguments)

    def perform(self, run: Callable[..., Any], arguments: tuple[Any, ...] = ()) -> None:
        """Run a task; whatever fails is one line in the page, and the page stays."""
        try:
            run(*arguments)
        except InputError as error:
            self.note(self.short(error.one_line()), bad=True)
        except FlightError as error:
            self.note(str(error), bad=True)
        except Exception as error:  # the page must outlive a fault of the studio
            traceback.print_exc(file=sys.stderr)
            self.note(f"fault of the studio: {type(error).__name__}: {error}", bad=True)

    def in_background(self, work: Callable[[], Any], then: Callable[[Any], None]) -> None:
        """Do work that takes long, such as reading a flight, and continue with its result."""

        def run() -> None:
            try:
                result = work()
            except Exception as error:  # raised again on the page's thread
                self.post(_raise, error)
            else:
                self.post(then, result)

        self._background.submit(run)

    def close(self) -> None:
        if self.engine is not None:
            self.engine.close()
        self._background.shutdown(wait=False, cancel_futures=True)

    # --- elements -------------------------------------------------------------------------------------------

    def note(self, text: str, *, bad: bool = False) -> None:
        """Show a message in one line, or none."""
        self._note.content = block(line(text, NO_GO if bad else QUIET))
        self._note.visible = bool(text)

    def show_title(self, *lines: str) -> None:
        self.title.content = _NARROW + block(*lines)

    def short(self, message: str) -> str:
        """Return a line of a command without the path of the open file."""
        path = "" if self.file is None else str(self.file.path)
        return message.replace(f"{path}: ", "").replace(f"{path}:", "line ") if path else message

    def button(self, label: str, run: Callable[[], None], **options: Any) -> Any:
        made = self.gui.add_button(label, **options)
        made.on_click(lambda event: self.post(run))
        return made

    def button_group(self, label: str, runs: dict[str, Callable[[], None]]) -> None:
        made = self.gui.add_button_group(label, tuple(runs))
        made.on_click(lambda event: self.post(runs[made.value]))

    def when_changed(self, made: Any, run: Callable[[Any], None], *, wait: bool = False) -> None:
        """Call `run` with a value that the page sets; `wait` waits until no further value follows."""

        def changed(event: Any) -> None:
            if event.client is None:  # set by the studio
                return
            if wait:
                due = time.monotonic() + _SETTLED_S
                self.post(self._waiting.__setitem__, id(made), (due, run, (made.value,)))
            else:
                self.post(run, made.value)

        made.on_update(changed)


def _raise(error: Exception) -> None:
    raise error


def distinct(labels: Iterable[str]) -> tuple[str, ...]:
    """Number equal labels, because a menu with two equal options stops the whole page."""
    found = dict[str, None]()
    for text in labels:
        name, count = text, 1
        while name in found:
            count += 1
            name = f"{text} ({count})"
        found[name] = None
    return tuple(found)


def line(text: str, colour: str = "inherit", *, strong: bool = False) -> str:
    """Return a line of text as HTML."""
    weight = "font-weight:600;" if strong else ""
    return f'<div style="{weight}color:{colour}">{html.escape(text)}</div>'


def details(summary: str, lines: Iterable[str]) -> str:
    """Return lines that a click shows, as HTML."""
    return f"<details><summary>{html.escape(summary)}</summary>{''.join(lines)}</details>"


def block(*lines: str) -> str:
    return f'<div style="{_STYLE}">{"".join(lines)}</div>'
