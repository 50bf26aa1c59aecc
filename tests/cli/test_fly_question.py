"""`fly` asks before it flies, and prints a NO-GO as JSON."""

from __future__ import annotations

import argparse
import io
import json
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from dart_flight.check.findings import CheckFinding
from dart_flight.cli.fly_command import fly_if_go
from dart_flight.cli.terminal import confirm
from dart_flight.run.prepare import load_flyable


class Terminal(io.StringIO):
    """A terminal with the operator's answers."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("answers", "flies"),
    [
        (Terminal("y\n"), True),
        (Terminal("Yes\n"), True),
        (Terminal("\n"), False),
        (Terminal(""), False),
        (io.StringIO("y\n"), False),  # no terminal
    ],
)
def test_only_a_yes_in_a_terminal_confirms_the_flight(
    answers: io.StringIO, flies: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", answers)
    assert confirm("Fly?") is flies


@pytest.mark.parametrize("as_json", [True, False])
def test_a_no_go_is_printed_as_json(as_json: bool, capsys: pytest.CaptureFixture[str]) -> None:
    mission = load_flyable(Path(__file__).parents[2] / "missions" / "hover.yaml")
    arguments = argparse.Namespace(json=as_json, overrule=[], yes=True)
    found = [CheckFinding("battery", False, "12.1 V")]
    assert fly_if_go(arguments, mission, "udpin://127.0.0.1:14999", Mock(), found) is None
    printed = capsys.readouterr().out
    if not as_json:
        assert printed == ""
        return
    report = json.loads(printed)
    assert (report["go"], report["findings"][0]["message"]) == (False, "12.1 V")
