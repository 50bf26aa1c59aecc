"""The engine of a studio page: kept warm processes that check, plan and fly texts.

One process checks, a second one plans and flies, so that a check never waits for a plan. The page's process
loads neither `dart_flight.vehicle` nor mavsdk; the engine's processes (`engine_process`) do. They exchange
pickled objects as lines. A process that dies is started again, and its request ends with `Failed`.
"""

from __future__ import annotations

import base64
import itertools
import pickle
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from dart_flight.base.processes import ChildProcess
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.studio.scene_model import Scene

_MODULE = "dart_flight.lab.studio.engine_process"
READY = b"\n"  # line of a process that is warm


class Finding(NamedTuple):
    """A finding of `check`, or the error that keeps a file from loading.

    Attributes:
        item: name of the finding, as `check` prints it; `file` for an error of the file.
        remark: whether the finding is go, but deviates from the recommendation.
        message: the finding in the words of the command.
        objects: ids of the objects that the finding concerns, the most important first.
    """

    item: str
    go: bool
    remark: bool
    message: str
    objects: list[str]


class Checked(msgspec.Struct):
    """A text has been checked.

    Attributes:
        go: whether `check` of stage `file` says go; for a scenario, whether it loads.
        scene: scene with predicted path and hits; None if the text is not YAML.
        stale: why the plan of the mission is stale, or None.
        materials, modes: those of the vehicle, for menus.
    """

    go: bool = False
    findings: list[Finding] = []
    scene: Scene | None = None
    stale: str | None = None
    materials: list[str] = []
    modes: list[str] = []


class PlanRow(msgspec.Struct):
    """A plan.

    Attributes:
        rank: 1 is the best; 0 is the free flight, without a hit.
        values: quantities by name, with unit, as the command's table shows them.
        paths: lines (n, 3) of the predicted path, in no order.
        mission: text of the mission, or "" if it is refused.
        problem: why the mission is refused or no-go, or "".
    """

    rank: int
    summary: str
    values: dict[str, str]
    paths: list[Array]
    mission: str
    problem: str
    time_s: float | None
    saving_s: float | None


class Planned(msgspec.Struct):
    """The result of a search.

    Attributes:
        plans: the best first, the free flight last.
        refused: number of refused candidates and what to relax, by reason.
    """

    plans: list[PlanRow]
    refused: dict[str, tuple[int, str]]
    summary: str


class FlyRequest(msgspec.Struct):
    """What to fly.

    Attributes:
        seed: first seed.
        flights: number of flights with consecutive seeds, 1 to 1,000.
        vary: what differs at random from the nominal world, as `--vary` of `dry-run`; empty: nothing.
        fault: a fault as `--fault` of `dry-run`, only for a single flight, or None.
        log: whether each flight writes a log. A flight without a log can be repeated with its seed and a log.
    """

    seed: int = 1
    flights: int = 1
    vary: tuple[str, ...] = ()
    fault: str | None = None
    log: bool = True


class FlownOne(msgspec.Struct):
    """One flight.

    Attributes:
        outcome: completed, aborted or released.
        reason: why it did not complete, or None.
        path: true path, (n, 3).
        log: the flight's log, or None without one.
    """

    seed: int
    outcome: str
    reason: str | None
    path: Array
    log: str | None = None


class Progress(msgspec.Struct):
    """Candidates tried or flights landed so far, and in all (None: unknown); `landed` are the new ones."""

    done: int
    of: int | None
    landed: list[FlownOne] = []


class AllFlown(NamedTuple):
    """All flights have landed."""


class Failed(NamedTuple):
    """A request has ended without a result; its number is 0 if a process died without a request."""

    message: str
    cancelled: bool = False


class EngineEvent(NamedTuple):
    """What has become of the request of that number."""

    number: int
    what: Checked | Progress | Planned | AllFlown | Failed


class EngineRequest(NamedTuple):
    """A text to work on, whose file is `path`; `task` is the name of a function of `engine_work`."""

    number: int
    task: str
    text: str
    path: str
    options: tuple[Any, ...] = ()


