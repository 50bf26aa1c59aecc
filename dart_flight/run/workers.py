"""Flights side by side in a pool of processes; one that dies costs its own flight a retry, and no other.

The processes come from a fork server: a thread of the parent's (a progress bar's) cannot leave a lock behind
in them.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Hashable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Generic, NamedTuple, TypeVar

from dart_flight.base.errors import FlightError

I = TypeVar("I", bound=Hashable)  # noqa: E741
R = TypeVar("R")

_POLL_S = 0.2  # for an interrupt
_RETRIES = 1
_RENEWALS = 3
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


class FinishedItem(NamedTuple, Generic[I, R]):
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


class _Pool(Generic[I, R]):
    """A process pool that has the function that flies, and is made anew where a process of it died."""

    def __init__(self, fly: Callable[[I], R], processes: int) -> None:
        self._fly, self._processes = fly, processes
        self._executor = self._make()

    def _make(self) -> ProcessPoolExecutor:
        methods = multiprocessing.get_all_start_methods()
        context: Any = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
        if "forkserver" in methods:
            context.set_forkserver_preload(_PRELOADED)
        return ProcessPoolExecutor(self._processes, context, initializer=_begin, initargs=(self._fly,))

    def submit(self, item: I) -> Future[R | Failure]:
        """Let one fly; where the pool is broken the future says so."""
        try:
            return self._executor.submit(_fly_one, item)
        except (BrokenProcessPool, OSError) as error:
            # A pool that breaks while it starts a process may have closed the pipes of that process already.
            future: Future[R | Failure] = Future()
            future.set_exception(BrokenProcessPool(str(error)))
            return future

    def renew(self) -> None:
        """Take new processes.

        Raises:
            FlightError: they end before they could fly anything.
        """
        for _ in range(_RENEWALS):
            self.close()
            self._executor = self._make()
            try:
                self._executor.submit(int).result()
            except (BrokenProcessPool, OSError):
                time.sleep(_POLL_S)  # the fork server may have died with the pool, and starts again
            else:
                return
        raise FlightError("worker process exited before its first flight")

    def close(self) -> None:
        """Begin nothing more; what is under way ends by itself, and nobody looks at it."""
        self._executor.shutdown(wait=False, cancel_futures=True)


_fly: Callable[[Any], Any]  # in a process of the pool: what it was given to fly with


def _begin(fly: Callable[[Any], Any]) -> None:
    global _fly  # noqa: PLW0603  a pool hands its processes nothing else for good
    _fly = fly
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what an interrupt means
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _end_with_the_parent() -> None:
    """A pool's processes live on when their parent is killed: they would fly for nobody."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _fly_one(item: Any) -> Any:
    return attempt(_fly, item)


def work(
    fly: Callable[[I], R], items: Iterable[I], processes: int, interrupt: Interrupt
) -> Generator[FinishedItem[I, R], None, None]:
    """Fly items side by side, as they come; results in the order they land.

    A pool breaks as a whole where one of its processes dies. Those under way then fly one at a time,
    so that the one that dies again is known.

    Args:
        fly: flies one; goes to the processes by pickle, once.
        items: are taken one by one, so that there may be many.
        processes: side by side.
        interrupt: after a first one no further item is begun, those under way are flown to their end; a
            second one gives those up.

    Raises:
        FlightError: a process ends before it could fly anything.
    """
    waiting, suspects = iter(items), deque[I]()
    deaths: dict[I, int] = {}
    under_way: dict[Future[R | Failure], I] = {}
    pool: _Pool[I, R] = _Pool(fly, processes)
    alone = False
    try:
        while interrupt.count < 2:
            if not under_way:
                alone = bool(suspects)
            while not interrupt.count and len(under_way) < (1 if alone else processes):
                try:
                    item = suspects.popleft() if alone else next(waiting)
                except StopIteration:
                    break
                under_way[pool.submit(item)] = item
            if not under_way:
                return
            landed, _ = wait(under_way, timeout=_POLL_S, return_when=FIRST_COMPLETED)
            for future in landed:
                if interrupt.count > 1:  # given up while somebody took the result before this one
                    return
                if not isinstance(future.exception(), BrokenProcessPool):
                    yield FinishedItem(under_way.pop(future), future.result())
            if any(isinstance(future.exception(), BrokenProcessPool) for future in landed):
                lost = list(under_way.values())
                under_way.clear()
                pool.renew()
                for item in lost:
                    deaths[item] = deaths.get(item, 0) + alone
                    if deaths[item] > _RETRIES:
                        yield FinishedItem(item, Failure(f"its process died {deaths[item]} times"))
                    else:
                        suspects.append(item)
    finally:
        pool.close()
