"""Tests of the deadman: it kills a hanging program and no other; flights are measured on the wire."""

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dart_flight.run.deadman import Deadman, SystemdNotice
from tests.faults.deadman_flights import FAULTS, last_setpoint_s
from tests.real_time import assert_below

ROOT = Path(__file__).parents[2]
STARVE_S = 0.3

PROGRAM = """
import sys, time
from pathlib import Path
from dart_flight.run.deadman import CORE, LOOP, Deadman
deadman = Deadman({starve}, Path(sys.argv[1]))
deadman.arm()
print(time.monotonic(), deadman.pid, flush=True)
{body}
"""


STARTED: list[subprocess.Popen[str]] = []


def start_program(body: str, note: Path) -> subprocess.Popen[str]:
    """Start a process that arms a deadman and then executes `body`."""
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM.format(starve=STARVE_S, body=textwrap.dedent(body)), str(note)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    STARTED.append(process)
    return process


@pytest.fixture(autouse=True)
def _end_all_programs() -> Iterator[None]:
    """Kill every started program, because a hanging one that its deadman spares would never end."""
    yield
    while STARTED:
        process = STARTED.pop()
        process.kill()
        process.communicate()


FEED_BOTH = "deadman.feed(CORE); deadman.feed(LOOP); time.sleep(0.02)"


@pytest.mark.parametrize(
    ("body", "starving"),
    [
        ("while True: deadman.feed(LOOP); time.sleep(0.02)", "core thread"),
        *(
            pytest.param(body, starving, marks=pytest.mark.rest)
            for body, starving in (
                ("while True: deadman.feed(CORE); time.sleep(0.02)", "event loop"),
                ("import ctypes; ctypes.PyDLL(None).sleep(20)", "core thread and event loop"),
                ("import os, signal; os.kill(os.getpid(), signal.SIGSTOP)", "core thread and event loop"),
            )
        ),
    ],
    ids=["core", "loop", "interpreter lock", "SIGSTOP"],
)
def test_a_starving_program_is_killed_in_time(body: str, starving: str, tmp_path: Path) -> None:
    note = tmp_path / "deadman.txt"
    process = start_program(body, note)
    assert process.stdout is not None
    began = float(process.stdout.readline().split()[0])
    assert process.wait(10) == -signal.SIGKILL
    assert time.monotonic() - began > 0.9 * STARVE_S
    silence = re.search(f"deadman: {starving} silent for ([0-9.]+) s", note.read_text())
    assert silence is not None
    # Generous for a loaded machine; the precise limit is tested on the wire, below.
    assert STARVE_S <= float(silence[1]) < STARVE_S + 1.0
    assert process.stderr is not None
    assert note.read_text() in process.stderr.read(), "the terminal shows the note"


@pytest.mark.rest
def test_a_feeding_program_ends_normally(tmp_path: Path) -> None:
    note = tmp_path / "deadman.txt"
    process = start_program(f"for _ in range(50): {FEED_BOTH}\ndeadman.disarm(); time.sleep(0.6)", note)
    assert process.wait(15) == 0
    assert not note.exists()


@pytest.mark.rest
def test_a_paused_watcher_does_not_kill_a_feeding_program(tmp_path: Path) -> None:
    process = start_program(f"for _ in range(100): {FEED_BOTH}\ndeadman.disarm()", tmp_path / "note")
    assert process.stdout is not None
    watcher = int(process.stdout.readline().split()[1])
    os.kill(watcher, signal.SIGSTOP)
    time.sleep(2 * STARVE_S)
    os.kill(watcher, signal.SIGCONT)
    assert process.wait(15) == 0


@pytest.mark.parametrize(("starve_s", "period_s"), [(0.3, 0.06), (0.5, 0.1), (5.0, 0.1)])
def test_the_feed_period_is_a_fifth_of_the_timeout_and_at_most_100_ms(
    starve_s: float, period_s: float
) -> None:
    deadman = Deadman(starve_s)
    try:
        assert deadman.feed_period_s == pytest.approx(period_s)
    finally:
        deadman.disarm()


@pytest.mark.rest
def test_the_watcher_uses_little_processor_time(tmp_path: Path) -> None:
    body = f"""
    import os
    def processor_s():
        fields = Path(f"/proc/{{deadman.pid}}/stat").read_text().split()
        return (int(fields[13]) + int(fields[14])) / os.sysconf("SC_CLK_TCK")
    for _ in range(15): {FEED_BOTH}
    before_s = processor_s()
    for _ in range(100): {FEED_BOTH}
    assert processor_s() - before_s < 0.15
    """
    process = start_program(body, tmp_path / "note")
    _, error = process.communicate(timeout=30)
    assert process.returncode == 0, error


@pytest.mark.rest
def test_termination_signals_do_not_end_the_watcher(tmp_path: Path) -> None:
    """The program handles Ctrl-C and a dropped terminal itself, and may hang while doing so."""
    body = f"""
    import os, re, signal
    SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    for _ in range(1500):
        {FEED_BOTH}
        ignored = re.search("SigIgn:\\s*(\\w+)", Path(f"/proc/{{deadman.pid}}/status").read_text())[1]
        if all(int(ignored, 16) >> (number - 1) & 1 for number in SIGNALS):
            break  # the watcher has started
    for number in SIGNALS:
        os.kill(deadman.pid, number)
    for _ in range(20): {FEED_BOTH}
    assert deadman._process.poll() is None
    os.kill(os.getpid(), signal.SIGSTOP)
    """
    note = tmp_path / "note"
    assert start_program(body, note).wait(40) == -signal.SIGKILL
    assert "silent" in note.read_text()


