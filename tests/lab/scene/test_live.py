"""The live view: what an independent viewer sees, and what the flight does not feel of it."""

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
from tests.shared_flights import SharedFlights

# Over a socket, to a process of the idle class: it is not served where both processors are busy.
pytestmark = [pytest.mark.mavlink, pytest.mark.realtime]  # the view runs in the idle class

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
def said() -> list[str]:
    return []


@pytest.fixture
def view(mission: Mission, said: list[str]) -> Iterator[LiveViewProcess]:
    live = LiveViewProcess(LiveViewSpec(mission, "127.0.0.1", 0), said.append)
    _let_compete(live.process.pid)
    yield live
    if live.process.poll() is None:
        live.process.send_signal(signal.SIGCONT)
        live.close()


def _let_compete(pid: int) -> None:
    """Out of the idle class: what is shown is the subject here, on a machine that may be busy."""
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):  # not every system allows it
            os.sched_setscheduler(int(task.name), os.SCHED_OTHER, os.sched_param(0))


def watching(port: int, wanted: Callable[[Messages], bool]) -> tuple[Viewer, threading.Thread]:
    """A viewer that has been told of the channels."""
    viewer = Viewer(f"ws://127.0.0.1:{port}", wanted)
    thread = threading.Thread(target=viewer.watch, args=(PATIENCE_S,))
    thread.start()
    until(lambda: viewer.capabilities is not None)
    return viewer, thread


def until(there: Callable[[], bool]) -> None:
    ends = time.monotonic() + PATIENCE_S
    while not there():
        assert time.monotonic() < ends
        time.sleep(0.01)


def places(messages: Messages) -> list[tuple[float, float, float]]:
    moves = [m["transforms"][0]["translation"] for m in messages.get("/tf", [])]
    return [(m["x"], m["y"], m["z"]) for m in moves]


def arm_colours(messages: Messages) -> set[tuple[float, ...]]:
    drawn = [e for update in messages.get("/scene/vehicle", []) for e in update["entities"]]
    return {tuple(e["cylinders"][-1]["color"].values()) for e in drawn}


def flew_and_locked(messages: Messages) -> bool:
    """Take-off, an approach, arms in three states, an impact: all that there is to see."""
    way = places(messages)
    return (
        bool(messages.get("/scene/room"))
        and len(arm_colours(messages)) >= 3
        and bool(messages.get("/scene/hits"))
        and any("impact" in line["message"] for line in messages.get("/log", []))
        and max((z for _, _, z in way), default=0.0) > 0.9
    )


def flies(messages: Messages) -> bool:
    """What a viewer sees at any load: what comes but once may be among what a slow one is not sent."""
    way = places(messages)
    return bool(messages.get("/scene/room")) and max((z for _, _, z in way), default=0.0) > 0.5


def test_a_viewer_sees_room_flight_and_arms_and_can_publish_nothing(log: Log, view: LiveViewProcess) -> None:
    viewer, thread = watching(view.port, flew_and_locked)
    for entry in log.entries:
        view.feed(entry.record)
        t_us = getattr(entry.record, "t_us", 0)
        if entry.number == 400:  # all of it could be over before the first message has come
            until(lambda: bool(viewer.times_us) or not thread.is_alive())
        if entry.number % 200 == 0 and viewer.times_us and t_us > viewer.times_us[0] + _AHEAD_US:
            # What a viewer does not fetch in time is left out for it: not faster than this machine shows it.
            until(lambda t_us=t_us: viewer.times_us[-1] > t_us - _AHEAD_US or not thread.is_alive())  # type: ignore[misc]
    thread.join(PATIENCE_S)
    assert flew_and_locked(viewer.messages)
    assert viewer.capabilities == ["time"]
    assert viewer.refused  # it tried to advertise a channel
    assert viewer.times_us == sorted(viewer.times_us)
    room = {e["id"] for update in viewer.messages["/scene/room"] for e in update["entities"]}
    assert {"wall wood", "wall acrylic"} <= room
    assert max(f["normal_n"] for f in viewer.messages["/flight/force"]) > 10.0


def test_a_viewer_that_comes_later_sees_the_room_and_the_way(log: Log, view: LiveViewProcess) -> None:
    half = len(log.entries) // 2
    for entry in log.entries[:half]:
        view.feed(entry.record)
    viewer, thread = watching(
        view.port, lambda m: all(f"/scene/{topic}" in m for topic in ("room", "path", "vehicle"))
    )
    for entry in log.entries[half:]:
        view.feed(entry.record)
    thread.join(PATIENCE_S)
    assert "/scene/room" in viewer.messages
    assert "/scene/vehicle" in viewer.messages


