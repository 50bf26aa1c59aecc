"""Flight commands load no module of the lab, and a failure of the lab does not end a flight."""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from dart_flight import lab_entries, load_mission
from dart_flight.base.records import StatusText
from dart_flight.cli import COMMANDS, main
from dart_flight.cli.live_options import live_view

ROOT = Path(__file__).parents[1]
MISSION = str(ROOT / "missions" / "single_wall.yaml")
LOG = str(next((ROOT / "tests" / "data" / "flights").rglob("*.mcap")))
# Runs commands one after the other, and prints the status and the modules of the lab after each.
LOADED = """
import contextlib, io, json, sys
from dart_flight.cli import main
for words in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()):
        try:
            status = main(words)
        except SystemExit as end:
            status = end.code
    lab = [m for m in sys.modules if m.startswith("dart_flight.lab.")]
    print(json.dumps([words[0], status, lab]))
"""


def test_flight_commands_load_no_module_of_the_lab(tmp_path: Path) -> None:
    commands = [
        ["dry-run", MISSION, "--fast", "--json"],
        ["check", MISSION, "--json"],
        ["replay", LOG, "--json"],
        ["lock", "status", "--driver", "mock", "--json"],
        ["init", "here", "--json"],
        *([name, "--help"] for name in COMMANDS if name not in lab_entries.COMMANDS),
    ]
    words = [sys.executable, "-c", LOADED, json.dumps(commands)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    shown = [json.loads(line) for line in done.stdout.splitlines()]
    assert [name for name, _, _ in shown] == [words[0] for words in commands], done.stderr
    # Replay reports the omitted records of the kept log; `check` measures whether the computer is busy.
    expected = {"replay": {1}, "check": {0, 1}}
    for (name, status, lab), (_, *options) in zip(shown, commands, strict=True):
        assert lab == [], name
        assert status in (expected.get(name, {0}) if "--help" not in options else {0}), name


@pytest.mark.parametrize("name", [n for n in vars(lab_entries) if n.isupper() and n != "COMMANDS"])
def test_every_lab_entry_can_be_loaded(name: str) -> None:
    assert lab_entries.load_entry(getattr(lab_entries, name)) is not None


class BrokenView:
    """A view that opens but fails at the first record."""

    port = 1

    def __call__(self, record: object) -> None:
        raise RuntimeError("no more colours")

    def close(self) -> None:
        pass


@pytest.mark.parametrize("failing", ["opens", "draws"])
def test_a_failing_live_view_does_not_end_the_flight(
    failing: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def entry(_: str) -> object:
        if failing == "opens":
            raise ImportError("half an installation")
        return lambda *_: BrokenView()

    monkeypatch.setattr("dart_flight.cli.live_options.load_entry", entry)
    options = argparse.Namespace(live=True, live_host=None, live_port=None)
    with live_view(options, load_mission(MISSION)) as view:
        assert (view is None) == (failing == "opens")
        for t_us in range(3):
            if view is not None:
                view(StatusText(t_us, 0, "info", "a record"))
    printed = capsys.readouterr().err
    assert printed.count("the flight continues without it") == 1


def test_a_failing_picture_does_not_end_the_check(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("dart_flight.cli.mission_picture.load_entry", lambda _: 1 / 0)
    assert main(["check", MISSION, "--plot", str(tmp_path / "picture.png")]) == 0
    assert "no picture: ZeroDivisionError" in capsys.readouterr().err


def test_an_old_command_name_still_works(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["feel", "missing.ulg"]) == 2
    printed = capsys.readouterr().err
    assert "`feel` is now `inspect`" in printed
    assert "missing.ulg" in printed
