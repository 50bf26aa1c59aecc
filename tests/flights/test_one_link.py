"""One program per vehicle: real processes on the port or the link of a flight."""

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
from tests.real_time import assert_flown, end_within, rule_of, wait_until
from tests.shared_flights import patient

ROOT = Path(__file__).parents[2]
SINGLE = "missions/paper_single_wall.yaml"


class Commands:
    """Processes of dart-flight that share one state folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.config = folder / "dart.yaml"
        self.config.write_text(patient((ROOT / "configs/dart.yaml").read_text()))
        self._environment = {**os.environ, "DART_FLIGHT_STATE_DIR": str(folder / "state")}
        self._started: list[subprocess.Popen[str]] = []

    def start(self, *words: str) -> subprocess.Popen[str]:
        """Start a command and keep its output for `communicate`."""
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

    def start_second_vehicle(self, port: int, system: int, ahead_s: float) -> None:
        """Start another vehicle that sends to the port."""
        words = ["tests.doubles.second_sender", str(port), str(system), str(ahead_s)]
        self._started.append(
            subprocess.Popen([sys.executable, "-m", *words], cwd=ROOT, stderr=subprocess.PIPE, text=True)
        )

    def fly(self, port: int) -> subprocess.Popen[str]:
        """Start `simulate` on the port and `fly` with it."""
        self.start("simulate", SINGLE, "--port", str(port))
        wait_for_datagram(port)
        return self.start(
            "fly", SINGLE, "--config", str(self.config), "--connection", f"udpin://127.0.0.1:{port}",
            "--driver", "px4", "--yes", "--json", "--log-dir", str(self.folder / "flights"),
        )  # fmt: skip

    def run(self, *words: str) -> tuple[int, str]:
        """Run a command to its end; return its status and standard error."""
        _, error = end_within(60.0, self.start(*words))
        return self._started[-1].returncode, error

    def end(self) -> None:
        """Stop the commands that still run."""
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


def wait_for_datagram(port: int) -> None:
    """Wait for a datagram; the port is free again afterwards."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", port))
        receiver.settimeout(20.0)
        receiver.recv(65536)


def test_a_second_simulated_vehicle_on_a_port_is_refused_with_the_first_named(commands: Commands) -> None:
    port = free_udp_port()
    first = commands.start("simulate", "--port", str(port))
    wait_for_datagram(port)
    status, error = commands.run("simulate", "--port", str(port))
    assert status == 2
    assert error.splitlines()[-1:] == [
        f"UDP port {port}: another vehicle already sends to this port: "
        f"in use by simulate, process {first.pid}"
    ]


def test_simulate_detects_any_other_mavlink_sender_on_its_port(commands: Commands) -> None:
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


def test_simulate_detects_a_px4_simulator_while_a_program_receives_from_it(
    commands: Commands,
) -> None:
    """A program already receives on the port that the simulator feeds, so `simulate` cannot listen."""
    port = free_udp_port()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as fly,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as px4,
    ):
        fly.bind(("127.0.0.1", port))
        px4.bind(("0.0.0.0", port + 40))
        status, error = commands.run("simulate", "--port", str(port))
    assert status == 2
    assert f"sends to this port from UDP port {port + 40} (" in error
    assert f"process {os.getpid()})" in error


