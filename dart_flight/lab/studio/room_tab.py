"""The tab *Room*: the selected object, the findings, and the buttons that add, copy and delete."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dart_flight.base.geometry import Vec2
from dart_flight.config.document import InputError
from dart_flight.config.mission_file import BoundsSpec
from dart_flight.lab.studio import edits
from dart_flight.lab.studio.engine import Checked, Finding
from dart_flight.lab.studio.fields import Field, fields_of, object_ids
from dart_flight.lab.studio.objects import describe, entry_of
from dart_flight.lab.studio.open_file import Edit, StudioKind
from dart_flight.lab.studio.studio_page import NO_GO, QUIET, StudioPage, block, details, distinct, line

_NEAR_M = 0.5  # a new object appears so far from the middle of the room


class RoomTab:
    """The tab, in the present container of the page.

    Attributes:
        selected: id of the selected object.
    """

    def __init__(self, page: StudioPage) -> None:
        self._page, self.selected = page, ""
        self._checked = Checked()
        self._bounds: BoundsSpec | None = None
        self._ids, self._labels = list[str](), tuple[str, ...]()
        self._shape: Any = None
        self._inputs: list[tuple[Field, Any]] = []
        gui = page.gui
        self._choice = gui.add_dropdown("object", ("-",), hint="or click an object in the room")
        page.when_changed(self._choice, self._chosen)
        self._folder = gui.add_folder(None)
        with gui.add_folder("Check"):
            self._findings = gui.add_html(block(line("checking")))
        if page.editable:
            with gui.add_folder("Add, copy, delete"):
                copies = {"Copy": lambda: self._act(edits.copy_object(self.selected))}
                page.button_group(
                    "this object", copies | {"Delete": lambda: self._act(edits.delete(self.selected))}
                )
                self._add = gui.add_dropdown("add", ("wall",))
                page.button("Add", lambda: self._act(self._addition(self._add.value)), color="gray")

    def select(self, object_id: str) -> None:
        """Select an object, for example one that was clicked in the room."""
        if object_id:
            self.selected = "corner/0" if object_id.startswith("corner/") else object_id
            self._page.draw()

    def _chosen(self, label: str) -> None:
        if label in self._labels:
            self.select(self._ids[self._labels.index(label)])

    def show(self, bounds: BoundsSpec | None) -> None:
        """Show the selected object of the open file; the same object keeps its inputs, and so the focus."""
        self._bounds, file = bounds, self._page.open_file()
        tree = file.tree
        self._ids = object_ids(tree)
        self._labels = distinct(describe(one).removeprefix("the ") for one in self._ids)
        if entry_of(tree, self.selected or "start") is None or not self.selected:
            self.selected = next(iter(self._ids), "")
        if (self._labels or ("-",)) != self._choice.options:
            self._choice.options = self._labels or ("-",)
        if self.selected in self._ids:
            self._choice.value = self._labels[self._ids.index(self.selected)]
        if self._page.editable:
            place = "visit" if file.kind is StudioKind.SCENARIO else "waypoint"
            addable = ("wall", "post", place, "hit")
            self._add.options = addable if self._add.options != addable else self._add.options
        self._show_fields(fields_of(tree, self.selected, self._checked.materials, self._checked.modes))

    def _show_fields(self, fields: Sequence[Field]) -> None:
        shape = (self.selected, [(field.label, field.options) for field in fields])
        if shape == self._shape:
            self._inputs = [(field, made) for field, (_, made) in zip(fields, self._inputs, strict=True)]
            for field, made in self._inputs:
                made.value = field.value
            return
        self._shape = shape
        for _, made in self._inputs:
            made.remove()
        with self._folder:
            self._inputs = [(field, self._make(i, field)) for i, field in enumerate(fields)]
        self._folder.label = describe(self.selected).removeprefix("the ") if self.selected else None

    def _make(self, i: int, field: Field) -> Any:
        gui, page = self._page.gui, self._page
        given: dict[str, Any] = {"hint": field.hint or None, "disabled": not page.editable}
        made: Any
        if field.options:
            options = distinct(dict.fromkeys(field.options))
            made = gui.add_dropdown(field.label, options, initial_value=str(field.value), **given)
        elif isinstance(field.value, str):
            made = gui.add_text(field.label, field.value, **given)
        else:
            made = gui.add_number(field.label, field.value, step=field.step, **given)
            made.precision = 6
        if page.editable:
            # The present field, because an edit made in between has replaced it.
            page.when_changed(
                made, lambda value: page.apply(self._inputs[i][0].edit(value)), wait=not field.options
            )
        return made

    def show_findings(self, checked: Checked) -> None:
        """Show the findings of `check`, the no-go ones first."""
        known, self._checked = self._checked, checked

        def row(sign: str, one: Finding, colour: str = "inherit") -> str:
            return line(f"{sign} {one.item}: {self._page.short(one.message)}", colour)

        lines = [line(f"the plan is stale: {checked.stale}", NO_GO)] if checked.stale is not None else []
        lines += [row("✗", one, NO_GO) for one in checked.findings if not one.go]
        lines += [row("•", one) for one in checked.findings if one.go and one.remark]
        good = [row("✓", one, QUIET) for one in checked.findings if one.go and not one.remark]
        lines += [details(f"{len(good)} findings are go", good)] if good else []
        self._findings.content = block(*lines or [line("the file loads", QUIET)])
        if (known.materials, known.modes) != (checked.materials, checked.modes):
            self.show(self._bounds)

    def _act(self, edit: Edit) -> None:
        """Copy, delete or add an object, and select a new one."""
        file = self._page.open_file()
        before = set(object_ids(file.tree))
        self._page.apply(edit)
        self.select(next((one for one in object_ids(file.tree) if one not in before), self.selected))

    def _addition(self, kind: str) -> Edit:
        if self._bounds is None:
            raise InputError("nothing can be added before the file loads")
        (x0, x1), (y0, y1) = self._bounds.x, self._bounds.y
        middle = (round(0.5 * (x0 + x1), 2), round(0.5 * (y0 + y1), 2))
        aside: Vec2 = (middle[0] - _NEAR_M, middle[1])
        material = next(iter(self._checked.materials), "wood")
        if kind == "wall":
            return edits.add_wall((middle[0], y1), -90.0, round(0.5 * (x1 - x0), 1), material)
        if kind == "post":
            return edits.add_post((middle[0] + _NEAR_M, middle[1]), 0.1, material)
        if kind in ("waypoint", "visit"):
            return edits.add_waypoint(aside) if kind == "waypoint" else edits.add_visit(aside)
        walls = self._page.open_file().tree.get("walls") or {}
        chosen = self.selected.partition("/")[2] if self.selected.startswith("wall/") else ""
        wall = chosen or next(iter(walls), "")
        if not wall:
            raise InputError("add a wall first, then a hit on it")
        return edits.add_hit(wall)
