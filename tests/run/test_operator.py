"""The operator's requests in flight: buttons of the ground station, signals, and Enter on the terminal."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest

from dart_flight.base.records import Phase, PhaseChange, Request, StatusText
from dart_flight.run import app as module
from dart_flight.run.operator_buttons import Button
from dart_flight.vehicle.command_server import Result
from tests.run.conftest import FlyApp
from tests.run.scripted_session import AppFlight, until

LAND, RELEASE, CONTINUE = Request.LAND, Request.RELEASE, Request.CONTINUE


def test_the_first_stop_lands_and_later_stops_release_the_vehicle(fly_app: FlyApp) -> None:
    async def script(flight: AppFlight) -> None:
        for _ in range(3):
            flight.app.stop()
        await flight.has(3)

    assert fly_app(script).requests == [LAND, RELEASE, RELEASE]


def test_the_land_button_does_not_count_as_a_first_ctrl_c(fly_app: FlyApp) -> None:
    async def script(flight: AppFlight) -> None:
        for _ in range(2):
            assert flight.session.press(Button.LAND) == (Result.ACCEPTED, "landing")
        flight.app.stop()
        assert flight.session.press(Button.CONTINUE)[0] is Result.DENIED
        flight.app.shell.execute(PhaseChange(1, Phase.WAYPOINT, Phase.PAUSE, ""))
        assert flight.session.press(Button.CONTINUE)[0] is Result.ACCEPTED
        await flight.has(4)

    assert fly_app(script).requests == [LAND, LAND, LAND, CONTINUE]


# --- signals ----------------------------------------------------------------------------------------------


@pytest.fixture
def hangup() -> Iterator[Callable[[Any], object]]:
    """Set what the process does at SIGHUP; restore this after the test."""
    before = signal.getsignal(signal.SIGHUP)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield partial(signal.signal, signal.SIGHUP)
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("hangup")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_terminating_signals_land_and_a_repeat_is_logged_but_does_not_release_the_vehicle(
    fly_app: FlyApp, number: signal.Signals
) -> None:
    """GNU timeout signals the program and then its group."""
    other = signal.SIGTERM if number is signal.SIGINT else signal.SIGINT

    async def script(flight: AppFlight) -> None:
        for _ in range(2):
            signal.raise_signal(number)
        await flight.has(1, StatusText)
        signal.raise_signal(signal.SIGUSR1)
        await flight.has(2)
        signal.raise_signal(other)
        await flight.has(3)

    flight = fly_app(script)
    assert flight.requests == [LAND, CONTINUE, RELEASE]
    assert flight.notes == [f"{number.name} again within 0.3 s: counted once"]


def test_an_ignored_hangup_does_not_land_the_vehicle(
    fly_app: FlyApp, hangup: Callable[[Any], object]
) -> None:
    async def script(flight: AppFlight) -> None:
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGUSR1)
        await flight.has(1)

    hangup(signal.SIG_IGN)
    assert fly_app(script).requests == [CONTINUE]
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


# --- the terminal -----------------------------------------------------------------------------------------

PAUSE_S = 0.05


class Terminal:
    """The program's terminal.

    Attributes:
        reads: number of the program's reads.
        looks: number of times that the program has asked who has the terminal.
        foreign: whether another job has the terminal.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.reads = self.looks = 0
        self.foreign = False
        self._ours, theirs = os.openpty()
        monkeypatch.setattr("sys.stdin", os.fdopen(theirs, closefd=False))
        monkeypatch.setattr(os, "tcgetpgrp", self._look)
        monkeypatch.setattr(os, "read", partial(self._read, os.read, theirs))
        # No setting shortens this time, and the test would wait for it.
        monkeypatch.setattr(module, "_KEY_PAUSE_S", PAUSE_S)

    def type(self, keys: bytes) -> None:
        os.write(self._ours, keys)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            os.close(self._ours)

    def _look(self, number: int) -> int:
        self.looks += 1
        return os.getpgrp() + self.foreign

    def _read(self, read: Callable[[int, int], bytes], own: int, number: int, most: int) -> bytes:
        self.reads += number == own
        return read(number, most)


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminal]:
    """Replace the program's terminal."""
    terminal = Terminal(monkeypatch)
    yield terminal
    terminal.close()


def test_enter_requests_continue_and_other_keys_do_not(fly_app: FlyApp, terminal: Terminal) -> None:
    async def script(flight: AppFlight) -> None:
        terminal.type(b"xyz")  # a terminal delivers whole lines, so keys without Enter never arrive
        await asyncio.sleep(0.1)
        assert flight.requests == []
        terminal.type(b"\n")
        await flight.has(1)

    assert fly_app(script).requests == [CONTINUE]


def test_a_key_typed_for_another_job_is_left_to_it_without_asking_all_the_time(
    fly_app: FlyApp, terminal: Terminal
) -> None:
    """A read from the background would stop the program in flight (SIGTTIN), and a pending key is no work."""

    async def script(flight: AppFlight) -> None:
        terminal.foreign = True
        terminal.type(b"\n")
        await asyncio.sleep(6.0 * PAUSE_S)
        assert (terminal.reads, flight.requests) == (0, [])
        assert 1 <= terminal.looks <= 7
        terminal.foreign = False  # in the foreground again, the app reads the key that was typed meanwhile
        await flight.has(1)

    assert fly_app(script).requests == [CONTINUE]


def test_a_closed_terminal_is_read_only_once(fly_app: FlyApp, terminal: Terminal) -> None:
    """A closed terminal stays readable forever, so the loop would spin."""

    async def script(flight: AppFlight) -> None:
        terminal.close()
        await until(lambda: terminal.reads, "the read")
        await asyncio.sleep(0.1)

    fly_app(script)
    assert terminal.reads == 1
