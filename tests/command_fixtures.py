"""Fixtures for tests of commands: a working folder, the program's answers, its refusals, and typed lines."""

from __future__ import annotations

import io
import json
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from dart_flight.cli import main

Refuse = Callable[..., str]
RunJson = Callable[..., tuple[Any, str]]
Type = Callable[[str], None]
_ALARM_S = 20.0  # on a loaded machine; a refusal takes 2 s on an idle one


def exit_status(*words: object) -> int:
    """Return the exit status of a command, which argparse may end by itself."""
    try:
        return main([str(word) for word in words])
    except SystemExit as end:
        return int(str(end.code))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder, without a configuration or a state from elsewhere."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DART_FLIGHT_CONFIG", raising=False)
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "state"))
    return tmp_path


@pytest.fixture
def refusal_of(capsys: pytest.CaptureFixture[str]) -> Refuse:
    """Run a command that must be refused with status 2 and nothing but one line; return this line."""

    def refusal_of(*words: object) -> str:
        capsys.readouterr()
        status = exit_status(*words)
        out, err = capsys.readouterr()
        lines = [line for line in err.splitlines() if not line.startswith("vehicle: ")]
        assert (status, out, len(lines)) == (2, "", 1), err
        return lines[0]

    return refusal_of


@pytest.fixture
def run_json(capsys: pytest.CaptureFixture[str]) -> RunJson:
    """Run a command with --json; return what it prints and its messages."""

    def run_json(*words: object, status: int = 0) -> tuple[Any, str]:
        capsys.readouterr()
        assert exit_status(*words, "--json") == status
        out, err = capsys.readouterr()
        return json.loads(out), err

    return run_json


@pytest.fixture
def type_lines(monkeypatch: pytest.MonkeyPatch) -> Type:
    """Put lines on standard input, which is no terminal."""
    return lambda typed: monkeypatch.setattr(sys, "stdin", io.StringIO(typed))


@pytest.fixture
def alarm() -> Iterator[None]:
    """Turn a hang into an error."""

    def on_timeout(number: int, frame: FrameType | None) -> None:
        raise AssertionError(f"still running after {_ALARM_S:g} s")

    before = signal.signal(signal.SIGALRM, on_timeout)
    signal.setitimer(signal.ITIMER_REAL, _ALARM_S)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, before)
