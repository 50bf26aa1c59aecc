"""`fly` asks before it flies, and shows the mission to a person who wants to see it first."""

from __future__ import annotations

import io
import re
import sys
from pathlib import Path

import pytest

from dart_flight.cli.fly_command import confirm_flight
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged


class Terminal(io.StringIO):
    """A person's answers."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("answers", "flies"), [("y\n", True), ("p\ny\n", True), ("p\n\n", False), ("", False)]
)
def test_the_picture_is_one_of_the_answers(
    answers: str, flies: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mission = load_mission(packaged("missions", "paper_single_wall.yaml"))
    monkeypatch.setattr(sys, "stdin", Terminal(answers))
    assert confirm_flight(mission) is flies
    said = capsys.readouterr().err
    asked = said.count("Fly?")
    if answers.startswith("p"):
        assert asked == 2
        written = re.search(r"picture: (\S+\.png)", said)
        assert written is not None
        assert Path(written[1]).read_bytes().startswith(b"\x89PNG")
        Path(written[1]).unlink()
    else:
        assert asked == 1
        assert said == "Fly? [y/N, p: picture] "


def test_without_matplotlib_the_question_comes_again(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mission = load_mission(packaged("missions", "paper_single_wall.yaml"))
    monkeypatch.setattr(sys, "stdin", Terminal("p\ny\n"))
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert confirm_flight(mission)
    said = capsys.readouterr().err
    assert "pip install 'dart-flight[report]'" in said
    assert said.count("Fly?") == 2


def test_without_a_terminal_the_answer_is_no(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
    assert not confirm_flight(load_mission(packaged("missions", "paper_single_wall.yaml")))
