"""The panels of the studio's page, except the player; they show what the `Studio` gives and call it back."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import viser

from dart_flight.lab.search.scenario import Objective
from dart_flight.lab.studio.engine import (
    Finding,
    FlightsFlown,
    FlownOne,
    FlyProgress,
    FlyRequest,
    Planned,
    PlanRow,
)
from dart_flight.lab.studio.fields import Field, label_of
from dart_flight.lab.studio.open_file import Edit

GO, NO_GO, QUIET = "#22964a", "#d9372c", "#888888"  # legible on light and dark
_STYLE = "padding:0 0.8em;font-size:0.85em;line-height:1.45;overflow-wrap:anywhere"
_PLAIN = "as in the file"
_NOT_FLOWN = "-"

Post = Callable[..., None]  # (function, *arguments): runs the function on the studio's thread


class Wiring(NamedTuple):
    """How panels reach the page and the studio.

    Attributes:
        later: as `post`, but only the last call with the same first argument within a moment is run.
        read_only: whether everything that writes or computes is left out.
    """

    server: viser.ViserServer
    post: Post
    later: Post
    read_only: bool

    def button(self, label: str, run: Callable[[], None], **options: Any) -> Any:
        made = self.server.gui.add_button(label, **options)
        made.on_click(lambda event: self.post(run))
        return made

    def when_changed(self, made: Any, run: Callable[[Any], None], *, wait: bool = False) -> None:
        """Call `run` with the value that a page has set; with `wait`, when no further value follows."""

        def changed(event: Any) -> None:
            if event.client is None:  # set by the studio
                return
            if wait:
                self.later(id(made), run, made.value)
            else:
                self.post(run, made.value)

        made.on_update(changed)


def distinct(labels: Iterable[str]) -> tuple[str, ...]:
    """Number equal labels, because a menu with two equal options stops the whole page."""
    counts, found = dict[str, int](), dict[str, None]()
    for text in labels:
        name = text
        while name in found:
            counts[text] = counts.get(text, 1) + 1
            name = f"{text} ({counts[text]})"
        found[name] = None
    return tuple(found)


def line(text: str, colour: str = "inherit", *, strong: bool = False) -> str:
    """Return a line of text as HTML."""
    weight = "font-weight:600;" if strong else ""
    return f'<div style="{weight}color:{colour}">{html.escape(text)}</div>'


def block(*lines: str) -> str:
    return f'<div style="{_STYLE}">{"".join(lines)}</div>'


class HeadPanel:
    """Name and state of the file, the verdict of `check`, and the buttons of the file."""

    def __init__(self, wiring: Wiring, run: Mapping[str, Callable[[], None]]) -> None:
        gui = wiring.server.gui
        self._html = gui.add_html(block(line("loading")))
        self._note = gui.add_html("", visible=False)
        self._save: Any = None
        if wiring.read_only:
            return
        self._steps = gui.add_button_group("", ("Undo", "Redo"))
        self._steps.on_click(lambda event: wiring.post(run[self._steps.value.lower()]))
        self._save = wiring.button("Save", run["save"], disabled=True)
        self._reload = wiring.button("Reload from the disk", run["reload"], color="orange", visible=False)
        self._keep = wiring.button("Overwrite the file", run["overwrite"], color="orange", visible=False)
        for label, hotkey, name in (("Undo", "z", "undo"), ("Redo", "y", "redo"), ("Save", "s", "save")):
            command = gui.add_command(label, hotkey=hotkey, modifier="cmd/ctrl")
            command.on_trigger(lambda event, name=name: wiring.post(run[name]))

    def show(self, title: str, state: str, verdict: str, go: bool | None) -> None:
        colour = QUIET if go is None else GO if go else NO_GO
        self._html.content = block(
            line(title, strong=True), line(state, QUIET), line(verdict, colour, strong=True)
        )

    def show_steps(self, *, unsaved: bool, asks: bool) -> None:
        """Enable *Save*; with `asks`, offer to reload or to overwrite a file that has changed on the disk."""
        if self._save is not None:
            self._save.disabled = not unsaved
            self._reload.visible = self._keep.visible = asks

    def note(self, text: str, *, bad: bool = False) -> None:
        self._note.content = block(line(text, NO_GO if bad else QUIET))
        self._note.visible = bool(text)


class FindingsPanel:
    """The findings of `check`, the no-go ones first."""

    def __init__(self, wiring: Wiring) -> None:
        with wiring.server.gui.add_folder("Check"):
            self._html = wiring.server.gui.add_html(block(line("checking")))

    def show(self, findings: Sequence[Finding], stale: str | None) -> None:
        bad = [f for f in findings if not f.go]
        remarks = [f for f in findings if f.go and f.word not in ("go", "GO")]
        good = [f for f in findings if f.go and f.word in ("go", "GO")]
        lines = [line(f"the plan is stale: {stale}", NO_GO)] if stale is not None else []
        lines += [line(f"✗ {f.item}: {f.message}", NO_GO) for f in bad]
        lines += [line(f"• {f.item}: {f.message}") for f in remarks]
        if good:
            inside = "".join(line(f"✓ {f.item}: {f.message}", QUIET) for f in good)
            lines.append(f"<details><summary>{len(good)} findings are go</summary>{inside}</details>")
        self._html.content = block(*lines)


class ObjectPanel:
    """The selected object: its numbers, the findings, and the buttons that add, copy and delete."""

    def __init__(
        self,
        wiring: Wiring,
        select: Callable[[str], None],
        apply: Callable[[Edit], None],
        act: Callable[[str], None],
    ) -> None:
        self._wiring, self._apply = wiring, apply
        self._ids, self._labels = list[str](), tuple[str, ...]()
        self._shown: tuple[Any, ...] = ()
        self._inputs: list[tuple[Field, Any]] = []
        gui = wiring.server.gui
        self._choice = gui.add_dropdown("object", ("-",), hint="or click an object in the room")
        wiring.when_changed(self._choice, lambda label: select(self._id_of(label)))
        self._folder = gui.add_folder(None)
        self.findings = FindingsPanel(wiring)
        if not wiring.read_only:
            with gui.add_folder("Add, copy, delete"):
                self._act = gui.add_button_group("this object", ("Copy", "Delete"))
                self._act.on_click(lambda event: wiring.post(act, self._act.value.lower()))
                self._add = gui.add_dropdown("add", ("wall",))
                wiring.button("Add", lambda: act(f"add {self._add.value}"), color="gray")

    def _id_of(self, label: str) -> str:
        return dict(zip(self._labels, self._ids, strict=True)).get(label, "")

    def show(
        self, ids: Sequence[str], selected: str, fields: Sequence[Field], addable: Sequence[str]
    ) -> None:
        """Show an object; the fields of the same object keep their inputs, so that nobody loses the focus."""
        self._ids, self._labels = list(ids), distinct(map(label_of, ids))
        if (self._labels or ("-",)) != self._choice.options:
            self._choice.options = self._labels or ("-",)
        if selected in self._ids:
            self._choice.value = self._labels[self._ids.index(selected)]
        if not self._wiring.read_only and tuple(addable) != self._add.options:
            self._add.options = tuple(addable)
        shape = (selected, [(f.label, f.options) for f in fields])
        if shape == self._shown:
            self._inputs = [(field, made) for field, (_, made) in zip(fields, self._inputs, strict=True)]
            for field, made in self._inputs:
                made.value = field.value
            return
        self._shown = shape
        for _, made in self._inputs:
            made.remove()
        with self._folder:
            self._inputs = [(field, self._make(i, field)) for i, field in enumerate(fields)]
        self._folder.label = label_of(selected) if selected else None

    def _make(self, i: int, field: Field) -> Any:
        gui, hint = self._wiring.server.gui, field.hint or None
        disabled = self._wiring.read_only
        made: Any
        if field.options:
            made = gui.add_dropdown(
                field.label,
                distinct(dict.fromkeys(field.options)),
                initial_value=str(field.value),
                hint=hint,
                disabled=disabled,
            )
        elif isinstance(field.value, str):
            made = gui.add_text(field.label, field.value, hint=hint, disabled=disabled)
        else:
            made = gui.add_number(field.label, field.value, step=field.step, hint=hint, disabled=disabled)
            made.precision = 6
        if not disabled:
            # The present field, because an edit made in between has replaced it.
            self._wiring.when_changed(
                made, lambda value: self._apply(self._inputs[i][0].edit(value)), wait=not field.options
            )
        return made


class PlanPanel:
    """The search for plans, and the list of plans."""

    def __init__(
        self,
        wiring: Wiring,
        plan: Callable[[str | None, float], None],
        cancel: Callable[[], None],
        choose: Callable[[int], None],
        make: Callable[[int], None],
    ) -> None:
        gui = wiring.server.gui
        self._html = gui.add_html("")
        self._objective = gui.add_dropdown("objective", (_PLAIN, *(one.value for one in Objective)))
        self._within = gui.add_number("at most, s", 60.0, min=1.0, max=3600.0, step=5.0)
        self._plan = wiring.button("Plan", lambda: plan(self._wanted(), float(self._within.value)))
        self._cancel = wiring.button("Cancel", cancel, color="gray", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False, animated=True)
        self._progress = gui.add_html("", visible=False)
        self._choice = gui.add_dropdown("plan", ("-",), visible=False)
        self._table = gui.add_html("", visible=False)
        self._make = wiring.button(
            "Make the mission",
            lambda: make(self._rank()),
            visible=False,
            hint="as one step that can be undone",
        )
        self._rows: list[PlanRow] = []
        self._choose = choose
        wiring.when_changed(self._choice, self._chosen)

    def _wanted(self) -> str | None:
        return None if self._objective.value == _PLAIN else str(self._objective.value)

    def _rank(self) -> int:
        labels = distinct(map(_plan_label, self._rows))
        return next(
            (r.rank for r, text in zip(self._rows, labels, strict=True) if text == self._choice.value), 0
        )

    def _chosen(self, label: str) -> None:
        self._describe()
        self._choose(self._rank())

    def explain(self, text: str) -> None:
        self._html.content = block(line(text, QUIET))

    def running(self, share: float | None, message: str) -> None:
        self._plan.visible, self._cancel.visible = False, True
        self._bar.visible = self._progress.visible = True
        self._bar.value = 100.0 * (share or 0.0)
        self._progress.content = block(line(message, QUIET))

    def done(self, event: Planned) -> None:
        self._plan.visible, self._cancel.visible = True, False
        self._bar.visible = False
        lines = [line(event.error, NO_GO)] if event.error else [line(event.summary, QUIET)]
        if event.cancelled:
            lines.append(line("cancelled", QUIET))
        refused = sorted(event.refused.items(), key=lambda item: -item[1])
        if refused:
            inside = "".join(
                line(f"{count:,} × {reason}") + line(event.advice.get(reason, ""), QUIET)
                for reason, count in refused
            )
            total = sum(count for _, count in refused)
            lines.append(f"<details><summary>{total:,} candidates refused</summary>{inside}</details>")
        self._progress.content, self._progress.visible = block(*lines), True
        self._rows = [*event.plans, *([event.free] if event.free is not None else [])]
        shown = bool(self._rows)
        self._choice.visible = self._table.visible = self._make.visible = shown
        if shown:
            self._choice.options = distinct(map(_plan_label, self._rows))
            self._choice.value = self._choice.options[0]
            self._describe()

    def _describe(self) -> None:
        row = next((r for r in self._rows if r.rank == self._rank()), None)
        if row is None:
            return
        cells = "".join(
            f"<tr><td style='color:{QUIET};padding-right:1em'>{html.escape(name)}</td>"
            f"<td>{html.escape(value)}</td></tr>"
            for name, value in row.values.items()
        )
        lines = [line(row.summary), f"<table>{cells}</table>"]
        if row.refused is not None:
            lines.append(line(f"refused: {row.refused}", NO_GO))
        elif row.mission:
            lines.append(line("check: go", GO) if row.go else line(f"check: no-go: {row.problem}", NO_GO))
        self._table.content = block(*lines)
        self._make.disabled = not row.mission


def _plan_label(row: PlanRow) -> str:
    name = "free flight" if row.rank == 0 else f"{row.rank}"
    time = "" if row.time_s is None else f": {row.time_s:.2f} s"
    saves = row.saving_s or 0.0
    saving = f", {'saves' if saves > 0.0 else 'loses'} {abs(saves):.2f} s" if saves else ""
    return f"{name}{time}{saving}"


class FlyPanel:
    """Flights in simulated time.

    Args:
        only_list: whether the flights have been flown elsewhere.
    """

    def __init__(
        self,
        wiring: Wiring,
        fly: Callable[[FlyRequest], None],
        cancel: Callable[[], None],
        open_flight: Callable[[FlownOne], None],
        *,
        only_list: bool = False,
    ) -> None:
        gui = wiring.server.gui
        self._seed = gui.add_number("seed", 1, min=0, max=2**31 - 1001, step=1)
        self._flights = gui.add_number("flights", 1, min=1, max=1000, step=1, hint="with consecutive seeds")
        self._vary = gui.add_text(
            "vary", "", hint="what differs at random from the mission, as --vary: all, or mass contact=0.3"
        )
        self._fault = gui.add_text("fault", "", hint="NAME[=VALUE][@PHASE] as --fault; for a single flight")
        self._fly = wiring.button("Fly", lambda: fly(self.request()))
        self._cancel = wiring.button("Cancel", cancel, color="gray", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._html = gui.add_html("", visible=False)
        self._choice = gui.add_dropdown("flight", (_NOT_FLOWN,), visible=False)
        self._open = wiring.button(
            "Open this flight", lambda: self._opened(open_flight), color="gray", visible=False
        )
        self.landed: list[FlownOne] = []
        self._labels: tuple[str, ...] = ()  # of the flights in the list
        self._only_list = only_list
        if only_list:
            for made in (self._seed, self._flights, self._vary, self._fault, self._fly):
                made.visible = False

    def request(self) -> FlyRequest:
        vary = tuple(str(self._vary.value).replace(",", " ").split())
        flights = int(self._flights.value)
        fault = str(self._fault.value).strip() or None
        # A flight without a log is flown again when it is opened.
        return FlyRequest(int(self._seed.value), flights, vary, fault, log=flights == 1)

    def _opened(self, open_flight: Callable[[FlownOne], None]) -> None:
        if self._choice.value in self._labels:
            open_flight(self.landed[self._labels.index(self._choice.value)])

    def begin(self, flights: int) -> None:
        self.landed, self._labels = [], ()
        self._fly.visible, self._cancel.visible, self._bar.visible = False, True, True
        self._bar.value, self._html.visible = 0.0, True
        self._choice.visible = self._open.visible = False
        self._html.content = block(line(f"0 of {flights} flights", QUIET))

    def progress(self, event: FlyProgress) -> None:
        self.landed += event.landed
        self._bar.value, self._html.visible = 100.0 * event.done / max(1, event.of), True
        share = f", {event.completed} completed" if event.done else ""
        self._html.content = block(line(f"{event.done} of {event.of} flights{share}", QUIET))

    def done(self, event: FlightsFlown) -> None:
        self._fly.visible = not self._only_list
        self._cancel.visible = self._bar.visible = False
        lines = [line(event.error, NO_GO)] if event.error else [line(event.summary)]
        if event.cancelled:
            lines.append(line("cancelled", QUIET))
        if event.done > 1:
            lines.append(line(f"{100.0 * event.completed / event.done:.0f} % completed", strong=True))
        for reason, count in sorted(event.reasons.items(), key=lambda item: -item[1]):
            lines.append(line(f"{count} × {reason}", NO_GO))
        self._html.content, self._html.visible = block(*lines), True
        if self.landed:
            self.landed.sort(key=lambda one: (one.outcome == "completed", one.seed))
            self._labels = self._choice.options = distinct(map(_flight_label, self.landed))
            self._choice.value = self._choice.options[0]
            self._choice.visible = self._open.visible = self._only_list or len(self.landed) > 1

    def select(self, flight: FlownOne) -> None:
        for label, landed in zip(self._labels, self.landed, strict=False):
            if landed is flight:
                self._choice.value = label


def _flight_label(flight: FlownOne) -> str:
    reason = "" if flight.reason is None else f": {flight.reason}"
    return f"seed {flight.seed}, {flight.outcome}{reason}"[:90]
