"""One vehicle, one program: what happens on a link that a flight has, in processes as people start them."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from tests.doubles.ports import free_udp_port
from tests.shared_flights import patient

ROOT = Path(__file__).parents[2]
SINGLE = "missions/paper_single_wall.yaml"


class Commands:
    """dart-flight in processes that share one state folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.config = folder / "dart.yaml"
        self.config.write_text(patient((ROOT / "configs/dart.yaml").read_text()))
        self._environment = {**os.environ, "DART_FLIGHT_STATE_DIR": str(folder / "state")}
        self._started: list[subprocess.Popen[str]] = []

    def start(self, *words: str) -> subprocess.Popen[str]:
        """Start one, output kept for `communicate`."""
        process = subprocess.Popen(
            [sys.executable, "-m", "dart_flight", *words],
            cwd=ROOT,
            env=self._environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._started.append(process)
        return process

    def second_vehicle(self, port: int, system: int, ahead_s: float) -> None:
        """Another vehicle begins to send to the port."""
        words = ["tests.doubles.second_sender", str(port), str(system), str(ahead_s)]
        self._started.append(
            subprocess.Popen([sys.executable, "-m", *words], cwd=ROOT, stderr=subprocess.PIPE, text=True)
        )

    def fly(self, port: int) -> subprocess.Popen[str]:
        """`simulate` on the port, and `fly` with it."""
        self.start("simulate", SINGLE, "--port", str(port))
        wait_until_it_sends(port)
        return self.start(
            "fly", SINGLE, "--config", str(self.config), "--connection", f"udpin://127.0.0.1:{port}",
            "--driver", "px4", "--yes", "--json", "--log-dir", str(self.folder / "flights"),
        )  # fmt: skip

    def run(self, *words: str) -> tuple[int, str]:
        """Run one to its end; returns status and what it says on standard error."""
        _, error = self.start(*words).communicate(timeout=60.0)
        return self._started[-1].returncode, error

    def end(self) -> None:
        """Stop what still runs."""
        for process in self._started:
            with contextlib.suppress(ProcessLookupError):
                process.terminate()
        for process in self._started:
            process.communicate(timeout=40.0)


@pytest.fixture
def commands(tmp_path: Path) -> Iterator[Commands]:
    started = Commands(tmp_path)
    yield started
    started.end()


def wait_until_it_sends(port: int) -> None:
    """Until a datagram arrives; the port is free again afterwards."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", port))
        ear.settimeout(20.0)
        ear.recv(65536)


def test_a_second_simulated_vehicle_on_a_port_is_refused_and_names_the_first(commands: Commands) -> None:
    port = free_udp_port()
    first = commands.start("simulate", "--port", str(port))
    wait_until_it_sends(port)
    status, error = commands.run("simulate", "--port", str(port))
    assert status == 2
    assert error.splitlines()[-1:] == [
        f"UDP port {port}: another vehicle already sends to this port: "
        f"in use by simulate, process {first.pid}"
    ]


def test_any_other_sender_of_mavlink_on_the_port_is_heard(commands: Commands) -> None:
    port = free_udp_port()
    packed = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3).pack(mavlink.MAVLink(None, srcSystem=7))
    simulate = commands.start("simulate", "--port", str(port))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        while simulate.poll() is None:
            with contextlib.suppress(OSError):
                sender.sendto(packed, ("127.0.0.1", port))
            time.sleep(0.2)
        own = sender.getsockname()[1]
    _, error = simulate.communicate()
    assert simulate.returncode == 2
    assert f"another vehicle already sends to this port, MAVLink system 7 from UDP port {own}" in error


def test_a_vehicle_that_has_px4s_own_port_is_heard_of_though_a_flight_has_the_other(
    commands: Commands,
) -> None:
    """A PX4 simulator feeds the port, a program receives there already: nothing can be listened to."""
    port = free_udp_port()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as fly,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as px4,
    ):
        fly.bind(("127.0.0.1", port))
        px4.bind(("0.0.0.0", port + 40))
        status, error = commands.run("simulate", "--port", str(port))
    assert status == 2
    assert f"process {os.getpid()}, from UDP port {port + 40}" in error


@pytest.mark.realtime
@pytest.mark.mavlink
def test_what_else_is_started_beside_a_flight_does_it_no_harm(commands: Commands) -> None:
    """In one flight: another vehicle of its own system id, programs on its link, monitors of its log."""
    port = free_udp_port()
    url = f"udpin://127.0.0.1:{port}"
    fly = commands.fly(port)
    wait_for_phase(fly, "CLIMB")
    monitor = commands.start("monitor", "--json")  # without a URL
    wait_until_idle_class(monitor.pid)
    wait_for_phase(fly, "APPROACH 1")
    commands.second_vehicle(port, 7, 238.0)
    stopped = commands.start("monitor", "--json")
    for words in (["monitor", "--connection", url, "--seconds", "1"], ["check", SINGLE, "--connection", url]):
        status, error = commands.run(*words)
        assert status == 2
        assert f"in use by fly, process {fly.pid}" in error
        refusal = [line for line in error.splitlines() if not line.startswith("vehicle: ")]
        assert len(refusal) == 1, error
    stopped.send_signal(signal.SIGKILL)  # in the middle of whatever it does
    out, _ = fly.communicate(timeout=90.0)
    verdict = json.loads(out)
    assert verdict["outcome"] == "completed", verdict["reason"]
    # Ends with the flight; of the idle class it comes last on a busy machine.
    view, error = monitor.communicate(timeout=300.0)
    assert f"watching fly, process {fly.pid}" in error
    seen: dict[str, Any] = json.loads(view)
    assert seen["phase"] == "done"
    assert seen["frame"] == "mission"
    assert len(seen["peaks"]) == 1
    # It does not know of the wall: a body that met it obliquely is read up to 16 % low.
    assert seen["peaks"][0][1] == pytest.approx(verdict["collisions"][0]["measured"]["peak_force_n"], rel=0.2)


def wait_until_idle_class(pid: int) -> None:
    """Soon after its start, before it has loaded its libraries, the program yields to every other."""
    end = time.monotonic() + 20.0
    while os.sched_getscheduler(pid) != os.SCHED_IDLE:
        assert time.monotonic() < end, "it competes with the flight"
        time.sleep(0.01)


def wait_for_phase(fly: subprocess.Popen[str], phase: str) -> None:
    assert fly.stderr is not None
    said = ""
    for line in fly.stderr:
        said += line
        if phase in line:
            return
    pytest.fail(said)


@pytest.mark.realtime
@pytest.mark.mavlink
@pytest.mark.parametrize(("system", "ahead_s"), [(1, 238.0), (1, 0.0), (7, 0.0)])
def test_fly_beside_a_second_vehicle_on_the_port_does_not_take_off(
    system: int, ahead_s: float, commands: Commands
) -> None:
    port = free_udp_port()
    fly = commands.fly(port)
    commands.second_vehicle(port, system, ahead_s)
    out, error = fly.communicate(timeout=90.0)
    assert fly.returncode in (1, 2), error
    verdict = json.loads(out) if out else {}
    if "reason" in verdict:  # `check` had found nothing yet: the guard has
        assert verdict["reason"].startswith("second_vehicle_ground: "), verdict["reason"]
    else:
        assert "second_vehicle" in error
    said = out + error
    # Which of the two is the first one is chance.
    assert re.search("system [17] sends on the same link" if system != 1 else "alternat", said), said
    assert "CLIMB" not in error


@pytest.mark.realtime
@pytest.mark.mavlink
def test_a_second_vehicle_that_begins_to_send_in_the_approach_makes_it_land(commands: Commands) -> None:
    """Its clock is the flight's own; with another one, and in every phase: tests/faults/test_matrix.py."""
    port = free_udp_port()
    fly = commands.fly(port)
    wait_for_phase(fly, "APPROACH 1")
    commands.second_vehicle(port, 1, 0.0)
    out, error = fly.communicate(timeout=90.0)
    verdict = json.loads(out)
    assert verdict["outcome"] == "aborted", error
    assert verdict["reason"].startswith("second_vehicle: "), verdict["reason"]


@pytest.mark.realtime
@pytest.mark.mavlink
def test_monitor_without_a_flight_or_a_vehicle_says_so(commands: Commands) -> None:
    text = commands.config.read_text()
    commands.config.write_text(text.replace("timeout_s: 30.0", "timeout_s: 2.0", 1))
    port = free_udp_port()
    status, error = commands.run(
        "monitor",
        "--config",
        str(commands.config),
        "--connection",
        f"udpin://127.0.0.1:{port}",
        "--seconds",
        "1",
    )
    assert status == 1
    assert "no autopilot on" in error
