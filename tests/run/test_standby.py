"""Standby without a link: its decisions, and the handover of the link to child processes."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from collections.abc import Sequence
from pathlib import Path
from unittest.mock import Mock

import pytest

from dart_flight.base.records import LockPhase, LockState, Mode
from dart_flight.cli import main
from dart_flight.config.vehicle import load_vehicle, packaged
from dart_flight.run import standby as module
from dart_flight.run.operator_buttons import Button, Errand
from dart_flight.run.standby import Ended, Standby, StandbyDesk, describe_end
from dart_flight.vehicle.command_server import Press, Result
from dart_flight.vehicle.vehicle_session import VehicleError

VEHICLE = load_vehicle(packaged("configs", "dart.yaml"))
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
            {"go": False, "findings": [{"item": "battery", "says": "12 V", "go": False}]},
            "",
            ["wall: no-go", "battery: 12 V"],
        ),
        (True, 2, None, "wall.yaml:3: goal: missing", ["wall: wall.yaml:3: goal: missing"]),
        (True, 1, None, "", ["wall: ended with status 1"]),
        (True, 1, [1], "", ["wall: ended with status 1"]),
        (
            True,
            -9,
            None,
            "",
            ["wall: the process was killed by SIGKILL: PX4's failsafe flies the vehicle"],
        ),
        (False, -15, None, "", ["wall: the process was killed by SIGTERM"]),
    ],
)
def test_the_end_of_a_process_is_described_in_lines(
    fly: bool, status: int, report: object, last_line: str, lines: list[str]
) -> None:
    output = b"" if report is None else json.dumps(report).encode()
    assert describe_end("wall", fly, Ended(status, output, last_line)) == lines


def test_only_three_of_many_no_goes_are_listed() -> None:
    findings = [{"item": f"item{i}", "says": "bad", "go": i == 0} for i in range(7)]
    findings.append({"item": "own", "says": "bad", "go": False, "overruled": True})
    output = json.dumps({"go": False, "findings": findings}).encode()
    lines = describe_end("wall", True, Ended(1, output, ""))
    assert lines == ["wall: no-go and 3 more", "item1: bad", "item2: bad", "item3: bad"]


# --- handover ----------------------------------------------------------------------------------------------


class ScriptedStandby(Standby):
    """Standby with a scripted operator and scripted processes.

    Args:
        errands: the operator's requests, one each time that standby has the link; SIGTERM after the last.
        ends: the ends of the processes, in order.
    """

    def __init__(self, errands: list[Errand | Exception], ends: list[Ended]) -> None:
        self.printed: list[tuple[str, str]] = []
        self.commands: list[Sequence[str]] = []
        self._errands, self._ends = errands, ends
        missions = [("one", "one.yaml"), ("two", "two.yaml")]
        super().__init__(
            missions,
            VEHICLE,
            "udpin://127.0.0.1:1",
            [],
            lambda *kind_and_text: self.printed.append(kind_and_text),
        )

    async def _hold(self) -> None:
        if not self._errands:
            os.kill(os.getpid(), signal.SIGTERM)
            await self._wake.wait()
            return
        errand = self._errands.pop(0)
        if isinstance(errand, Exception):
            raise errand
        self._errand = errand

    async def _run_child(self, command: Sequence[str]) -> Ended:
        self.commands.append(command)
        return self._ends.pop(0)


COMPLETED = Ended(0, b'{"outcome": "completed", "reason": null}', "")
GO = Ended(0, b'{"go": true, "findings": []}', "")


def test_each_errand_runs_its_commands_and_keeps_their_results() -> None:
    errands: list[Errand | Exception] = [Errand(False, (1, 2)), Errand(True, (2,)), Errand(True, (1,))]
    standby = ScriptedStandby(errands, [GO, GO, Ended(-9, b"", ""), COMPLETED])
    asyncio.run(standby.run())
    assert standby.commands == [
        ["check", "one.yaml"],
        ["check", "two.yaml"],
        ["fly", "two.yaml", "--yes"],
        ["fly", "one.yaml", "--yes"],
    ]
    assert standby._news == [
        "one: go",
        "two: go",
        "two: the process was killed by SIGKILL: PX4's failsafe flies the vehicle",
        "one: completed",
    ]


def test_a_missing_vehicle_is_reported_once_and_retried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_RETRY_S", 0.01)
    missing = VehicleError("no autopilot on udpin://127.0.0.1:1 within 5 s")
    standby = ScriptedStandby([missing, missing, missing, Errand(False, (1,))], [GO])
    asyncio.run(standby.run())
    assert [text for kind, text in standby.printed if kind == "problem"] == [f"{missing}; retrying"]
    assert standby.commands == [["check", "one.yaml"]]


@pytest.mark.parametrize(
    ("errand", "button", "result", "remains"),
    [
        (Errand(True, (1,)), Button.LAND, OK, False),
        (Errand(True, (1,)), Button.LOCK_RIGID, LATER, True),
        (Errand(True, (1,)), Button.FLY, LATER, True),
        (Errand(False, (1, 2)), Button.LAND, LATER, True),
    ],
)
def test_land_cancels_a_flight_while_the_link_is_being_passed(
    errand: Errand, button: Button, result: Result, remains: bool
) -> None:
    standby = ScriptedStandby([], [])
    standby._errand = errand
    assert standby._answer(Press(button, 1))[0] == result
    assert standby._errand == (errand if remains else None)


def test_a_real_process_reports_why_it_cannot_fly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "systemd"))
    printed: list[tuple[str, str]] = []
    missing = str(tmp_path / "none.yaml")
    standby = Standby(
        [("none", missing)],
        VEHICLE,
        "udpin://127.0.0.1:1",
        [],
        lambda *kind_and_text: printed.append(kind_and_text),
    )
    asyncio.run(standby._run_errand(Errand(True, (1,))))
    (line,) = standby._news
    assert line.startswith(f"none: {missing}: ")
    assert ("child", line.removeprefix("none: ")) in printed


def test_a_signal_lands_the_flight_and_ends_standby() -> None:
    standby, flight = ScriptedStandby([], []), Mock(returncode=None)
    standby._child = flight
    standby._stop()
    flight.send_signal.assert_called_once_with(signal.SIGTERM)
    standby._stop()  # another signal, which the flight does not take for a repeat
    flight.send_signal.assert_called_with(signal.SIGINT)
    asyncio.run(standby.run())
    assert standby.commands == []


def test_buttons_are_rejected_while_the_link_is_handed_over() -> None:
    standby = ScriptedStandby([], [])
    standby._errand = Errand(False, (1,))
    assert standby._answer(Press(Button.LOCK_RIGID))[0] is LATER


# --- command -----------------------------------------------------------------------------------------------


def test_wrong_input_is_reported_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["standby", str(tmp_path / "none.yaml"), "--connection", "udpin://127.0.0.1:1"]) == 2
    assert "none.yaml" in capsys.readouterr().err
    assert main(["standby", "--connection", "nonsense"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