def test_a_viewer_sees_the_room_after_the_last_record(log: Log, view: LiveViewProcess) -> None:
    """A flight that is no longer heard of, or a log that is no longer written."""
    for entry in log.entries[: len(log.entries) // 2]:
        view.feed(entry.record)
    until(lambda: not view._waiting and not view._unsent)
    time.sleep(1.0)  # the process has published what it has read
    viewer, thread = watching(view.port, lambda m: "/scene/room" in m)
    thread.join(PATIENCE_S)
    assert "/scene/room" in viewer.messages


def test_a_process_that_hangs_costs_records_and_no_time(
    log: Log, view: LiveViewProcess, said: list[str]
) -> None:
    view.process.send_signal(signal.SIGSTOP)
    began = time.monotonic()
    for _ in range(5):
        for entry in log.entries:
            view(entry.record)
    spent = time.monotonic() - began
    assert view.dropped > 0
    assert spent / (5 * len(log.entries)) < 100e-6  # on a machine that does other things, too
    view.process.send_signal(signal.SIGCONT)
    view.close()
    assert [line for line in said if str(view.dropped) in line]


def test_its_death_is_one_line_and_the_flight_goes_on(
    log: Log, view: LiveViewProcess, said: list[str]
) -> None:
    view.process.kill()
    view.process.wait()
    until(lambda: bool(said))
    for entry in log.entries:
        view(entry.record)
    view.close()
    assert said[0] == "live view failed; the flight continues without it"


def test_what_no_picture_needs_is_not_even_queued(view: LiveViewProcess) -> None:
    for i in range(1000):
        view(ImuSample(4000 * i, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    assert not view._waiting
    view(ForceEstimate(0, (0.0, 0.0, 0.0), False))
    assert view.dropped == 0


def test_a_taken_port_is_named_before_the_flight(
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
        said = capsys.readouterr().err.strip().splitlines()[-1]
        assert f"port {port} is in use" in said
        assert "--live-port" in said
        assert not flights.exists()


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--fast", "--live"], "--live needs a single flight in real time"),
        (["--runs", "2", "--live"], "--live needs a single flight in real time"),
        (["--live-port", "8765"], "--live-port needs --live"),
        (["--live-host", "0.0.0.0"], "--live-host needs --live"),
        (["--live", "--live-port", "70000"], "--live-port"),
    ],
)
def test_what_does_not_go_together_is_refused(
    options: list[str], why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        status = main(["dry-run", SINGLE_WALL, *options])
    except SystemExit as exit_:
        status = int(exit_.code or 0)
    assert status == 2
    assert why in capsys.readouterr().err


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port


def test_monitor_shows_a_flight_by_its_log(
    log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half of it is written, and no more comes; the flight is over once the viewer has seen it."""
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "state"))
    written = tmp_path / "flight.mcap"
    whole = Path(log.source).read_bytes()
    written.write_bytes(whole[: len(whole) // 2])
    port = free_port()
    viewer = Viewer(f"ws://127.0.0.1:{port}", lambda m: "/scene/room" in m and bool(places(m)))
    flight = LinkLease(f"udpin://127.0.0.1:{free_udp_port()}", "fly", written)
    flight.acquire()

    def watch() -> None:
        viewer.watch(PATIENCE_S)
        flight.release()

    thread = threading.Thread(target=watch)
    thread.start()
    live = ["--live", "--live-port", str(port)]
    assert main(["monitor", "--log", str(written), *live, "--json", "--seconds", str(PATIENCE_S)]) == 0
    thread.join(PATIENCE_S)
    assert f"ws://127.0.0.1:{port}" in capsys.readouterr().err
    assert "/scene/room" in viewer.messages
    assert places(viewer.messages)


def test_simulate_shows_what_is_and_monitor_what_is_told(tmp_path: Path) -> None:
    environment = os.environ | {"DART_FLIGHT_STATE_DIR": str(tmp_path / "state")}
    true, told, link = free_port(), free_port(), str(free_udp_port())
    program = [sys.executable, "-m", "dart_flight"]
    quiet = {
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
        "env": environment,
        # Whatever runs the tests may ignore Ctrl-C, and its children would inherit that: the monitor would
        # watch for all of its minute.
        "preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    }
    simulate = [*program, "simulate", SINGLE_WALL, "--port", link, "--live", "--live-port", str(true)]
    monitor = [*program, "monitor", "--connection", f"udpin://127.0.0.1:{link}", "--seconds", "60", "--json"]
    monitor += ["--live", "--live-port", str(told)]
    with subprocess.Popen(simulate, **quiet) as vehicle, subprocess.Popen(monitor, **quiet) as watching_it:  # type: ignore[call-overload]
        try:
            alone = Viewer(f"ws://127.0.0.1:{true}", lambda m: "/scene/room" in m and len(places(m)) > 5)
            assert alone.watch(PATIENCE_S)
            linked = Viewer(f"ws://127.0.0.1:{told}", lambda m: len(m.get("/flight/state", [])) > 5)
            assert linked.watch(PATIENCE_S)
        finally:
            for process in (watching_it, vehicle):
                process.send_signal(signal.SIGINT)
    assert "/flight/true_force" in alone.messages
    assert "/scene/room" not in linked.messages  # no mission was named: only the vehicle is meant
    assert "/flight/true_force" not in linked.messages
    start = load_mission(SINGLE_WALL).start
    assert places(alone.messages)[0][:2] == pytest.approx(start, abs=0.05)


def test_a_dry_run_is_seen_while_it_goes_on(tmp_path: Path) -> None:
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
        viewer = Viewer(url[0], flies)
        seen = viewer.watch(PATIENCE_S)
        rest = flight.stderr.read()
        assert flight.wait(PATIENCE_S) in (0, 1), rest
    assert seen
    assert "/flight/true_force" in viewer.messages
    assert "live view failed" not in rest
