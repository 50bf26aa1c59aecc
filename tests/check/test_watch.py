"""`check --watch`: every save repeats the check, an error keeps the last picture, Ctrl-C ends it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from dart_flight.cli import check_command, main
from dart_flight.config.document import noting_files, open_file, stamp_of

ROOT = Path(__file__).parents[2]


class Sleeper:
    """A sleep function that runs the next action at every call, and raises Ctrl-C after the last."""

    def __init__(self, *actions: Callable[[], object]) -> None:
        self._actions: Iterator[Callable[[], object]] = iter(actions)

    def __call__(self, seconds: float) -> None:
        action = next(self._actions, None)
        if action is None:
            raise KeyboardInterrupt
        action()


def idle() -> None:
    """Save nothing."""


def replace(path: Path, text: str) -> None:
    """Save like an editor that writes a new file."""
    new = path.with_suffix(".new")
    new.write_text(text)
    os.replace(new, path)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shutil.copytree(ROOT / "missions", tmp_path / "missions")
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    return tmp_path


def watch(monkeypatch: pytest.MonkeyPatch, folder: Path, *actions: Callable[[], object]) -> int:
    with monkeypatch.context() as patched:
        keep_checking = partial(check_command.keep_checking, sleep=Sleeper(*actions))
        patched.setattr(check_command, "keep_checking", keep_checking)
        return _watch(folder)


def _watch(folder: Path) -> int:
    mission = str(folder / "missions" / "paper_single_wall.yaml")
    return main(["check", mission, "--watch", "--plot", str(folder / "a.png")])


def test_every_save_repeats_the_check_and_an_error_keeps_the_picture(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mission, vehicle = folder / "missions" / "paper_single_wall.yaml", folder / "configs" / "dart.yaml"
    picture, good = folder / "a.png", mission.read_text()
    pictures: list[bytes] = []

    def keep_picture() -> None:
        pictures.append(picture.read_bytes())

    def type_half() -> None:
        keep_picture()
        mission.write_text("version: 1\nname: [")

    def restore_mission() -> None:
        keep_picture()
        replace(mission, good)

    def touch_vehicle() -> None:
        keep_picture()
        replace(vehicle, vehicle.read_text().replace("mass_kg: 1.3", "mass_kg: 1.5"))

    status = watch(
        monkeypatch,
        folder,
        idle,
        type_half,
        idle,  # one more look, to confirm that the file no longer changes
        touch_vehicle,  # another file is saved while the mission is wrong
        idle,
        restore_mission,
        idle,
        keep_picture,
    )
    output = capsys.readouterr().err
    assert status == 0
    assert output.count("watching ") == 4
    assert output.count("not valid YAML") == 2
    assert output.count("picture: ") == 2
    assert pictures[0] == pictures[1] == pictures[2]  # an error keeps the last valid picture
    assert pictures[3] != pictures[2]
    assert "dart.yaml, paper_single_wall.yaml" in output


def test_ctrl_c_ends_with_the_last_status(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mission = folder / "missions" / "paper_single_wall.yaml"
    wrong = mission.read_text().replace("version: 1", "version: 9")
    assert watch(monkeypatch, folder, lambda: mission.write_text(wrong), idle) == 2
    assert watch(monkeypatch, folder) == 2


def test_a_missing_file_is_awaited(tmp_path: Path) -> None:
    path, runs = tmp_path / "a.yaml", []

    def check() -> int:
        runs.append(path.exists())
        with open_file(path):
            return 0

    assert check_command.keep_checking(check, Sleeper(idle, lambda: path.write_text("a: 1"), idle)) == 0
    assert runs == [False, True]


def test_files_are_noted_with_their_stamp_from_before_the_read(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("a")
    before = stamp_of(path)
    with noting_files() as outer, noting_files() as inner, open_file(path):
        path.write_text("longer")
    with open_file(path):
        pass
    assert outer == inner == {path: before}
    assert stamp_of(path) != before


@pytest.mark.parametrize("option", [["--json"], ["--connection", "udpin://127.0.0.1:14999"]])
def test_watch_is_refused_with_json_and_with_a_connection(
    option: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", str(ROOT / "missions" / "paper_single_wall.yaml"), "--watch", *option]) == 2
    assert "--watch" in capsys.readouterr().err
