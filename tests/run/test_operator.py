"""The operator's word that ends a pause, as the app takes it: Enter on its terminal, or SIGUSR1."""

from __future__ import annotations

import asyncio
import os
import queue
import signal
from collections.abc import Callable

import pytest

from dart_flight.base.records import Input, OperatorRequest, Request
from dart_flight.config.vehicle import packaged
from dart_flight.run import app as app_module
from dart_flight.run.app import FlightApp
from dart_flight.run.prepare import load_flyable


@pytest.fixture
def app() -> FlightApp:
    mission = load_flyable(packaged("missions", "square.yaml"), packaged("configs", "dart.yaml"))
    return FlightApp(mission, "udpin://127.0.0.1:1", lambda record, number: None)


def heard(app: FlightApp, act: Callable[[], object], wanted: int) -> list[Input]:
    """What the core's queue holds once so many inputs have come, or half a second has gone by."""
    inputs: queue.SimpleQueue[Input] = app._core._queue

    async def listen() -> None:
        app.loop = asyncio.get_running_loop()
        app._listen_for_signals()
        act()
        for _ in range(50):
            if inputs.qsize() >= max(wanted, 1):
                break
            await asyncio.sleep(0.01)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1):
            app.loop.remove_signal_handler(number)

    asyncio.run(listen())
    return [inputs.get() for _ in range(inputs.qsize())]


def test_the_signal_is_the_word(app: FlightApp) -> None:
    (word,) = heard(app, lambda: os.kill(os.getpid(), signal.SIGUSR1), 1)
    assert isinstance(word, OperatorRequest)
    assert word.request is Request.CONTINUE


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> int:
    """The other end of a terminal that stands in for the program's own."""
    ours, its = os.openpty()
    monkeypatch.setattr("sys.stdin", os.fdopen(its, closefd=False))
    return ours


def test_enter_is_the_word_and_no_other_key(app: FlightApp, terminal: int) -> None:
    (word,) = heard(app, lambda: os.write(terminal, b"\n"), 1)
    assert isinstance(word, OperatorRequest)
    assert word.request is Request.CONTINUE
    # A terminal hands over whole lines: keys without Enter never come.
    assert heard(app, lambda: os.write(terminal, b"xyz"), 0) == []


def test_in_the_background_the_terminal_is_left_alone(
    app: FlightApp, terminal: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading it there would stop the program in flight (SIGTTIN)."""
    monkeypatch.setattr(app_module, "_in_background", lambda fd: True)
    monkeypatch.setattr(app_module, "_KEY_PAUSE_S", 0.02)
    assert heard(app, lambda: os.write(terminal, b"\n"), 0) == []
    # Brought to the front it hears what was typed in the meantime.
    monkeypatch.setattr(app_module, "_in_background", lambda fd: False)
    assert len(heard(app, lambda: None, 1)) == 1


def test_a_terminal_that_has_gone_is_not_looked_at_again(
    app: FlightApp, terminal: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would be ready to be read for ever."""
    reads: list[int] = []
    read = os.read

    def counted(number: int, most: int) -> bytes:
        reads.append(number)
        return read(number, most)

    monkeypatch.setattr(os, "read", counted)

    async def listen() -> None:
        app.loop = asyncio.get_running_loop()
        app._listen_for_key()
        os.close(terminal)
        for _ in range(500):
            await asyncio.sleep(0.01)
            if reads:
                break
        for _ in range(20):
            await asyncio.sleep(0)

    asyncio.run(listen())
    assert len(reads) == 1
