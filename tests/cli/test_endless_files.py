"""Special files and oversized files: every command refuses them before reading."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from dart_flight.config.document import MAX_LOG_BYTES
from tests.command_fixtures import Refuse

pytestmark = pytest.mark.usefixtures("alarm")

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


def words_of(command: str, path: Path) -> list[str]:
    """Return the words of a command with a file."""
    arguments = []
    for word in COMMANDS[command]:
        if word.startswith("FILE."):
            link = path.parent / f"link{word[4:]}"
            link.symlink_to(path)
            word = str(link)
        arguments.append({"FILE": str(path), "OUT": str(path.parent / "out")}.get(word, word))
    return arguments


@pytest.mark.parametrize("command", COMMANDS)
def test_a_pipe_does_not_block_a_command(command: str, tmp_path: Path, refusal_of: Refuse) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    assert "a pipe, expected a regular file" in refusal_of(*words_of(command, pipe))


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("device", ["/dev/zero", "/dev/urandom"])
def test_a_device_does_not_fill_the_memory(
    command: str, device: str, tmp_path: Path, refusal_of: Refuse
) -> None:
    link = tmp_path / "device"
    link.symlink_to(device)
    assert "a device, expected a regular file" in refusal_of(*words_of(command, link))


@pytest.mark.parametrize("command", COMMANDS)
def test_the_size_is_checked_before_reading(command: str, tmp_path: Path, refusal_of: Refuse) -> None:
    large = tmp_path / "large"
    with large.open("wb") as file:
        file.truncate(MAX_LOG_BYTES + 1)  # sparse
    assert "larger than" in refusal_of(*words_of(command, large))
