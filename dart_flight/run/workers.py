"""Parallel flights in a pool of processes, for campaigns and `dry-run --fast --runs`.

If a process dies, its flight is retried. A fork server starts the processes. A direct fork could inherit a
locked mutex from a thread of the parent, such as the mutex of a progress bar.
"""

from __future__ import annotations

import errno
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
from multiprocessing import forkserver, resource_tracker
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from dart_flight.base.errors import FlightError
from dart_flight.base.signals import StopSignals

I = TypeVar("I", bound=Hashable)  # noqa: E741
R = TypeVar("R")

_POLL_S = 0.2  # period of the checks for an interrupt
_RETRIES = 1
_RENEWALS = 3
_GROUP_SIGNALS = (signal.SIGTERM, signal.SIGHUP)
# Modules that a flight imports, loaded once for all processes.
_PRELOADED = ["dart_flight.run.fast", "dart_flight.recording.verdict"]


def usable_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Interrupt(StopSignals):
    """Context that counts Ctrl-C, SIGTERM and SIGHUP (a dropped session) instead of ending the program.

    It has an effect only in the main thread; in other threads the count stays 0. `announce` is called once
    after the first interrupt, with the number of flights in progress.
    """

    def __init__(self, announce: Callable[[int], None] = lambda under_way: None) -> None:
        super().__init__(self._count)
        self.count = 0
        self._announce: Callable[[int], None] | None = announce

    def report(self, under_way: int) -> None:
        """Announce the first interrupt once; call this several times per second."""
        if self.count and self._announce is not None:
            announce, self._announce = self._announce, None
            announce(under_way)

    def _count(self, number: signal.Signals) -> None:
        self.count += 1


class Failure(NamedTuple):
    """A flight without a result.

    Attributes:
        what: one line that gives the exception and the line of code, or reports the death of the process.
        error: exception, or None if the process died.
    """

    what: str
    error: Exception | None = None


class FinishedItem(NamedTuple, Generic[I, R]):
    """An item and the outcome of its flight: a result or a failure."""

    item: I
    result: R | Failure


def attempt(fly: Callable[[I], R], item: I) -> R | Failure:
    """Return the result; after an exception, return a `Failure` that names the line of code."""
    try:
        return fly(item)
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        what = " ".join(f"{type(error).__name__}: {error}".split())
        what = f"{what} ({Path(place.filename).name}:{place.lineno})"
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # the exception cannot be passed between processes
            return Failure(what)
        return Failure(what, error)


class _Pool(Generic[I, R]):
    """Pool of processes that call `fly` for each item; `renew` replaces the processes of a broken pool."""

    def __init__(self, fly: Callable[[I], R], processes: int) -> None:
        self._fly, self._processes = fly, processes
        self._executor = self._make()

    def _make(self) -> ProcessPoolExecutor:
        methods = multiprocessing.get_all_start_methods()
        context: Any = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
        if "forkserver" in methods:
            context.set_forkserver_preload(_PRELOADED)
            # A signal to the whole process group must not end the fork server, which therefore starts with
            # these signals blocked. Start the resource tracker first, because its start unblocks signals.
            resource_tracker.ensure_running()
            before = signal.pthread_sigmask(signal.SIG_BLOCK, _GROUP_SIGNALS)
            try:
                forkserver.ensure_running()
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
        try:
            return ProcessPoolExecutor(self._processes, context, initializer=_begin, initargs=(self._fly,))
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE):
                raise
            raise FlightError(
                f"cannot start processes for the flights: {error.strerror}; they need a writable /dev/shm "
                "(in a container: --tmpfs /dev/shm)"
            ) from None

    def submit(self, item: I) -> Future[R | Failure]:
        """Submit an item; if the pool is broken, the future has a `BrokenProcessPool` error."""
        try:
            return self._executor.submit(_fly_one, item)
        except (BrokenProcessPool, OSError) as error:
            # If the pool breaks while it starts a process, its pipes may be closed, which raises OSError.
            future: Future[R | Failure] = Future()
            future.set_exception(BrokenProcessPool(str(error)))
            return future

    def renew(self) -> None:
        """Replace the processes; raise FlightError if the new processes end before their first flight."""
        for _ in range(_RENEWALS):
            self.close()
            self._executor = self._make()
            try:
                self._executor.submit(int).result()
            except (BrokenProcessPool, OSError):
                time.sleep(_POLL_S)  # the fork server may have died as well, so allow time for its restart
            else:
                return
        raise FlightError("worker process exited before its first flight")

    def close(self) -> None:
        """Cancel the waiting items; flights in progress end by themselves and their results are ignored."""
        self._executor.shutdown(wait=False, cancel_futures=True)


_fly: Callable[[Any], Any]  # the flight function; set only in pool workers


def _begin(fly: Callable[[Any], Any]) -> None:
    global _fly  # noqa: PLW0603  only a global keeps the function in a pool's process
    _fly = fly
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles interrupts
    os.setpgid(0, 0)  # no signal to the parent's group reaches this process; an ignored SIGHUP stays ignored
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _GROUP_SIGNALS)
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _end_with_the_parent() -> None:
    """End this process of the pool when its parent has ended."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _fly_one(item: Any) -> Any:
    return attempt(_fly, item)


def work(
    fly: Callable[[I], R], items: Iterable[I], processes: int, interrupt: Interrupt
) -> Generator[FinishedItem[I, R], None, None]:
    """Fly items in parallel and yield their results in the order of completion.

    If a process dies, the whole pool breaks. The items in progress are then retried one at a time, which
    identifies an item that makes its process die.

    Args:
        fly: flies one item; pickled once for each process.
        items: read one item at a time.
        interrupt: counter of interrupts. After the first interrupt, no other item begins, and the items in
            progress are completed. After the second interrupt, the items in progress are abandoned.

    Raises:
        FlightError: the processes cannot be started, or end before their first flight.
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
            interrupt.report(len(under_way))
            if not under_way:
                return
            landed, _ = wait(under_way, timeout=_POLL_S, return_when=FIRST_COMPLETED)
            for future in landed:
                if interrupt.count > 1:  # the interrupt arrived while the caller processed a result
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
