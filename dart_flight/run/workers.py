"""Processes that fly one flight after another; one that dies costs its own flight a retry, and no other.

Every process has a pipe of its own, so that the flight of a dead one is known. They come from a fork server:
a thread of the parent's (a progress bar's) cannot leave a lock behind in them, and when the parent is killed
their pipes end and they with them.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Generic, NamedTuple, TypeVar

from dart_flight.base.errors import FlightError

I = TypeVar("I")  # noqa: E741
R = TypeVar("R")

_POLL_S = 0.2  # for an interrupt
_END_S = 5.0
_RETRIES = 1
_READY = "ready"
# What a flight imports, once for all processes.
_PRELOADED = ["dart_flight.run.fast", "dart_flight.recording.verdict"]


def usable_cores() -> int:
    """Cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Interrupt:
    """Counts Ctrl-C, SIGTERM and SIGHUP (a dropped session) instead of tearing down what is under way.

    In force as a context; only the main thread can have it so, elsewhere the count stays 0.
    """

    def __init__(self) -> None:
        self.count = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                self._before[number] = signal.signal(number, self._take)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _take(self, signum: int, frame: FrameType | None) -> None:
        self.count += 1


class Failure(NamedTuple):
    """A flight without a result.

    Attributes:
        what: in one line: the exception and its place, or that its process died.
        error: the exception; None where the process died.
    """

    what: str
    error: Exception | None = None


class Done(NamedTuple, Generic[I, R]):
    """One item after it was flown: its result, or why there is none."""

    item: I
    result: R | Failure


def attempt(fly: Callable[[I], R], item: I) -> R | Failure:
    """Fly one item; an exception is a `Failure` with the place it came from."""
    try:
        return fly(item)
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        what = " ".join(f"{type(error).__name__}: {error}".split())
        what = f"{what} ({Path(place.filename).name}:{place.lineno})"
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # its own matter how it is built
            return Failure(what)
        return Failure(what, error)


class _Worker(Generic[I, R]):
    """A process and what it is flying."""

    def __init__(self, fly: Callable[[I], R]) -> None:
        methods = multiprocessing.get_all_start_methods()
        context: Any = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
        if "forkserver" in methods:
            context.set_forkserver_preload(_PRELOADED)
        self.pipe: Connection
        self.pipe, there = context.Pipe()
        self.process = context.Process(target=_serve, args=(there, fly), daemon=True)
        self.process.start()
        there.close()
        self.is_ready = False
        self.item: I | None = None
        self.is_busy = False

    def give(self, item: I) -> None:
        """Let it fly; where it has died that shows when its result is awaited."""
        self.item, self.is_busy = item, True
        with contextlib.suppress(OSError):
            self.pipe.send(item)

    def receive(self) -> R | Failure | str | None:
        """What it sends; None where it has died."""
        try:
            received: R | Failure | str = self.pipe.recv()
            return received
        except (EOFError, OSError):
            self.process.join(_END_S)
            return None

    def end(self) -> None:
        """Let it go; what it is flying is lost."""
        self.pipe.close()
        if self.is_busy or not self.is_ready:
            self.process.terminate()
        self.process.join(_END_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


def _serve(pipe: Connection, fly: Callable[[Any], Any]) -> None:
    """In the process: fly what comes until there is no more."""
    # The parent decides what an interrupt means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    with contextlib.suppress(EOFError, OSError):
        pipe.send(_READY)
        while True:
            pipe.send(attempt(fly, pipe.recv()))


def work(
    fly: Callable[[I], R], items: Iterable[I], processes: int, interrupt: Interrupt
) -> Generator[Done[I, R], None, None]:
    """Fly items side by side, as they come; results in the order they land.

    Args:
        fly: flies one; goes to the processes by pickle, once.
        items: are taken one by one, so that there may be many.
        processes: side by side.
        interrupt: after a first one no further item is begun, those under way are flown to their end; a
            second one gives those up.

    Raises:
        FlightError: a process ends before it could fly anything.
    """
    waiting, again = iter(items), deque[tuple[I, int]]()
    died: dict[int, int] = {}  # deaths of the item that a worker has, by the worker
    crew: list[_Worker[I, R]] = []
    exhausted = False

    def begin(worker: _Worker[I, R]) -> bool:
        nonlocal exhausted
        if again:
            item, deaths = again.popleft()
        else:
            try:
                item, deaths = next(waiting), 0
            except StopIteration:
                exhausted = True
                return False
        died[id(worker)] = deaths
        worker.give(item)
        return True

    try:
        while interrupt.count < 2:
            for worker in crew:
                if worker.is_busy or interrupt.count or (exhausted and not again):
                    continue
                begin(worker)
            while len(crew) < processes and not interrupt.count and (again or not exhausted):
                crew.append(_Worker(fly))
                if not begin(crew[-1]):
                    crew.pop().end()
            busy = {worker.pipe: worker for worker in crew if worker.is_busy}
            if not busy:
                return
            for pipe in wait(list(busy), timeout=_POLL_S):
                worker = busy[pipe]  # type: ignore[index]
                received = worker.receive()
                if received == _READY:
                    worker.is_ready = True
                    continue
                item, worker.is_busy = worker.item, False
                assert item is not None
                if received is not None and not isinstance(received, str):
                    yield Done(item, received)
                    continue
                crew.remove(worker)
                worker.end()
                ended = _how_ended(worker.process.exitcode)
                if not worker.is_ready:
                    raise FlightError(f"a process for flights ended before it flew anything ({ended})")
                deaths = died.pop(id(worker)) + 1
                if deaths > _RETRIES:
                    yield Done(item, Failure(f"its process died {deaths} times ({ended})"))
                else:
                    again.append((item, deaths))
    finally:
        for worker in crew:
            worker.end()


def _how_ended(code: int | None) -> str:
    if code is not None and code < 0:
        with contextlib.suppress(ValueError):
            return signal.Signals(-code).name
    return f"exit code {code}"
