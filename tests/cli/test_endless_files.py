"""Special files and oversized files: every command refuses them before reading."""

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
    """Turn a hang into an error."""

    def on_timeout(number: int, frame: FrameType | None) -> None:
        raise AssertionError("still reading after 10 s")

    before = signal.signal(signal.SIGALRM, on_timeout)
    signal.alarm(10)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def refusal_of(command: str, path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Return the one line with which a command refuses a file."""
    arguments = []
    for word in COMMANDS[command]:
        if word.startswith("FILE."):
            link = path.parent / f"link{word[4:]}"
            link.symlink_to(path)
            word = str(link)
        arguments.append({"FILE": str(path), "OUT": str(path.parent / "out")}.get(word, word))
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    return err


@pytest.mark.parametrize("command", COMMANDS)
def test_a_pipe_does_not_block_a_command(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    assert "a pipe, expected a regular file" in refusal_of(command, pipe, capsys)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("device", ["/dev/zero", "/dev/urandom"])
def test_a_device_does_not_fill_the_memory(
    command: str, device: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    link = tmp_path / "device"
    link.symlink_to(device)
    assert "a device, expected a regular file" in refusal_of(command, link, capsys)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_size_is_checked_before_reading(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    large = tmp_path / "large"
    with large.open("wb") as file:
        file.truncate(MAX_LOG_BYTES + 1)  # sparse
    assert "larger than" in refusal_of(command, large, capsys)
