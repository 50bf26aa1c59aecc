"""Standby without a link: its decisions, and the handover of the link to child processes."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest

from dart_flight.base.records import LockPhase, LockState, Mode
from dart_flight.cli import main
from dart_flight.config.vehicle import VehicleConfig, load_vehicle, packaged
from dart_flight.run import standby as module
from dart_flight.run.operator_buttons import Button
from dart_flight.run.standby import Ended, Standby, StandbyDesk, describe_end
from dart_flight.sim.motion_capture import make_server
from dart_flight.vehicle.command_server import Press, Result
from dart_flight.vehicle.motion_capture.source import PoseSource, open_source
from dart_flight.vehicle.vehicle_session import VehicleError
from tests.run.scripted_session import ScriptedSession, connecting_to, until

VEHICLE = load_vehicle(packaged("configs", "dart.yaml")).replace({"lock.servo.travel_s": 0.05})
URL = "udpin://127.0.0.1:14999"
RECEIVER = 65536
OK, LATER, NO = Result.ACCEPTED, Result.TEMPORARILY_REJECTED, Result.DENIED
FLY = Press(Button.FLY, 1)
CENTRED = (1500,) * 8


def desk(channel: int | None = 7) -> StandbyDesk:
    standby = StandbyDesk(("one", "two"), channel, has_lock=True)
    standby.update_armed(False)
    return standby


# --- the desk ----------------------------------------------------------------------------------------------


def test_fly_needs_a_current_remote_control_signal() -> None:
    standby = desk()
    assert standby.press(FLY, 10.0).text == "PX4 receives no remote control"
    standby.update_sensors(RECEIVER | 1, 11.0)
    assert standby.press(FLY, 12.0).result == OK
    assert standby.press(FLY, 14.5).result == NO, "PX4 has been silent for 3.5 s"
    standby.update_sensors(RECEIVER, 15.0)
    standby.update_sensors(1, 15.2)  # the transmitter is off
    assert standby.press(FLY, 15.3).result == NO


def test_a_remote_control_loss_between_two_presses_cancels_the_first() -> None:
    standby = desk()
    standby.update_sensors(RECEIVER, 10.0)
    assert standby.press(FLY, 10.1).result == OK
    standby.update_sensors(0, 10.5)
    assert standby.press(FLY, 11.0).result == NO
    standby.update_sensors(RECEIVER, 11.1)
    assert standby.press(FLY, 11.2).effect is None


def test_a_reset_discards_the_vehicle_state_and_pending_presses() -> None:
    standby = desk()
    standby.update_sensors(RECEIVER, 10.0)
    standby.press(FLY, 10.1)
    standby.reset()
    assert standby.press(FLY, 10.2).text == "PX4 has sent no heartbeat yet"
    standby.update_armed(False)
    assert standby.press(FLY, 10.4).text == "PX4 receives no remote control"
    standby.update_sensors(RECEIVER, 10.5)
    assert standby.press(FLY, 10.6).effect is None, "a press from before the reset must not count"


def test_an_armed_vehicle_and_a_travelling_lock_block_the_buttons() -> None:
    standby = desk()
    standby.update_sensors(RECEIVER, 10.0)
    standby.update_armed(True)
    assert standby.press(FLY, 10.1).text == "the vehicle is armed"
    standby.update_lock(LockState(1, LockPhase.TRAVELLING, Mode.RIGID))
    assert standby.press(Press(Button.LOCK_FLEXIBLE), 10.2).result == LATER
    standby.update_lock(LockState(2, LockPhase.SETTLED, Mode.RIGID))
    assert standby.press(Press(Button.LOCK_FLEXIBLE), 10.3).effect is Mode.FLEXIBLE


def lock_moves(standby: StandbyDesk, *pulses_us: int, present: int = RECEIVER) -> list[Mode]:
    found, now_s = [], 0.0
    for pulse_us in pulses_us:
        for _ in range(10):
            now_s += 0.1
            standby.update_sensors(present, now_s)
            mode = standby.update_switch((*CENTRED[:6], pulse_us, 1500), now_s)
            found += [mode] if mode is not None else []
    return found


def test_only_the_configured_channel_moves_the_lock() -> None:
    assert lock_moves(desk(), 1000, 2000, 1000) == [Mode.RIGID, Mode.FLEXIBLE]
    assert lock_moves(desk(None), 1000, 2000) == []
    assert lock_moves(desk(8), 1000, 2000) == []
    assert lock_moves(desk(18), 1000, 2000) == [], "the receiver lacks this channel"
    assert lock_moves(desk(), 1000, 2000, present=1) == [], "the receiver has lost its transmitter"


# --- the end of a process ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fly", "status", "report", "last_line", "lines"),
    [
        (True, 0, {"outcome": "completed", "reason": None}, "", ["wall: completed"]),
        (
            True,
            1,
            {"outcome": "aborted", "reason": "landing requested"},
            "",
            ["wall: aborted: landing requested"],
        ),
        (False, 0, {"go": True, "findings": []}, "", ["wall: go"]),
        (
            True,
            1,
            {"go": False, "findings": [{"item": "battery", "message": "12 V", "go": False}]},
            "",
            ["wall: no-go", "battery: 12 V"],
        ),
        (True, 2, None, "wall.yaml:3: goal: missing", ["wall: wall.yaml:3: goal: missing"]),
        (True, 1, None, "", ["wall: ended with status 1"]),
        (True, 1, [1], "", ["wall: ended with status 1"]),
        (True, -9, None, "", ["wall: the process was killed by SIGKILL: PX4's failsafe flies the vehicle"]),
        (False, -15, None, "", ["wall: the process was killed by SIGTERM"]),
    ],
)
def test_the_end_of_a_process_is_described_in_lines(
    fly: bool, status: int, report: object, last_line: str, lines: list[str]
) -> None:
    output = b"" if report is None else json.dumps(report).encode()
    assert describe_end("wall", fly, Ended(status, output, last_line)) == lines


def test_only_three_of_many_no_goes_are_listed() -> None:
    findings = [{"item": f"item{i}", "message": "bad", "go": i == 0} for i in range(7)]
    findings.append({"item": "own", "message": "bad", "go": False, "overruled": True})
    output = json.dumps({"go": False, "findings": findings}).encode()
    lines = describe_end("wall", True, Ended(1, output, ""))
    assert lines == ["wall: no-go and 3 more", "item1: bad", "item2: bad", "item3: bad"]


# --- holding and handing over ------------------------------------------------------------------------------

MISSIONS = [("one", "one.yaml"), ("two", "two.yaml")]
COMPLETED = Ended(0, b'{"outcome": "completed", "reason": null}', "")
GO = Ended(0, b'{"go": true, "findings": []}', "")
Hold = Callable[[ScriptedSession], object]


class Child:
    """A double of a child process, which ends after a number of signals."""

    def __init__(self, ended: Ended, waits: int) -> None:
        self.returncode: int | None = None
        self.signals: list[int] = []
        self.stdout, self.stderr = asyncio.StreamReader(), asyncio.StreamReader()
        self._ended, self._waits = ended, waits
        self.stderr.feed_eof()
        self._end_if_due()

    def _end_if_due(self) -> None:
        if len(self.signals) == self._waits:
            self.stdout.feed_data(self._ended.output)
            self.stdout.feed_eof()

    def send_signal(self, number: int) -> None:
        self.signals.append(number)
        self._end_if_due()

    async def wait(self) -> int:
        self.returncode = self._ended.status
        return self.returncode


class Day:
    """A day of standby on scripted sessions, with scripted child processes.

    Args:
        holds: what happens each time that standby holds the link, or the error of the connection; SIGTERM
            follows the last.
        ends: ends of the child processes, in order; None: real processes.
        stops: signals to standby while a child process runs, which ends once it has received them all.

    Attributes:
        printed: kinds and lines of standby's messages.
        commands: commands of the child processes.
        heard: texts that the ground station has received.
        answers: answers to the pressed buttons.
        children: the doubles of the child processes.
    """

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        holds: Sequence[Hold | Exception],
        ends: Sequence[Ended] | None = (),
        missions: Sequence[tuple[str, str]] = MISSIONS,
        stops: Sequence[signal.Signals] = (),
        vehicle: VehicleConfig = VEHICLE,
    ) -> None:
        self.printed: list[tuple[str, str]] = []
        self.commands: list[Sequence[str]] = []
        self.children: list[Child] = []
        self._ends, self._stops = list(ends or ()), stops
        sessions = [hold if isinstance(hold, Exception) else Holding(hold) for hold in holds]
        last = Holding(lambda session: os.kill(os.getpid(), signal.SIGTERM))
        self._sessions = [*sessions, last]
        monkeypatch.setattr(module, "connect", connecting_to(self._sessions))
        # No setting shortens this time, and the test would wait for it.
        for name in ("_RETRY_S", "_TEXT_PAUSE_S", "_LAST_WORDS_S"):
            monkeypatch.setattr(module, name, 0.01)
        if ends is not None:
            monkeypatch.setattr(asyncio, "create_subprocess_exec", self._start)
        standby = Standby(missions, vehicle, URL, [], lambda *line: self.printed.append(line))
        asyncio.run(asyncio.wait_for(standby.run(), 60.0))

    async def _start(self, program: str, dash: str, package: str, *command: str, **_: object) -> Child:
        self.commands.append(command[: command.index("--json")])
        self.children.append(Child(self._ends.pop(0), len(self._stops)))
        for number in self._stops:
            asyncio.get_running_loop().call_soon(os.kill, os.getpid(), number)
        return self.children[-1]

    @property
    def heard(self) -> list[str]:
        return [text for s in self._sessions if isinstance(s, Holding) for text in s.texts]

    @property
    def answers(self) -> list[Result]:
        return [result for s in self._sessions if isinstance(s, Holding) for result, _ in s.answered]

    def results(self) -> list[str]:
        """Return what the ground station has heard, without the state of the lock."""
        return [text for text in self.heard if text != "standby" and not text.startswith("lock ")]


class Holding(ScriptedSession):
    """A session whose script runs once standby serves the operator, on a disarmed vehicle with a pilot."""

    def __init__(self, script: Hold) -> None:
        super().__init__()
        self._script = script

    def serve_operator(self, system_id: int, answer: Callable[[Press], tuple[Result, str]]) -> None:
        super().serve_operator(system_id, answer)
        self.deliver("HEARTBEAT", SimpleNamespace(armed=False))
        self.deliver("SYS_STATUS", SimpleNamespace(present=RECEIVER))
        asyncio.get_running_loop().call_soon(self._script, self)


@pytest.fixture(autouse=True)
def _own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "state"))


def check(number: int) -> Hold:
    return lambda session: session.press(Button.CHECK, number)


def fly(number: int, *then: Press) -> Hold:
    def press(session: ScriptedSession) -> None:
        for button, value, _ in (Press(Button.FLY, number), Press(Button.FLY, number), *then):
            session.press(button, value)

    return press


def test_each_errand_runs_its_commands_and_the_ground_station_hears_their_results(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ends = [GO, GO, Ended(-9, b"", ""), COMPLETED]
    day = Day(monkeypatch, [check(0), fly(2), fly(1)], ends)
    assert day.commands == [
        ("check", "one.yaml"),
        ("check", "two.yaml"),
        ("fly", "two.yaml", "--yes"),
        ("fly", "one.yaml", "--yes"),
    ]
    assert [text for text in day.results() if not text.startswith("fly")] == [
        "one: go",
        "two: go",
        "two: the process was killed by SIGKILL: PX4's failsafe flies the vehicle",
        "one: completed",
    ]
    assert day.heard.count("standby") == 4
    assert set(day.answers) == {OK}


def test_a_missing_vehicle_is_reported_once_and_retried(monkeypatch: pytest.MonkeyPatch) -> None:
    missing = VehicleError(f"no autopilot on {URL} within 5 s")
    day = Day(monkeypatch, [missing, missing, missing, check(1)], [GO])
    assert [text for kind, text in day.printed if kind == "problem"] == [f"{missing}; retrying"]
    assert day.commands == [("check", "one.yaml")]


@pytest.mark.parametrize("kind", ["qualisys", "vrpn"])
def test_cameras_that_are_not_up_yet_are_reported_once_and_retried_while_standby_holds_the_link(
    monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    server = make_server(kind, "dart")
    opened: list[str] = []

    def open_later(url: str) -> PoseSource:
        opened.append(url)
        return open_source(url if len(opened) < 3 else server.url)

    async def wait_and_check(session: ScriptedSession) -> None:
        await until(lambda: server.clients, "standby reads the cameras")
        session.press(Button.CHECK, 1)

    monkeypatch.setattr(module, "open_source", open_later)
    down = VEHICLE.replace({"mocap.url": f"{kind}://127.0.0.1:9/dart"})
    tasks: list[asyncio.Task[None]] = []
    day = Day(
        monkeypatch,
        [lambda session: tasks.append(asyncio.get_running_loop().create_task(wait_and_check(session)))],
        [GO],
        vehicle=down,
    )
    server.close()
    told = next(text for _, text in day.printed if text.startswith("no poses:"))
    assert "127.0.0.1:9" in told
    assert told.endswith("; retrying")
    assert len(opened) >= 3
    assert day.commands == [("check", "one.yaml")]


@pytest.mark.parametrize(
    ("hold", "result", "flies"),
    [
        (fly(1, Press(Button.LAND)), OK, False),
        (fly(1, Press(Button.LOCK_RIGID)), LATER, True),
        (fly(1, Press(Button.FLY, 1)), LATER, True),
    ],
    ids=["land", "lock", "fly"],
)
def test_only_land_is_accepted_while_the_link_is_being_passed_and_cancels_the_flight(
    monkeypatch: pytest.MonkeyPatch, hold: Hold, result: Result, flies: bool
) -> None:
    day = Day(monkeypatch, [hold], [COMPLETED])
    assert day.answers == [OK, OK, result]
    assert day.commands == [("fly", "one.yaml", "--yes")] * flies
    assert (("standby", "take-off cancelled") in day.printed) is not flies


def test_land_does_not_cancel_a_check(monkeypatch: pytest.MonkeyPatch) -> None:
    def hold(session: ScriptedSession) -> None:
        for button in (Button.CHECK, Button.LAND, Button.LOCK_RIGID):
            session.press(button)

    day = Day(monkeypatch, [hold], [GO, GO])
    assert day.commands == [("check", "one.yaml"), ("check", "two.yaml")]
    assert day.answers == [OK, LATER, LATER]


def test_the_lock_moves_by_button_and_its_state_is_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    def hold(session: ScriptedSession) -> None:
        assert session.press(Button.LOCK_RIGID)[0] is OK
        loop = asyncio.get_running_loop()

        def leave_once_settled() -> None:
            if any(text.startswith("lock rigid: settled") for text in session.texts):
                session.press(Button.CHECK, 1)
            else:
                loop.call_later(0.01, leave_once_settled)

        leave_once_settled()

    day = Day(monkeypatch, [hold], [GO])
    assert "lock rigid: settled (no feedback)" in day.heard


def test_a_real_process_reports_why_it_cannot_fly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "systemd"))
    missing = str(tmp_path / "none.yaml")
    day = Day(monkeypatch, [fly(1)], None, [("none", missing)])
    (line,) = (text for text in day.results() if missing in text)
    assert line.startswith(f"none: {missing}: ")
    assert ("child", line.removeprefix("none: ")) in day.printed


def test_signals_land_the_flight_and_end_standby(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second is another signal, which the flight does not take for a repeat."""

    day = Day(monkeypatch, [fly(1)], [COMPLETED], stops=(signal.SIGTERM, signal.SIGINT))
    assert day.children[0].signals == [signal.SIGTERM, signal.SIGINT]
    assert ("standby", "one: completed") in day.printed
    assert day.heard.count("standby") == 1  # it does not hold the link again


# --- command -----------------------------------------------------------------------------------------------


def test_wrong_input_is_reported_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["standby", str(tmp_path / "none.yaml"), "--connection", "udpin://127.0.0.1:14999"]) == 2
    assert "none.yaml" in capsys.readouterr().err
    assert main(["standby", "--connection", "nonsense"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
