"""The tab *Plan*: the search for plans, the list of plans, and the mission of one of them."""

from __future__ import annotations

import html
from pathlib import Path

import yaml

from dart_flight.config.document import InputError
from dart_flight.lab.map_model import MapKind
from dart_flight.lab.search.scenario import Objective
from dart_flight.lab.studio import edits
from dart_flight.lab.studio.canvas import LIGHT, path_style, polyline
from dart_flight.lab.studio.engine import EngineEvent, Failed, Planned, PlanRow, Progress
from dart_flight.lab.studio.open_file import OpenFile, StudioKind
from dart_flight.lab.studio.studio_page import GO, NO_GO, QUIET, StudioPage, block, details, distinct, line

_PLAIN = "as in the file"


class PlanTab:
    """The tab, in the present container of the page."""

    def __init__(self, page: StudioPage) -> None:
        self._page, gui = page, page.gui
        self._number = 0  # of the request
        self._rows: list[PlanRow] = []
        self._before: OpenFile | None = None  # the scenario of a mission that was made here
        self._style = path_style(MapKind.REPLANNED, LIGHT)
        self._html = gui.add_html("")
        self._objective = gui.add_dropdown("objective", (_PLAIN, *(one.value for one in Objective)))
        self._within = gui.add_number("at most, s", 60.0, min=1.0, max=3600.0, step=5.0)
        self._plan = page.button("Plan", self._search)
        self._cancel = page.button("Cancel", self._stop, color="gray", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False, animated=True)
        self._progress = gui.add_html("", visible=False)
        self._choice = gui.add_dropdown("plan", ("-",), visible=False)
        self._table = gui.add_html("", visible=False)
        self._make = page.button("Make the mission", self._make_mission, visible=False)
        self._back = page.button("Back to the scenario", self._go_back, visible=False)
        page.when_changed(self._choice, lambda label: self._describe())

    def explain(self, stale: str | None) -> None:
        """Say what *Plan* does for the open file."""
        scenario = self._page.open_file().kind is StudioKind.SCENARIO
        text = "Plan searches this mission again: the same walls in the same order."
        if scenario:
            text = "Plan searches walls, velocities and modes for this scenario."
        elif stale is not None:
            text = f"The plan of this mission is stale: {stale}. Plan makes a new one."
        self._html.content = block(line(text, QUIET))
        self._make.label = "Make the mission" if scenario else "Use this plan"
        self._back.visible = self._before is not None

    # --- the search -----------------------------------------------------------------------------------------

    def _search(self) -> None:
        self._page.settle()
        file, engine = self._page.open_file(), self._page.engine
        assert engine is not None
        text = file.text
        if file.kind is StudioKind.MISSION:
            tree = edits.scenario_of(file.tree, file.path.stem)
            text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=None)
        objective = None if self._objective.value == _PLAIN else str(self._objective.value)
        self._number = engine.plan(text, file.path, objective, float(self._within.value))
        self._show_running(True, 0.0, line("planning", QUIET))

    def _stop(self) -> None:
        if self._page.engine is not None:
            self._page.engine.cancel()

    def _show_running(self, running: bool, share: float, *lines: str) -> None:
        self._plan.visible, self._cancel.visible, self._bar.visible = not running, running, running
        self._bar.value, self._progress.visible = 100.0 * share, True
        self._progress.content = block(*lines)

    def handle(self, event: EngineEvent) -> bool:
        """Show an event of the engine; return whether it belongs to a search."""
        what = event.what
        if event.number != self._number or not event.number:
            return False
        if isinstance(what, Progress):
            found = f"searching: {what.done:,}" + (
                f" of {what.of:,} candidates" if what.of else " candidates"
            )
            self._show_running(True, what.done / what.of if what.of else 0.0, line(found, QUIET))
        elif isinstance(what, Failed):
            self._show_running(False, 0.0, line(what.message, QUIET if what.cancelled else NO_GO))
        elif isinstance(what, Planned):
            self._show_plans(what)
        return True

    def _show_plans(self, found: Planned) -> None:
        lines = [line(found.summary, QUIET)]
        refused = sorted(found.refused.items(), key=lambda item: -item[1][0])
        if refused:
            rows = [line(f"{n:,} × {reason}") + line(advice, QUIET) for reason, (n, advice) in refused]
            lines.append(details(f"{sum(n for _, (n, _) in refused):,} candidates refused", rows))
        self._show_running(False, 1.0, *lines)
        self._rows = found.plans
        shown = bool(self._rows)
        self._choice.visible = self._table.visible = self._make.visible = shown
        if shown:
            labels = self._choice.options = distinct(map(_label, self._rows))
            best = next((i for i, row in enumerate(self._rows) if row.rank and not row.problem), 0)
            self._choice.value = labels[best]
            self._describe()

    # --- a plan ---------------------------------------------------------------------------------------------

    def _row(self) -> PlanRow:
        index: int = self._choice.options.index(self._choice.value)
        return self._rows[index]

    def _describe(self) -> None:
        row = self._row()
        cells = "".join(
            f"<tr><td style='color:{QUIET};padding-right:1em'>{html.escape(name)}</td>"
            f"<td>{html.escape(value)}</td></tr>"
            for name, value in row.values.items()
        )
        verdict = line(f"check: {row.problem}", NO_GO) if row.problem else line("check: go", GO)
        self._table.content = block(line(row.summary), f"<table>{cells}</table>", verdict)
        self._make.disabled = not row.mission
        lines = [points for points in row.paths if len(points) > 1]
        self._page.canvas.draw(
            "plan", [polyline(f"/plan/{i}", one, *self._style) for i, one in enumerate(lines)]
        )

    def _make_mission(self) -> None:
        page, file, row = self._page, self._page.open_file(), self._row()
        page.settle()
        page.canvas.draw("plan", [])
        if file.kind is StudioKind.MISSION:
            page.apply(edits.use_plan(row.mission, row.rank))
            page.note(f"plan {row.rank} replaces the hits; Undo restores them, Save writes {file.path.name}")
            return
        self._before, page.file = file, OpenFile.new(_free_name(file.path), row.mission)
        page.refresh()
        page.note(f"the mission of plan {row.rank}; Save writes {page.file.path.name}")

    def _go_back(self) -> None:
        if self._before is not None:
            made = self._page.open_file()
            if made.is_changed and made.can_undo:
                raise InputError("the mission has edits that are not saved: Save or Undo them first")
            self._page.file, self._before = self._before, None
            self._page.note("")
            self._page.refresh()


def _label(row: PlanRow) -> str:
    name = f"{row.rank}" if row.rank else "free flight"
    time = "" if row.time_s is None else f": {row.time_s:.2f} s"
    saves = row.saving_s or 0.0
    saving = f", {'saves' if saves > 0.0 else 'loses'} {abs(saves):.2f} s" if saves else ""
    return f"{name}{time}{saving}{', no-go' if row.problem else ''}"


def _free_name(scenario: Path) -> Path:
    """Return the name of the mission of a scenario, beside it, that no file has."""
    names = (scenario.with_name(f"{scenario.stem}_plan{n}.yaml") for n in ("", *range(2, 1000)))
    return next(path for path in names if not path.exists())
