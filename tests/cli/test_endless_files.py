"""What is no regular file, or too large, is refused before it is read, by every command that reads one."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

import pytest

from dart_flight.cli import main
from dart_flight.config.document import MAX_LOG_BYTES

COMMANDS = {
    "fly": ["fly", "FILE", "--yes"],
    "dry-run": ["dry-run", "FILE"],
    "campaign": ["campaign", "FILE", "--runs", "1", "--out", "OUT"],
    "simulate": ["simulate", "FILE"],
    "check": ["check", "FILE"],
    "plan": ["plan", "FILE"],
    "replay": ["replay", "FILE"],
    "report": ["report", "FILE"],
    "export": ["export", "FILE"],
    "configuration": ["check", "missions/hover.yaml", "--config", "FILE"],
    "batch": ["predict", "--surface", "wood", "--batch", "FILE"],
    "thrust": ["calibrate", "thrust", "FILE"],
    "thrust of a ULog": ["calibrate", "thrust", "FILE.ulg"],
    "inertia": ["calibrate", "inertia", "FILE"],
    "airframe": ["calibrate", "airframe", "FILE"],
    "inspect": ["inspect", "FILE"],
    "trial": ["identify", "FILE.csv"],
    "trial of a ULog": ["identify", "FILE.ulg", "--drop"],
    "trial of a flight": ["identify", "FILE.mcap"],
}


@pytest.fixture(autouse=True)
def alarm() -> Iterator[None]:
    """A hang ends as an error."""

    def late(number: int, frame: FrameType | None) -> None:
        raise AssertionError("still reading after 10 s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(10)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def refused(command: str, path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that a command says of a file."""
    given = []
    for word in COMMANDS[command]:
        if word.startswith("FILE."):
            link = path.parent / f"link{word[4:]}"
            link.symlink_to(path)
            word = str(link)
        given.append({"FILE": str(path), "OUT": str(path.parent / "out")}.get(word, word))
    assert main(given) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    return err


@pytest.mark.parametrize("command", COMMANDS)
def test_a_pipe_does_not_hang(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    assert "a pipe, expected a regular file" in refused(command, pipe, capsys)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("device", ["/dev/zero", "/dev/urandom"])
def test_a_device_does_not_fill_the_memory(
    command: str, device: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    link = tmp_path / "device"
    link.symlink_to(device)
    assert "a device, expected a regular file" in refused(command, link, capsys)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_size_is_looked_at_before_reading(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    large = tmp_path / "large"
    with large.open("wb") as file:
        file.truncate(MAX_LOG_BYTES + 1)  # sparse
    assert "larger than" in refused(command, large, capsys)
