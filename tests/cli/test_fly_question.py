"""`fly` asks before it flies."""

from __future__ import annotations

import io
import sys

import pytest

from dart_flight.cli.terminal import confirm


class Terminal(io.StringIO):
    """A person's answers."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("answer", "flies"), [("y\n", True), ("Yes\n", True), ("\n", False), ("", False)])
def test_only_a_yes_flies(answer: str, flies: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", Terminal(answer))
    assert confirm("Fly?") is flies


def test_without_a_terminal_the_answer_is_no(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
    assert not confirm("Fly?")
