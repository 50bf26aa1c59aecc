"""A mission or scenario file that is open in the studio: its text, undo and redo, and what is on the disk."""

from __future__ import annotations

import copy
from collections.abc import Callable
from enum import Enum, StrEnum
from pathlib import Path
from typing import Any, NamedTuple

from dart_flight.config.document import (
    Document,
    InputError,
    Stamp,
    read_text,
    replace_file,
    report_write_errors,
    stamp_of,
)
from dart_flight.config.edit import update_text
from dart_flight.config.file_kinds import FileKind, kind_of_tree

_MOST_STEPS = 1000  # steps that can be undone

Tree = dict[str, Any]


class Edit(NamedTuple):
    """An edit of the values of a file.

    Attributes:
        what: the edit in words, such as `move wall acrylic`.
        change: changes the plain values of the file in place; raises InputError if it is not possible.
    """

    what: str
    change: Callable[[Tree], None]


class StudioKind(StrEnum):
    """The kind of the open file."""

    MISSION = "mission"
    SCENARIO = "scenario"


class DiskState(Enum):
    """How the file on the disk compares with the file as it was opened."""

    SAME = "the file on the disk is the opened one"
    CHANGED = "the file has changed on the disk"
    BOTH_CHANGED = "the file has changed on the disk, and here"
    MISSING = "the file is no longer on the disk"


class OpenFile:
    """A mission or scenario, as text.

    Every edit keeps the bytes of the entries that it does not change; undo restores the previous bytes.

    Attributes:
        path: the file.
        kind: mission or scenario.
        saved: text as opened, reloaded or saved.
    """

    def __init__(self, path: Path, text: str, stamp: Stamp = None) -> None:
        self.path, self.saved = path, text
        self._stamp = stamp
        self._texts, self._edits, self._at = [text], list[str](), 0  # edit i leads from text i to text i + 1
        self.kind = kind_of_text(text, path)

    @classmethod
    def load(cls, path: str | Path) -> OpenFile:
        """Open a file.

        Raises:
            InputError: the file cannot be read, is not YAML, or is neither a mission nor a scenario.
        """
        place = Path(path)
        stamp = stamp_of(place)
        return cls(place, read_text(place), stamp)

    @classmethod
    def new(cls, path: str | Path, text: str) -> OpenFile:
        """Return an open file that is not on the disk yet, such as the mission of a plan."""
        opened = cls(Path(path), text)
        opened.saved = ""
        return opened

    @property
    def text(self) -> str:
        """The present text."""
        return self._texts[self._at]

    @property
    def tree(self) -> Tree:
        """A copy of the present values."""
        tree: Tree = Document(self.text, str(self.path)).tree
        return tree

    def edit(self, edit: Edit) -> None:
        """Apply an edit; after an InputError, nothing has changed."""
        tree = self.tree
        wanted = copy.deepcopy(tree)
        edit.change(wanted)
        self.set_text(update_text(self.text, wanted, str(self.path)), edit.what)

    def set_text(self, text: str, what: str) -> None:
        """Replace the whole text as one step, for example by the mission of a plan."""
        if text == self.text:
            return
        first = max(0, self._at + 1 - _MOST_STEPS)
        self._texts = [*self._texts[first : self._at + 1], text]
        self._edits = [*self._edits[first : self._at], what]
        self._at = len(self._edits)

    @property
    def can_undo(self) -> str | None:
        """The last edit in words, or None if there is nothing to undo."""
        return self._edits[self._at - 1] if self._at else None

    @property
    def can_redo(self) -> str | None:
        """The edit that `redo` repeats, in words, or None."""
        return self._edits[self._at] if self._at < len(self._edits) else None

    def undo(self) -> str | None:
        """Restore the text before the last edit; return the edit in words, or None without an edit."""
        what = self.can_undo
        self._at -= what is not None
        return what

    def redo(self) -> str | None:
        """Repeat the edit that was undone last; return it in words, or None."""
        what = self.can_redo
        self._at += what is not None
        return what

    @property
    def is_changed(self) -> bool:
        """Whether the text differs from the file as opened or saved."""
        return self.text != self.saved

    def disk_state(self) -> DiskState:
        """Compare the file on the disk with the file as opened; a call costs one `stat`."""
        stamp = stamp_of(self.path)
        if stamp == self._stamp:
            return DiskState.SAME
        if stamp is None:
            return DiskState.MISSING
        try:
            same = read_text(self.path) == self.saved
        except InputError:
            same = False  # the file is not text any more, or is unreadable
        if same:
            self._stamp = stamp
            return DiskState.SAME
        return DiskState.BOTH_CHANGED if self.is_changed else DiskState.CHANGED

    def save(self, *, overwrite: bool = False) -> None:
        """Write the text, completely or not at all.

        Raises:
            InputError: the file cannot be written; or it has changed on the disk and `overwrite` is not set.
        """
        if not overwrite:
            if self.disk_state() in (DiskState.CHANGED, DiskState.BOTH_CHANGED):
                raise InputError("changed on the disk: reload it, or overwrite it", source=str(self.path))
            if not self.is_changed and self.path.exists():
                return
        with report_write_errors(self.path):
            replace_file(self.path, self.text.encode("utf-8"))
        self.saved, self._stamp = self.text, stamp_of(self.path)

    def reload(self) -> None:
        """Take the text from the disk, as a step that can be undone.

        Raises:
            InputError: the file cannot be read, or is neither a mission nor a scenario.
        """
        stamp = stamp_of(self.path)
        text = read_text(self.path)
        kind = kind_of_text(text, self.path)
        self.set_text(text, "reload the file")
        self.saved, self._stamp, self.kind = text, stamp, kind


def kind_of_text(text: str, path: Path) -> StudioKind:
    """Return the kind of a text; raise InputError if it is neither a mission nor a scenario."""
    tree = Document(text, str(path)).tree
    kind = kind_of_tree(tree)
    if kind is FileKind.SCENARIO:
        return StudioKind.SCENARIO
    if kind is FileKind.MISSION or (kind is None and "start" in tree and "goal" in tree):
        return StudioKind.MISSION
    what = "another file" if kind is None else kind.value
    raise InputError(f"this is {what}; the studio opens missions and scenarios", source=str(path))
