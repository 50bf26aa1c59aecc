"""The live view: the messages that an independent viewer receives, and no effect on the flight."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from dart_flight.base.records import ForceEstimate, ImuSample
from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.lab.scene.live import LiveViewProcess, LiveViewSpec
from dart_flight.recording.about import flown_mission
from dart_flight.recording.reader import Log, read_log
from dart_flight.vehicle.link import LinkLease
from tests.doubles.ports import free_udp_port
from tests.doubles.viewer import Viewer
from tests.real_time import TooSlow, assert_not_later, limited, wait_until
from tests.shared_flights import SharedFlights

pytestmark = [pytest.mark.mavlink, pytest.mark.realtime]  # the view's idle class starves on a busy machine

PATIENCE_S = 60.0
_AHEAD_US = 2_000_000
Messages = dict[str, list[dict[str, Any]]]
SINGLE_WALL = str(packaged("missions", "paper_single_wall.yaml"))


@pytest.fixture(scope="module")
def log(flown: SharedFlights) -> Log:
    return read_log(flown("paper_dual_collision", 1).log)


@pytest.fixture(scope="module")
def mission(log: Log) -> Mission:
    return flown_mission(log.about, log.source)


@pytest.fixture
def messages_out() -> list[str]:
    return []


@pytest.fixture
def view(mission: Mission, messages_out: list[str]) -> Iterator[LiveViewProcess]:
    live = LiveViewProcess(LiveViewSpec(mission, "127.0.0.1", 0), messages_out.append)
    _leave_idle_class(live.process.pid)
    yield live
    if live.process.poll() is None:
        live.process.send_signal(signal.SIGCONT)
        live.close()


def _leave_idle_class(pid: int) -> None:
    """Move the process out of the idle class, so that a busy machine still serves it."""
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):  # some systems forbid this
            os.sched_setscheduler(int(task.name), os.SCHED_OTHER, os.sched_param(0))


def start_viewer(port: int, is_complete: Callable[[Messages], bool]) -> tuple[Viewer, threading.Thread]:
    """Start a viewer and wait until it knows the channels."""
    viewer = Viewer(f"ws://127.0.0.1:{port}", is_complete)
    thread = threading.Thread(target=viewer.watch, args=(PATIENCE_S,))
    thread.start()
    wait_until(lambda: viewer.capabilities is not None, PATIENCE_S, "the viewer knows the channels")
    return viewer, thread


def finish(viewer: Viewer, thread: threading.Thread | None = None) -> None:
    """Watch until the viewer has what it wants, or until its thread has ended."""
    if thread is None:
        viewer.watch(PATIENCE_S)
    else:
        thread.join(PATIENCE_S)
    if viewer.timed_out or (thread is not None and thread.is_alive()):
        raise TooSlow(f"the viewer wants more: not within {PATIENCE_S:g} s")


def positions(messages: Messages) -> list[tuple[float, float, float]]:
    moves = [m["transforms"][0]["translation"] for m in messages.get("/tf", [])]
    return [(m["x"], m["y"], m["z"]) for m in moves]


def arm_colours(messages: Messages) -> set[tuple[float, ...]]:
    drawn = [e for update in messages.get("/scene/vehicle", []) for e in update["entities"]]
    return {tuple(e["cylinders"][-1]["color"].values()) for e in drawn}


def shows_whole_flight(messages: Messages) -> bool:
    """Whether the messages show take-off, arms in three states and an impact."""
    path = positions(messages)
    return (
        bool(messages.get("/scene/room"))
        and len(arm_colours(messages)) >= 3
        and bool(messages.get("/scene/hits"))
        and any("impact" in line["message"] for line in messages.get("/log", []))
        and max((z for _, _, z in path), default=0.0) > 0.9
    )


def shows_flight(messages: Messages) -> bool:
    """Whether the messages show a flight; single messages may be dropped for a slow viewer."""
    path = positions(messages)
    return bool(messages.get("/scene/room")) and max((z for _, _, z in path), default=0.0) > 0.5


def test_a_viewer_receives_room_flight_and_arms_but_cannot_publish(log: Log, view: LiveViewProcess) -> None:
    viewer, thread = start_viewer(view.port, shows_whole_flight)
    for entry in log.entries:
        view.feed(entry.record)
        t_us = getattr(entry.record, "t_us", 0)
        if entry.number == 400:  # wait for the first message
            wait_until(lambda: viewer.times_us or not thread.is_alive(), PATIENCE_S, "the first message")
        if entry.number % 200 == 0 and viewer.times_us and t_us > viewer.times_us[0] + _AHEAD_US:
            # The server drops messages for a slow viewer, so feed records no faster than it receives them.
            reached_us = t_us - _AHEAD_US
            wait_until(
                lambda reached_us=reached_us: viewer.times_us[-1] > reached_us or not thread.is_alive(),  # type: ignore[misc]
                PATIENCE_S,
                "the viewer follows",
            )
    finish(viewer, thread)
    assert shows_whole_flight(viewer.messages)
    assert viewer.capabilities == ["time"]
    assert viewer.refused  # the viewer tried to advertise a channel
    assert viewer.times_us == sorted(viewer.times_us)
    room = {e["id"] for update in viewer.messages["/scene/room"] for e in update["entities"]}
    assert {"wall wood", "wall acrylic"} <= room
    assert max(f["normal_n"] for f in viewer.messages["/flight/force"]) > 10.0


def test_a_viewer_that_joins_later_receives_room_and_vehicle(log: Log, view: LiveViewProcess) -> None:
    half = len(log.entries) // 2
    for entry in log.entries[:half]:
        view.feed(entry.record)
    viewer, thread = start_viewer(
        view.port, lambda m: all(f"/scene/{topic}" in m for topic in ("room", "path", "vehicle"))
    )
    for entry in log.entries[half:]:
        view.feed(entry.record)
    finish(viewer, thread)
    assert "/scene/room" in viewer.messages
    assert "/scene/vehicle" in viewer.messages


def test_a_viewer_that_joins_after_the_last_record_receives_room_and_position(
    log: Log, view: LiveViewProcess
) -> None:
    """The link may be lost, or the log no longer written."""
    for entry in log.entries[: len(log.entries) // 2]:
        view.feed(entry.record)
    # Nothing else shows that the process has received all records.
    wait_until(lambda: not view._waiting and not view._unsent, PATIENCE_S, "the records are sent")
    time.sleep(1.0)  # let the process publish the records
    viewer, thread = start_viewer(view.port, lambda m: "/scene/room" in m and bool(positions(m)))
    finish(viewer, thread)
    assert "/scene/room" in viewer.messages
    # Each new subscription publishes the newest pose again, so one viewer may receive it several times.
    assert len(set(positions(viewer.messages))) == 1


def test_a_hanging_view_process_drops_records_without_delaying_the_flight(
    log: Log, view: LiveViewProcess, messages_out: list[str]
) -> None:
    view.process.send_signal(signal.SIGSTOP)
    began = time.monotonic()
    for _ in range(5):
        for entry in log.entries:
            view(entry.record)
    spent = time.monotonic() - began
    assert view.dropped > 0
    assert_not_later(spent / (5 * len(log.entries)), 100e-6, "the time for one record")
    view.process.send_signal(signal.SIGCONT)
    view.close()
    assert [line for line in messages_out if str(view.dropped) in line]


def test_the_death_of_the_view_process_is_reported_and_the_flight_continues(
    log: Log, view: LiveViewProcess, messages_out: list[str]
) -> None:
    view.process.kill()
    view.process.wait()
    wait_until(lambda: messages_out, PATIENCE_S, "the message")
    for entry in log.entries:
        view(entry.record)
    view.close()
    assert messages_out[0] == "live view failed; the flight continues without it"


def test_records_that_the_view_does_not_use_are_not_queued(view: LiveViewProcess) -> None:
    for i in range(1000):
        view(ImuSample(4000 * i, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    assert not view._waiting
    view(ForceEstimate(0, (0.0, 0.0, 0.0), False))
    assert view.dropped == 0


def test_a_port_in_use_is_reported_before_the_flight(
    mission: Mission, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"port {port} is in use"):
            LiveViewProcess(LiveViewSpec(mission, "127.0.0.1", port), print)
        flights = tmp_path / "flights"
        command = ["dry-run", SINGLE_WALL, "--live", "--live-port", str(port), "--log-dir", str(flights)]
        assert main(command) == 2
        error = capsys.readouterr().err.strip().splitlines()[-1]
        assert f"port {port} is in use" in error
        assert "--live-port" in error
        assert not flights.exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--fast", "--live"], "--live needs a single flight in real time"),
        (["--runs", "2", "--live"], "--live needs a single flight in real time"),
        (["--live-port", "8765"], "--live-port needs --live"),
        (["--live-host", "0.0.0.0"], "--live-host needs --live"),
        (["--live", "--live-port", "70000"], "--live-port"),
    ],
)
def test_incompatible_options_are_refused(
    options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        status = main(["dry-run", SINGLE_WALL, *options])
    except SystemExit as exit_:
        status = int(exit_.code or 0)
    assert status == 2
    assert message in capsys.readouterr().err


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port


def test_monitor_shows_a_running_flight_from_its_log(
    log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half of the log exists and does not grow; the flight ends when the viewer has received it."""
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "state"))
    written = tmp_path / "flight.mcap"
    whole = Path(log.source).read_bytes()
    written.write_bytes(whole[: len(whole) // 2])
    port = free_port()
    viewer = Viewer(f"ws://127.0.0.1:{port}", lambda m: "/scene/room" in m and bool(positions(m)))
    flight = LinkLease(f"udpin://127.0.0.1:{free_udp_port()}", "fly", written)
    flight.acquire()

    def watch() -> None:
        viewer.watch(PATIENCE_S)
        flight.release()

    thread = threading.Thread(target=watch)
    thread.start()
    live = ["--live", "--live-port", str(port)]
    assert main(["monitor", "--log", str(written), *live, "--json", "--seconds", str(PATIENCE_S)]) == 0
    finish(viewer, thread)
    assert f"ws://127.0.0.1:{port}" in capsys.readouterr().err
    assert "/scene/room" in viewer.messages
    assert positions(viewer.messages)


def test_simulate_shows_the_truth_and_monitor_the_telemetry(tmp_path: Path) -> None:
    environment = os.environ | {"DART_FLIGHT_STATE_DIR": str(tmp_path / "state")}
    truth, telemetry, link = free_port(), free_port(), str(free_udp_port())
    program = [sys.executable, "-m", "dart_flight"]
    quiet = {
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
        "env": environment,
        # A test runner that ignores SIGINT would pass that on, and the monitor would run its whole minute.
        "preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    }
    simulate = [*program, "simulate", SINGLE_WALL, "--port", link, "--live", "--live-port", str(truth)]
    monitor = [*program, "monitor", "--connection", f"udpin://127.0.0.1:{link}", "--seconds", "60", "--json"]
    monitor += ["--live", "--live-port", str(telemetry)]
    with subprocess.Popen(simulate, **quiet) as vehicle, subprocess.Popen(monitor, **quiet) as watching_it:  # type: ignore[call-overload]
        try:
            simulated = Viewer(
                f"ws://127.0.0.1:{truth}", lambda m: "/scene/room" in m and len(positions(m)) > 5
            )
            finish(simulated)
            linked = Viewer(f"ws://127.0.0.1:{telemetry}", lambda m: len(m.get("/flight/state", [])) > 5)
            finish(linked)
        finally:
            for process in (watching_it, vehicle):
                process.send_signal(signal.SIGINT)
    assert "/flight/true_force" in simulated.messages
    assert "/scene/room" not in linked.messages  # monitor without a mission shows only the vehicle
    assert "/flight/true_force" not in linked.messages
    start = load_mission(SINGLE_WALL).start
    assert positions(simulated.messages)[0][:2] == pytest.approx(start, abs=0.05)


def test_a_dry_run_is_shown_while_it_runs(tmp_path: Path) -> None:
    environment = os.environ | {"DART_FLIGHT_STATE_DIR": str(tmp_path / "state")}
    port = free_port()
    command = [sys.executable, "-m", "dart_flight", "dry-run", SINGLE_WALL, "--live"]
    command += ["--live-port", str(port), "--log-dir", str(tmp_path)]
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as flight:
        assert flight.stderr is not None
        first = next(line for line in flight.stderr if line.startswith("live: "))
        url = re.search(r"ws://\S+[0-9]", first)
        assert url is not None
        assert url[0] == f"ws://127.0.0.1:{port}"
        layout = Path(first.rsplit("layout ", 1)[1].strip())
        assert layout.exists()
        viewer = Viewer(url[0], shows_flight)
        finish(viewer)
        rest = flight.stderr.read()
        with limited("the end of the flight"):
            assert flight.wait(PATIENCE_S) in (0, 1), rest
    assert "/flight/true_force" in viewer.messages
    assert "live view failed" not in rest
