"""The stored last command of the lock, also after a crash."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from dart_flight.base.records import LockPhase, LockState, Mode
from dart_flight.config.document import InputError
from dart_flight.config.vehicle import LockDriver
from dart_flight.lock.persistence import CommandStore, delete_last, load_last


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "state"))
    return tmp_path / "state"


def state(phase: LockPhase, mode: Mode | None, feedback: bool = False) -> LockState:
    return LockState(t_us=5, phase=phase, mode=mode, commanded_us=1, feedback=feedback)


@pytest.mark.parametrize(
    ("states", "mode", "text"),
    [
        ([(LockPhase.TRAVELLING, Mode.RIGID)], Mode.RIGID, "arrival not confirmed"),
        (
            [(LockPhase.TRAVELLING, Mode.RIGID), (LockPhase.SETTLED, Mode.RIGID)],
            Mode.RIGID,
            "settled (no feedback)",
        ),
        ([(LockPhase.TRAVELLING, Mode.FLEXIBLE), (LockPhase.FAULT, None)], Mode.FLEXIBLE, "ended in a fault"),
    ],
)
def test_the_last_command_is_stored_with_its_end(
    folder: Path, states: list[tuple[LockPhase, Mode | None]], mode: Mode, text: str
) -> None:
    assert load_last() is None
    store = CommandStore(LockDriver.PWM)
    for phase, state_mode in states:
        store.store(state(phase, state_mode))
    last = load_last()
    assert last is not None
    assert (last.driver, last.mode, last.pid) == (LockDriver.PWM, mode, os.getpid())
    assert last.describe() == f"{mode} by pwm at {last.at_utc}, {text}"
    assert [path.name for path in folder.iterdir()] == ["last_command.json"]
    delete_last()
    delete_last()
    assert load_last() is None


def test_a_state_without_a_command_is_not_stored() -> None:
    store = CommandStore(LockDriver.PWM)
    store.store(LockState(t_us=1, phase=LockPhase.SETTLED, mode=Mode.RIGID))
    assert load_last() is None


@pytest.mark.parametrize(
    "content", [b"", b"{", b'{"mode": "soft"}', b"\xff\xfe", b"[]", b'{"mode": "\xff\xfe"}']
)
def test_a_damaged_record_is_ignored(folder: Path, content: bytes) -> None:
    folder.mkdir()
    (folder / "last_command.json").write_bytes(content)
    assert load_last() is None


def test_an_unreadable_record_is_an_error(folder: Path) -> None:
    (folder / "last_command.json").mkdir(parents=True)
    with pytest.raises(InputError, match="cannot read: Is a directory"):
        load_last()


def test_a_failed_write_is_reported_without_stopping_the_lock(folder: Path) -> None:
    store = CommandStore(LockDriver.PWM)
    (folder / "last_command.json" / "in the way").mkdir(parents=True)
    store.store(state(LockPhase.TRAVELLING, Mode.RIGID))
    assert "Is a directory" in (store.problem or "")
    assert [path.name for path in folder.iterdir()] == ["last_command.json"]
    shutil.rmtree(folder / "last_command.json")
    store.store(state(LockPhase.TRAVELLING, Mode.RIGID))
    assert store.problem is None


def test_an_unusable_state_folder_is_an_input_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "file" / "below"))
    with pytest.raises(InputError, match="DART_FLIGHT_STATE_DIR"):
        CommandStore(LockDriver.PWM)