def to_line(value: EngineEvent | EngineRequest) -> bytes:
    return base64.b64encode(pickle.dumps(value))


def from_line(line: bytes) -> Any:
    return pickle.loads(base64.b64decode(line))


class Engine:
    """The engine of one page.

    Args:
        on_event: called with every event, on a thread of the engine.
        log_dir: folder for logs of flights.
    """

    def __init__(self, on_event: Callable[[EngineEvent], None], log_dir: Path) -> None:
        self._log_dir = str(log_dir.absolute())
        self._numbers = itertools.count(1)
        self._checker = _Worker("the process that checks", on_event)
        self._worker = _Worker("the process that plans and flies", on_event)

    def check(self, text: str, path: Path) -> int:
        """Check a text; return the number of the request. A newer request replaces one that waits."""
        return self._checker.send(EngineRequest(next(self._numbers), "check", text, str(path)))

    def plan(self, text: str, path: Path, objective: str | None = None, within_s: float = 60.0) -> int:
        """Plan a scenario's text. A plan or flights in progress are cancelled first."""
        self.cancel()
        options = (objective, within_s)
        return self._worker.send(EngineRequest(next(self._numbers), "plan", text, str(path), options))

    def fly(self, text: str, path: Path, wanted: FlyRequest) -> int:
        """Fly a mission's text in the fast world. A plan or flights in progress are cancelled first."""
        self.cancel()
        options = (wanted, self._log_dir)
        return self._worker.send(EngineRequest(next(self._numbers), "fly", text, str(path), options))

    def cancel(self) -> None:
        """Cancel the plan or the flights in progress, if any: `Failed` follows at once."""
        self._worker.cancel()

    def close(self) -> None:
        """End the processes."""
        self._checker.close()
        self._worker.close()


class _Worker:
    """A process that answers one request after the other; the newest request replaces one that waits.

    Args:
        name: the process, in messages.
    """

    def __init__(self, name: str, on_event: Callable[[EngineEvent], None]) -> None:
        self._name, self._on_event = name, on_event
        self._lock = threading.RLock()
        self._open: EngineRequest | None = None  # the request in progress
        self._waiting: EngineRequest | None = None
        self._process: ChildProcess | None = None
        self._starts, self._ready = 0, False
        self._start()

    def send(self, request: EngineRequest) -> int:
        with self._lock:
            if self._process is None:
                self._start()
            self._waiting = request
            self._send_next()
        return request.number

    def cancel(self) -> None:
        """End the request in progress by ending the process, which starts again."""
        with self._lock:
            request, self._open, self._waiting = self._open, None, None
            if request is not None:
                self._end_process()
                self._start()
        if request is not None:
            self._on_event(EngineEvent(request.number, Failed("cancelled", cancelled=True)))

    def close(self) -> None:
        with self._lock:
            self._open = self._waiting = None
            self._end_process()

    def _end_process(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()

    def _start(self) -> None:
        with self._lock:
            self._starts, self._ready = self._starts + 1, False
            self._process = ChildProcess(_MODULE, b"", partial(self._receive, self._starts))

    def _send_next(self) -> None:
        if self._open is None and self._waiting is not None and self._process is not None:
            self._open, self._waiting = self._waiting, None
            if not self._process.send(to_line(self._open)):
                self._process.kill()  # the request did not fit into the pipe, or the process has ended

    def _receive(self, start: int, line: bytes) -> None:
        with self._lock:
            if start != self._starts or self._process is None:
                return  # of a process that was ended here
            if line == READY:
                self._ready = True
                return
            event = from_line(line) if line else self._restarted()
            if not isinstance(event.what, Progress):
                self._open = None
                self._send_next()
        self._on_event(event)

    def _restarted(self) -> EngineEvent:
        """Start the process again if it has been ready, and return what has become of its request."""
        again, number = self._ready, 0 if self._open is None else self._open.number
        self._end_process()
        self._open = None
        if again:
            self._start()
        then = "it was started again" if again else "the next request starts it"
        return EngineEvent(number, Failed(f"{self._name} ended unexpectedly; {then}"))
