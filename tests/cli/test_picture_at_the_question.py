"""`fly` asks before it flies, and shows the mission to a person who wants to see it first."""

from __future__ import annotations

import io
import re
import sys
from pathlib import Path

import pytest
from rich.console import Console

from dart_flight.cli.fly_command import confirmed
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
    mission = load_mission(packaged("missions", "single_wall.yaml"))
    monkeypatch.setattr(sys, "stdin", Terminal(answers))
    said = io.StringIO()
    assert confirmed(mission, Console(file=said, width=200)) is flies
    asked = capsys.readouterr().err.count("Fly?")
    if answers.startswith("p"):
        assert asked == 2
        written = re.search(r"picture: (\S+\.png)", said.getvalue())
        assert written is not None
        assert Path(written[1]).read_bytes().startswith(b"\x89PNG")
        Path(written[1]).unlink()
    else:
        assert asked == 1
        assert said.getvalue() == ""


def test_without_matplotlib_the_question_comes_again(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mission = load_mission(packaged("missions", "single_wall.yaml"))
    monkeypatch.setattr(sys, "stdin", Terminal("p\ny\n"))
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    said = io.StringIO()
    assert confirmed(mission, Console(file=said, width=200))
    assert "pip install 'dart-flight[report]'" in said.getvalue()
    assert capsys.readouterr().err.count("Fly?") == 2


def test_without_a_terminal_the_answer_is_no(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
    assert not confirmed(load_mission(packaged("missions", "single_wall.yaml")), Console(file=io.StringIO()))
