"""A file that is open in the studio keeps its bytes, its edits, and what others write to the disk."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dart_flight.config.document import Document, InputError
from dart_flight.lab.studio import edits
from dart_flight.lab.studio.open_file import DiskState, OpenFile, StudioKind
from tests.lab.studio.files import DUAL, FILES, MISSIONS, name_of, one_edit, try_edit

NUDGE = edits.move("goal", (0.9, -0.4))


@pytest.fixture
def opened(tmp_path: Path) -> OpenFile:
    return OpenFile.load(shutil.copy(DUAL, tmp_path / "room.yaml"))


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_saving_without_an_edit_leaves_each_shipped_file_as_it_was(path: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copy(path, tmp_path / path.name))
    opened = OpenFile.load(copy)
    opened.save()
    opened.save(overwrite=True)
    assert copy.read_bytes() == path.read_bytes()
    assert (opened.kind is StudioKind.MISSION) == (path in MISSIONS)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.data_too_large])
@given(st.data())
def test_any_edits_undone_give_the_same_bytes_and_redone_the_same_edits(data: st.DataObject) -> None:
    opened = OpenFile.load(data.draw(st.sampled_from(FILES)))
    texts = [opened.text]
    for _ in range(data.draw(st.integers(1, 6))):
        if try_edit(opened, data.draw(one_edit(opened))) and opened.text != texts[-1]:
            texts.append(opened.text)
    for text in reversed(texts[:-1]):
        assert opened.undo() is not None
        assert opened.text == text
    assert opened.can_undo is None
    assert opened.undo() is None
    assert not opened.is_changed
    for text in texts[1:]:
        opened.redo()
        assert opened.text == text
    assert opened.redo() is None


def test_an_edit_changes_only_its_entry(opened: OpenFile) -> None:
    before = opened.text.splitlines()
    opened.edit(edits.move("wall/acrylic", (1.95, 0.0)))
    changed = [pair for pair in zip(before, opened.text.splitlines(), strict=True) if pair[0] != pair[1]]
    assert len(changed) == 1
    assert "[1.95, 0.0]" in changed[0][1]


def test_an_edit_that_is_not_possible_changes_nothing(opened: OpenFile) -> None:
    with pytest.raises(InputError, match="wall brick does not exist"):
        opened.edit(edits.move("wall/brick", (0.0, 0.0)))
    assert not opened.is_changed
    assert opened.can_undo is None


def test_an_edit_without_an_effect_is_no_step(opened: OpenFile) -> None:
    opened.edit(edits.move("goal", (1.0, -0.5)))
    assert opened.can_undo is None


def test_a_new_edit_forgets_what_was_undone(opened: OpenFile) -> None:
    opened.edit(NUDGE)
    assert opened.undo() == "move the goal" == opened.can_redo
    opened.edit(edits.move("start", (0.1, 0.0)))
    assert opened.can_redo is None


def test_a_change_on_the_disk_is_seen_and_reloaded_as_a_step(opened: OpenFile) -> None:
    assert opened.disk_state() is DiskState.SAME
    opened.path.write_text(opened.text.replace("1.65", "1.70"))
    assert opened.disk_state() is DiskState.CHANGED
    opened.reload()
    assert opened.disk_state() is DiskState.SAME
    assert "1.70" in opened.text
    assert not opened.is_changed
    opened.undo()
    assert "1.65" in opened.text
    assert opened.is_changed


def test_if_both_changed_saving_asks_and_keeps_the_edit(opened: OpenFile) -> None:
    opened.edit(NUDGE)
    theirs = opened.saved.replace("1.65", "1.70")
    opened.path.write_text(theirs)
    assert opened.disk_state() is DiskState.BOTH_CHANGED
    with pytest.raises(InputError, match="changed on the disk: reload it, or overwrite it"):
        opened.save()
    assert opened.path.read_text() == theirs
    assert opened.is_changed
    opened.save(overwrite=True)
    assert opened.path.read_text() == opened.text
    assert opened.disk_state() is DiskState.SAME


def test_the_same_text_saved_again_by_others_is_no_change(opened: OpenFile) -> None:
    opened.path.unlink()
    assert opened.disk_state() is DiskState.MISSING
    opened.path.write_text(opened.text)
    assert opened.disk_state() is DiskState.SAME


def test_a_file_that_is_no_yaml_any_more_loses_no_edit(opened: OpenFile) -> None:
    opened.edit(NUDGE)
    kept = opened.text
    opened.path.write_bytes(b"walls: [\xff")
    assert opened.disk_state() is DiskState.BOTH_CHANGED
    with pytest.raises(InputError):
        opened.reload()
    assert opened.text == kept
    assert opened.can_undo == "move the goal"


def test_a_failed_save_loses_neither_file_nor_edit(opened: OpenFile, monkeypatch: pytest.MonkeyPatch) -> None:
    opened.edit(NUDGE)

    def full(path: Path, data: bytes) -> None:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("dart_flight.lab.studio.open_file.replace_file", full)
    with pytest.raises(InputError, match="cannot write: No space left on device"):
        opened.save()
    assert opened.is_changed
    assert opened.path.read_text() == opened.saved


def test_a_new_file_is_unsaved_until_it_is_saved(tmp_path: Path) -> None:
    made = OpenFile.new(tmp_path / "made.yaml", DUAL.read_text())
    assert made.is_changed
    assert made.disk_state() is not DiskState.BOTH_CHANGED
    made.save()
    assert (tmp_path / "made.yaml").read_text() == DUAL.read_text()
    assert not made.is_changed


def test_windows_line_ends_and_hundreds_of_edits_stay(tmp_path: Path) -> None:
    path = tmp_path / "room.yaml"
    path.write_bytes(DUAL.read_bytes().replace(b"\n", b"\r\n"))
    opened = OpenFile.load(path)
    for i in range(300):
        opened.edit(edits.move("wall/acrylic", (1.6 + 0.001 * i, 0.0)))
    assert Document(opened.text, "").tree["walls"]["acrylic"]["point_m"] == [1.899, 0.0]
    while opened.undo():
        pass
    assert opened.text.encode() == path.read_bytes()


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("airframe: {mass_kg: 1.0}\n", "this is a vehicle configuration"),
        ("a: 1\n", "this is another file; the studio opens missions and scenarios"),
        ("walls: [\n", "not valid YAML"),
    ],
)
def test_another_file_is_refused_in_one_line(text: str, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=problem):
        OpenFile.load(path)
