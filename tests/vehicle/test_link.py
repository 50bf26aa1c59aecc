"""Exclusive use of a link: leases between processes, foreign programs, serial devices."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import termios
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.config.link_url import endpoint_of
from dart_flight.config.vehicle import packaged
from dart_flight.vehicle.link import (
    LinkInUseError,
    LinkLease,
    acquire_free_link,
    find_holder,
    held_links,
    udp_port_is_free,
)
from tests.doubles.other_process import running
from tests.doubles.ports import free_udp_port

MISSION = str(packaged("missions", "paper_single_wall.yaml"))
HOLD = """
import sys
from pathlib import Path
from dart_flight.vehicle.link import LinkLease
lease = LinkLease(sys.argv[1], "fly", Path(sys.argv[2]))
lease.acquire()
"""
# MAVSDK and ground stations open a port like this, so that others may share it.
LISTEN = """
import socket, sys
s = socket.socket(type=socket.SOCK_DGRAM)
s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
s.bind(("127.0.0.1", int(sys.argv[1])))
"""
# pyserial does the same with exclusive=True.
LOCK = "import fcntl, os, sys; fcntl.flock(os.open(sys.argv[1], os.O_RDWR), fcntl.LOCK_EX | fcntl.LOCK_NB)"


@pytest.fixture(autouse=True)
def _own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "state"))


@pytest.fixture
def port() -> int:
    return free_udp_port()


@pytest.fixture
def url(port: int) -> str:
    return f"udpin://0.0.0.0:{port}"


@pytest.fixture
def holding_process(url: str, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds the link, as a flight does."""
    with running(HOLD, url, str(tmp_path / "flight.mcap")) as process:
        yield process


def test_different_urls_of_one_endpoint_have_the_same_key(tmp_path: Path) -> None:
    device = tmp_path / "ttyTest"
    device.touch()
    (tmp_path / "serial0").symlink_to(device)
    assert endpoint_of(f"serial://{device}:921600") == endpoint_of(f"serial://{tmp_path}/serial0:57600")
    assert endpoint_of("udpin://0.0.0.0:14540").key == endpoint_of("udpin://127.0.0.1:14540").key
    assert endpoint_of("udp://:14540").udp_port == 14540
    assert endpoint_of("udpin://0.0.0.0:14540").key != endpoint_of("udpin://0.0.0.0:14541").key
    assert endpoint_of("udpout://10.0.0.1:14540").udp_port is None


def test_the_program_that_holds_a_link_is_named(
    holding_process: subprocess.Popen[str], url: str, tmp_path: Path
) -> None:
    with pytest.raises(LinkInUseError) as caught:
        LinkLease(url.replace("0.0.0.0", "127.0.0.1"), "monitor").acquire()
    assert caught.value.message == f"in use by fly, process {holding_process.pid}"
    holder = find_holder(url)
    assert holder is not None
    assert (holder.pid, holder.log) == (holding_process.pid, str(tmp_path / "flight.mcap"))
    assert [lease.pid for lease in held_links()] == [holding_process.pid]


def test_a_link_is_free_again_after_its_program_was_killed(
    holding_process: subprocess.Popen[str], url: str
) -> None:
    holding_process.send_signal(signal.SIGKILL)
    holding_process.wait()
    assert find_holder(url) is None
    with LinkLease(url, "check"):
        assert find_holder(url) is not None
    assert list(held_links()) == []


def test_two_leases_in_one_program_exclude_each_other(url: str) -> None:
    with LinkLease(url, "fly"), pytest.raises(LinkInUseError, match="in use by fly"):
        LinkLease(url, "check").acquire()


@pytest.mark.parametrize(
    "command",
    [
        ["fly", MISSION, "--yes"],
        ["check", MISSION],
        ["monitor", "--seconds", "1"],
        ["lock", "status", "--driver", "px4"],
        ["plan", str(packaged("missions", "scenarios", "one_wall.yaml"))],
    ],
    ids=lambda command: command[0],
)
def test_every_command_on_a_link_in_use_is_refused_in_one_line(
    holding_process: subprocess.Popen[str], url: str, command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, "--connection", url]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "in use" in line]
    assert f"in use by fly, process {holding_process.pid}" in line


@pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid"])
def test_a_port_that_cannot_be_bound_is_not_reported_as_free(host: str, port: int) -> None:
    with pytest.raises(InputError, match=rf"cannot open UDP port {host}:{port}: "):
        udp_port_is_free(port, host)


def test_a_foreign_program_on_the_port_is_named(port: int, url: str) -> None:
    with running(LISTEN, str(port)) as other:
        assert not udp_port_is_free(port)
        with pytest.raises(
            LinkInUseError, match=rf"UDP port {port} is in use by python.*, process {other.pid}"
        ):
            LinkLease(url, "fly").acquire()
    with LinkLease(url, "fly"):
        pass


def test_two_acquired_free_links_differ() -> None:
    (one, first), (two, second) = acquire_free_link("dry-run"), acquire_free_link("dry-run")
    first.release()
    second.release()
    assert one != two


# --- serial -----------------------------------------------------------------------------------------------


@pytest.fixture
def device() -> Iterator[str]:
    """The path of a serial device that no program has open."""
    master, slave = pty.openpty()
    name = os.ttyname(slave)
    os.close(slave)
    yield name
    os.close(master)


def test_a_serial_device_that_another_program_has_open_is_refused(device: str) -> None:
    with (
        running("import sys; f = open(sys.argv[1], 'rb', 0)", device) as reader,
        pytest.raises(LinkInUseError, match=f"{device} is in use by python.*, process {reader.pid}"),
    ):
        LinkLease(f"serial://{device}:921600", "fly").acquire()


def test_a_serial_device_is_locked_against_programs_with_other_state_folders(device: str) -> None:
    url = f"serial://{device}:57600"
    with LinkLease(url, "fly") as lease:
        lease.lock_device()
        done = subprocess.run([sys.executable, "-c", LOCK, device], capture_output=True, check=False)
        assert done.returncode != 0
        other_environment = {**os.environ, "DART_FLIGHT_STATE_DIR": os.environ["DART_FLIGHT_STATE_DIR"] + "2"}
        command = [sys.executable, "-m", "dart_flight", "check", MISSION, "--connection", url]
        checked = subprocess.run(command, env=other_environment, capture_output=True, text=True, check=False)
        assert checked.returncode == 2
        assert f"{device} is in use by" in checked.stderr
        assert f"process {os.getpid()}" in checked.stderr
        assert len(checked.stderr.splitlines()) == 1
    with LinkLease(url, "fly"):
        pass


def test_an_empty_serial_read_blocks_once_the_device_is_locked(device: str) -> None:
    """MAVSDK sets VMIN 0, with which its thread would poll without end and occupy a whole core."""
    with LinkLease(f"serial://{device}:57600", "fly") as lease:
        mavsdk_descriptor = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(mavsdk_descriptor)
        settings = termios.tcgetattr(mavsdk_descriptor)
        settings[6][termios.VMIN] = 0
        termios.tcsetattr(mavsdk_descriptor, termios.TCSANOW, settings)
        assert os.read(mavsdk_descriptor, 1) == b""
        lease.lock_device()
        with pytest.raises(BlockingIOError):
            os.read(mavsdk_descriptor, 1)
        os.close(mavsdk_descriptor)


def test_a_missing_serial_device_is_reported() -> None:
    with pytest.raises(InputError, match="this serial device does not exist"):
        LinkLease("serial:///dev/ttyNone9:57600", "fly").acquire()
