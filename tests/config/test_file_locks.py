"""File locks: only a lock of another holder counts as held; every other refusal is reported."""

from __future__ import annotations

import errno
import fcntl
import os
import pty
from pathlib import Path

import pytest

from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.config.held_files import HeldError, HeldFile, read_held
from dart_flight.config.vehicle import packaged
from dart_flight.lab.campaign.table import Table
from dart_flight.vehicle import link
from dart_flight.vehicle.link import LinkInUseError, LinkLease, acquire_free_link

MISSION = str(packaged("missions", "single_wall.yaml"))
REFUSALS = [errno.ENOLCK, errno.ENOSYS, errno.EIO, errno.ESTALE]


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "state"))
    return tmp_path / "state"


def _refuse(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def flock(descriptor: int, operation: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)


@pytest.fixture(params=REFUSALS, ids=[errno.errorcode[number] for number in REFUSALS])
def refusal(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Make the file system refuse every lock; return the text of its error."""
    _refuse(monkeypatch, request.param)
    return os.strerror(request.param)


def test_a_refused_lock_is_not_reported_as_held(tmp_path: Path, refusal: str) -> None:
    file = HeldFile(tmp_path / "lock.pid")
    with pytest.raises(
        InputError, match=f"cannot lock {tmp_path}/lock.pid: {refusal}; set DART_FLIGHT_STATE"
    ):
        file.acquire(b"1")
    with pytest.raises(InputError, match=refusal):
        read_held(tmp_path / "lock.pid")


def test_a_lock_of_another_holder_is_reported_as_held(tmp_path: Path) -> None:
    path = tmp_path / "lock.pid"
    first, second = HeldFile(path), HeldFile(path)
    first.acquire(b"first")
    with pytest.raises(HeldError) as held:
        second.acquire(b"second")
    assert held.value.content == read_held(path) == b"first"
    first.release()
    assert read_held(path) is None
    second.acquire(b"second")
    second.release()


def test_the_search_for_a_free_link_ends_if_locks_are_refused(refusal: str) -> None:
    with pytest.raises(InputError, match=refusal) as error:
        acquire_free_link("dry-run")
    assert not isinstance(error.value, LinkInUseError)


def test_the_search_for_a_free_link_ends_if_every_port_is_in_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link, "udp_port_is_free", lambda *_: False)
    with pytest.raises(LinkInUseError, match="in use"):
        acquire_free_link("dry-run")


def test_a_serial_device_that_cannot_be_locked_is_not_reported_as_in_use(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, terminal = pty.openpty()
    flock = fcntl.flock

    def refuse_terminals(descriptor: int, operation: int) -> None:
        if os.isatty(descriptor):
            raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
        flock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", refuse_terminals)
    lease = LinkLease(f"serial://{os.ttyname(terminal)}:57600", "fly")
    with pytest.raises(InputError, match=f"cannot lock {os.ttyname(terminal)}: Function not") as error:
        lease.acquire()
    assert not isinstance(error.value, LinkInUseError)


def test_a_campaign_table_that_cannot_be_locked_is_refused_with_the_reason(
    tmp_path: Path, refusal: str
) -> None:
    with pytest.raises(InputError, match=f"cannot lock .*flights.csv: {refusal}; set --out to a local disk"):
        Table(tmp_path / "flights.csv", ["mission"])


COMMANDS = {
    "dry-run": ["dry-run", MISSION, "--log-dir", "flights"],
    "campaign": ["campaign", MISSION, "--runs", "1", "--out", "campaign"],
    "simulate": ["simulate", MISSION],
    "check": ["check", MISSION, "--connection", "udpin://127.0.0.1:24540"],
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_that_cannot_lock_ends_with_one_line(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    _refuse(monkeypatch, errno.ENOLCK)
    assert main(COMMANDS[command]) == 2
    output = capsys.readouterr()
    last = output.err.strip().splitlines()[-1]
    assert last.startswith("cannot lock ")
    assert "No locks available; set " in last
    assert "in use" not in output.err
    assert "written by another" not in output.err


def test_a_state_folder_on_a_full_disk_is_reported_in_one_line(
    state: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(descriptor: int, data: bytes, offset: int) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", full)
    assert main(COMMANDS["check"]) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith(f"{state}/links/udp-24540@")
    assert last.endswith(": cannot write: No space left on device; set DART_FLIGHT_STATE_DIR to a local disk")
    monkeypatch.undo()
    assert list((state / "links").iterdir()) == []


def test_a_lock_file_that_cannot_be_removed_does_not_end_a_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read_only(self: Path, missing_ok: bool = False) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    file = HeldFile(tmp_path / "lock.pid")
    file.acquire(b"1")
    monkeypatch.setattr(Path, "unlink", read_only)
    file.release()
    assert read_held(tmp_path / "lock.pid") is None


def test_a_lock_file_that_cannot_be_read_is_not_reported_as_in_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with monkeypatch.context() as broken:
        broken.setattr(os.path, "samestat", refuse)
        with pytest.raises(InputError, match="held: cannot read: Input/output error"):
            HeldFile(tmp_path / "held").acquire(b"mine")
    HeldFile(tmp_path / "held").acquire(b"mine")