@pytest.mark.realtime
@pytest.mark.mavlink
def test_other_programs_on_the_link_do_not_disturb_a_flight(commands: Commands) -> None:
    """One flight has a vehicle with another system id, programs on its link, and monitors of its log."""
    port = free_udp_port()
    url = f"udpin://127.0.0.1:{port}"
    fly = commands.fly(port)
    wait_for_phase(fly, "CLIMB")
    monitor = commands.start("monitor", "--json")  # without a URL
    wait_until_idle_class(monitor.pid)
    wait_for_phase(fly, "APPROACH 1")
    commands.start_second_vehicle(port, 7, 238.0)
    stopped = commands.start("monitor", "--json")
    for words in (["monitor", "--connection", url, "--seconds", "1"], ["check", SINGLE, "--connection", url]):
        status, error = commands.run(*words)
        assert status == 2
        assert f"in use by fly, process {fly.pid}" in error
        refusal = [line for line in error.splitlines() if not line.startswith("vehicle: ")]
        assert len(refusal) == 1, error
    stopped.send_signal(signal.SIGKILL)  # at an arbitrary moment
    out, _ = end_within(90.0, fly)
    verdict = json.loads(out)
    assert_flown(verdict["outcome"], verdict["reason"])
    # The monitor ends with the flight; its idle class makes it slow on a busy machine.
    view, error = end_within(300.0, monitor)
    assert f"watching fly, process {fly.pid}" in error
    shown: dict[str, Any] = json.loads(view)
    assert shown["phase"] == "done"
    assert shown["frame"] == "mission"
    assert len(shown["peaks"]) == 1
    # The monitor does not know the wall and reads an oblique contact up to 16 % low.
    assert shown["peaks"][0][1] == pytest.approx(
        verdict["collisions"][0]["measured"]["peak_force_n"], rel=0.2
    )


def wait_until_idle_class(pid: int) -> None:
    """Wait for the idle class, which the program takes before it loads its libraries."""
    wait_until(lambda: os.sched_getscheduler(pid) == os.SCHED_IDLE, 20.0, "the monitor's idle class")


def wait_for_phase(fly: subprocess.Popen[str], phase: str) -> None:
    """Read the progress of `fly` up to a phase."""
    assert fly.stderr is not None
    output = ""
    for line in fly.stderr:
        output += line
        if phase in line:
            return
    reason = json.loads(fly.stdout.read() or "{}").get("reason") if fly.stdout is not None else None
    pytest.fail(f"{rule_of(reason)}: {output}")


@pytest.mark.realtime
@pytest.mark.mavlink
@pytest.mark.parametrize(("system", "ahead_s"), [(1, 238.0), (1, 0.0), (7, 0.0)])
def test_fly_does_not_take_off_if_a_second_vehicle_sends_to_the_port(
    system: int, ahead_s: float, commands: Commands
) -> None:
    port = free_udp_port()
    fly = commands.fly(port)
    commands.start_second_vehicle(port, system, ahead_s)
    out, error = end_within(90.0, fly)
    assert fly.returncode in (1, 2), error
    verdict = json.loads(out) if out else {}
    if "reason" in verdict:  # the guard has found the vehicle, not `check`
        assert rule_of(verdict["reason"]) == "second_vehicle_ground", verdict["reason"]
    else:
        assert "second_vehicle" in error
    output = out + error
    # Which of the two vehicles comes first is random.
    assert re.search("system [17] sends on the same link" if system != 1 else "alternat", output), output
    assert "CLIMB" not in error


@pytest.mark.realtime
@pytest.mark.mavlink
def test_a_second_vehicle_that_appears_in_the_approach_aborts_the_flight(commands: Commands) -> None:
    """Both clocks agree here; tests/faults/test_matrix.py has other clocks and every phase."""
    port = free_udp_port()
    fly = commands.fly(port)
    wait_for_phase(fly, "APPROACH 1")
    commands.start_second_vehicle(port, 1, 0.0)
    out, error = end_within(90.0, fly)
    verdict = json.loads(out)
    assert verdict["outcome"] == "aborted", error
    assert rule_of(verdict["reason"]) == "second_vehicle", verdict["reason"]


@pytest.mark.realtime
@pytest.mark.mavlink
def test_monitor_reports_that_there_is_neither_a_flight_nor_a_vehicle(commands: Commands) -> None:
    text = commands.config.read_text()
    commands.config.write_text(text.replace("timeout_s: 30.0", "timeout_s: 2.0", 1))
    port = free_udp_port()
    url = ["--connection", f"udpin://127.0.0.1:{port}", "--seconds", "1"]
    status, error = commands.run("monitor", "--config", str(commands.config), *url)
    assert status == 1
    assert "no autopilot on" in error
