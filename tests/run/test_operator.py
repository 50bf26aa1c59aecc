"""The operator's request to end a pause: Enter on the app's terminal, or SIGUSR1."""

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


def inputs_after(app: FlightApp, trigger: Callable[[], object], wanted: int) -> list[Input]:
    """Return the core's queued inputs once `wanted` have arrived or half a second has passed."""
    inputs: queue.SimpleQueue[Input] = app._core._queue

    async def listen() -> None:
        app.loop = asyncio.get_running_loop()
        with app._listening_for_operator():
            trigger()
            for _ in range(50):
                if inputs.qsize() >= max(wanted, 1):
                    break
                await asyncio.sleep(0.01)
        app.loop.remove_signal_handler(signal.SIGUSR1)

    asyncio.run(listen())
    return [inputs.get() for _ in range(inputs.qsize())]


def test_sigusr1_requests_continue(app: FlightApp) -> None:
    (item,) = inputs_after(app, lambda: os.kill(os.getpid(), signal.SIGUSR1), 1)
    assert isinstance(item, OperatorRequest)
    assert item.request is Request.CONTINUE


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> int:
    """Replace the program's terminal and return its other end."""
    our_end, program_end = os.openpty()
    monkeypatch.setattr("sys.stdin", os.fdopen(program_end, closefd=False))
    return our_end


def test_enter_requests_continue_and_other_keys_do_not(app: FlightApp, terminal: int) -> None:
    (item,) = inputs_after(app, lambda: os.write(terminal, b"\n"), 1)
    assert isinstance(item, OperatorRequest)
    assert item.request is Request.CONTINUE
    # A terminal delivers whole lines, so keys without Enter never arrive.
    assert inputs_after(app, lambda: os.write(terminal, b"xyz"), 0) == []


def test_a_background_process_does_not_read_its_terminal(
    app: FlightApp, terminal: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A read from the background would stop the program in flight (SIGTTIN)."""
    monkeypatch.setattr(app_module, "_in_background", lambda fd: True)
    monkeypatch.setattr(app_module, "_KEY_PAUSE_S", 0.02)
    assert inputs_after(app, lambda: os.write(terminal, b"\n"), 0) == []
    # In the foreground again, the app reads the key that was typed meanwhile.
    monkeypatch.setattr(app_module, "_in_background", lambda fd: False)
    assert len(inputs_after(app, lambda: None, 1)) == 1


def test_a_closed_terminal_is_read_only_once(
    app: FlightApp, terminal: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A closed terminal stays readable forever, so the loop would spin."""
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