@pytest.mark.rest
def test_a_watcher_that_does_not_read_does_not_block_the_program(tmp_path: Path) -> None:
    body = """
    import os, signal
    os.kill(deadman.pid, signal.SIGSTOP)
    deadman.feed_period_s = 0.0
    for _ in range(50000): deadman.feed(CORE)
    os.kill(deadman.pid, signal.SIGKILL)
    """
    assert start_program(body, tmp_path / "note").wait(15) == 0


@pytest.mark.rest
def test_disarming_leaves_no_process_and_no_handle(tmp_path: Path) -> None:
    """A program may fly several missions, each with a new deadman."""
    body = f"""
    import os
    {FEED_BOTH}
    deadman.disarm()
    assert not os.path.exists(f"/proc/{{deadman.pid}}")
    handles = [os.readlink(f"/proc/self/fd/{{n}}") for n in os.listdir("/proc/self/fd") if n.isdigit()
               and os.path.islink(f"/proc/self/fd/{{n}}")]
    assert not [handle for handle in handles if "pidfd" in handle]
    deadman.feed(CORE); deadman.feed(LOOP)  # a thread that ends later may still feed
    """
    process = start_program(body, tmp_path / "note")
    _, error = process.communicate(timeout=15)
    assert process.returncode == 0, error


@pytest.mark.rest
def test_a_dead_watcher_is_replaced(tmp_path: Path) -> None:
    body = f"""
    import os, signal
    os.kill(deadman.pid, signal.SIGKILL)
    time.sleep(0.1)
    for _ in range(20):
        {FEED_BOTH}
        deadman.restart_if_dead()
    time.sleep(20)
    """
    note = tmp_path / "note"
    assert start_program(body, note).wait(15) == -signal.SIGKILL
    assert "silent" in note.read_text()


def test_systemd_is_notified(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.settimeout(1.0)
        notice = SystemdNotice({"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "400000"})
        notice.ready("flying")
        assert listener.recv(100) == b"READY=1\nSTATUS=flying"
        for _ in range(5):
            notice.alive()
        assert listener.recv(100) == b"WATCHDOG=1"
        listener.setblocking(False)
        with pytest.raises(BlockingIOError):
            listener.recv(100)  # the watchdog is fed at half its period, not at every call
        notice.stopping()
        assert listener.recv(100) == b"STOPPING=1"
    SystemdNotice({}).alive()  # must not raise without systemd


@pytest.mark.parametrize(
    ("variables", "is_fed"),
    [
        ({}, False),
        ({"WATCHDOG_USEC": "10000000"}, True),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": str(os.getpid())}, True),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "1"}, False),  # another process feeds this watchdog
        ({"WATCHDOG_USEC": "soon"}, False),
    ],
)
def test_the_systemd_watchdog_is_fed_if_it_expects_this_process(
    variables: dict[str, str], is_fed: bool, tmp_path: Path
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.setblocking(False)
        notice = SystemdNotice({"NOTIFY_SOCKET": str(tmp_path / "notify"), **variables})
        notice.alive()
        with contextlib.nullcontext() if is_fed else pytest.raises(BlockingIOError):
            assert listener.recv(100) == b"WATCHDOG=1"


def test_a_full_systemd_socket_does_not_block_the_program(tmp_path: Path) -> None:
    """The event loop sends the notices, and setpoints must not wait for them."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        notice = SystemdNotice({"NOTIFY_SOCKET": str(tmp_path / "notify")})

        def notify() -> None:
            for _ in range(2000):
                notice.stopping()

        notifier = threading.Thread(target=notify, daemon=True)
        notifier.start()
        notifier.join(10.0)
        assert not notifier.is_alive()


def test_systemd_is_notified_at_an_abstract_address() -> None:
    name = f"dart-flight-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(f"\0{name}")
        listener.settimeout(1.0)
        SystemdNotice({"NOTIFY_SOCKET": f"@{name}"}).stopping()
        assert listener.recv(100) == b"STOPPING=1"
    SystemdNotice({"NOTIFY_SOCKET": "vsock:2:1"}).stopping()  # an unknown kind of address must not raise


def test_flight_code_never_reads_the_time_of_day() -> None:
    """Jumps of the host's clock cannot affect code that never reads it."""
    package = ROOT / "dart_flight"
    for folder in (
        "core",
        "vehicle",
        "lock/drivers",
        "lock/lock_session.py",
        "run/deadman.py",
        "run/app.py",
        "run/core_thread.py",
    ):
        path = package / folder
        for file in [path] if path.is_file() else path.rglob("*.py"):
            assert not re.search(
                r"\btime\.time\(|time_ns\(\)(?<!monotonic_ns\(\))|\.(now|utcnow|today)\(", file.read_text()
            ), file


# --- in flight ---------------------------------------------------------------------------------------------


@pytest.mark.realtime
@pytest.mark.mavlink
@pytest.mark.parametrize("fault", FAULTS)
def test_setpoints_stop_on_the_wire_within_half_a_second(fault: str, tmp_path: Path) -> None:
    assert_below(0.5, last_setpoint_s(fault, tmp_path), "last setpoint after the fault, s")
