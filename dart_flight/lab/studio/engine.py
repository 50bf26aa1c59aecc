"""The engine of a studio page: kept warm processes that check, plan and fly texts.

One process checks, a second one plans and flies, so that a check never waits for a plan. The page's process
loads neither `dart_flight.vehicle` nor mavsdk; the engine's processes (`engine_process`) do. They exchange
JSON lines. If a process dies, it is started again, and the page gets `EngineDied`.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from pathlib import Path

import msgspec

from dart_flight.base.geometry import Vec3
from dart_flight.base.processes import ChildProcess
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.studio.scene_model import Scene, decode_scene

_MODULE = "dart_flight.lab.studio.engine_process"
_MOST_STARTS = 3  # starts in a row without a request that has ended


class Finding(msgspec.Struct):
    """A finding of `check`, or the error that keeps a file from loading.

    Attributes:
        item: name of the finding, as `check` prints it; `file` for an error of the file.
        word: `go`, `NO-GO`, `remark` or `error`.
        message: the finding in the words of the command.
        object: id of the object in the scene, or "" if the finding concerns the whole mission.
        objects: all objects that the finding concerns, the most important first.
    """

    item: str
    go: bool
    word: str
    message: str
    object: str = ""
    objects: list[str] = []


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


class EngineEvent(msgspec.Struct, tag=True):
    """An event of the engine; `number` is that of the request, 0 without one."""

    number: int = 0


class EngineReady(EngineEvent):
    """A process is warm."""


class Checked(EngineEvent):
    """A text has been checked.

    Attributes:
        go: whether `check` of stage `file` says go; for a scenario, whether it loads.
        scene: scene with predicted path and hits.
        stale: why the plan of the mission is stale, or None.
        materials: materials of the vehicle, for menus.
        modes: modes of the vehicle.
    """

    go: bool = False
    findings: list[Finding] = []
    scene: Scene | None = None
    stale: str | None = None
    materials: list[str] = []
    modes: list[str] = []


class PlanProgress(EngineEvent):
    """Candidates tried so far, and in all (None: unknown); `message` names what is going on."""

    done: int = 0
    of: int | None = None
    message: str = ""


class PlanRow(msgspec.Struct):
    """A plan.

    Attributes:
        rank: 1 is the best; 0 is the free flight, without a hit.
        values: quantities by name, with unit, as the command's table shows them.
        paths: lines (n, 3) of the predicted path, in no order.
        mission: text of the mission, or "" if it is refused.
        refused: why the mission is refused, or None.
        go: whether `check` of stage `file` says go for the mission.
        problem: its first no-go, or "".
    """

    rank: int
    summary: str
    values: dict[str, str]
    paths: list[Array]
    mission: str
    refused: str | None = None
    time_s: float | None = None
    saving_s: float | None = None
    go: bool = False
    problem: str = ""


class Planned(EngineEvent):
    """The search has ended.

    Attributes:
        refused: number of refused candidates by reason.
        advice: what to relax, by the same reason.
        free: the flight without a hit, or None.
        error: why there is no plan, or None.
    """

    plans: list[PlanRow] = []
    refused: dict[str, int] = {}
    advice: dict[str, str] = {}
    free: PlanRow | None = None
    summary: str = ""
    error: str | None = None
    cancelled: bool = False


class FlownOne(msgspec.Struct):
    """One flight.

    Attributes:
        outcome: completed, aborted or released.
        reason: why it did not complete, or None.
        path: true path, (n, 3).
        hits: places of the hits.
        log: the flight's log, or None without one.
    """

    seed: int
    outcome: str
    reason: str | None
    path: Array
    hits: list[Vec3] = []
    log: str | None = None
    goal_miss_m: float | None = None
    peak_force_n: float | None = None


class FlyProgress(EngineEvent):
    """Flights that have landed since the last event."""

    done: int = 0
    of: int = 0
    completed: int = 0
    landed: list[FlownOne] = []


class FlightsFlown(EngineEvent):
    """All flights have landed, or were cancelled.

    Attributes:
        summary: result in one line.
        error: why the flights could not be flown, or None.
    """

    done: int = 0
    completed: int = 0
    reasons: dict[str, int] = {}
    summary: str = ""
    error: str | None = None
    cancelled: bool = False


class EngineDied(EngineEvent):
    """The process has ended; it is started again. A plan or flights in progress are lost, the text is not."""

    message: str = ""


class CheckQuery(msgspec.Struct, tag=True):
    """A text to check; `path` is its file."""

    number: int
    path: str
    text: str


class PlanQuery(msgspec.Struct, tag=True):
    """A scenario's text to plan; `objective` replaces that of the scenario."""

    number: int
    path: str
    text: str
    objective: str | None
    within_s: float
    top: int


class FlightsQuery(msgspec.Struct, tag=True):
    """A mission's text to fly; logs are written below `log_dir`."""

    number: int
    path: str
    text: str
    fly: FlyRequest
    log_dir: str


AnyQuery = CheckQuery | PlanQuery | FlightsQuery
AnyEvent = EngineReady | Checked | PlanProgress | Planned | FlyProgress | FlightsFlown


class Engine:
    """The engine of one page.

    Args:
        path: the open file; relative names in its text are relative to its folder. It may be replaced.
        on_event: called with every event, on a thread of the engine, one at a time.
        log_dir: folder for logs of flights.
    """

    def __init__(
        self, path: Path, on_event: Callable[[EngineEvent], None], log_dir: Path = Path("logs")
    ) -> None:
        self.path, self.log_dir = path, log_dir
        self._on_event, self._one_at_a_time = on_event, threading.RLock()
        self._numbers = itertools.count(1)
        self._checker = _Worker("the process that checks", self._deliver)
        self._worker = _Worker("the process that plans and flies", self._deliver)

    def check(self, text: str) -> int:
        """Check a text; return the number of the request. A newer request replaces one that waits."""
        number = next(self._numbers)
        self._checker.send(CheckQuery(number, str(self.path), text))
        return number

    def plan(self, text: str, objective: str | None = None, within_s: float = 60.0, top: int = 10) -> int:
        """Plan a scenario's text; ends with `Planned`. A plan or flights in progress are cancelled first."""
        self.cancel()
        number = next(self._numbers)
        self._worker.send(PlanQuery(number, str(self.path), text, objective, within_s, top))
        return number

    def fly(self, text: str, request: FlyRequest) -> int:
        """Fly a mission's text in the fast world; ends with `FlightsFlown`. Cancel what is in progress."""
        self.cancel()
        number = next(self._numbers)
        folder = str(self.log_dir.absolute())
        self._worker.send(FlightsQuery(number, str(self.path), text, request, folder))
        return number

    def cancel(self) -> None:
        """Cancel the plan or the flights in progress, if any: `Planned` or `FlightsFlown` follows at once."""
        self._worker.cancel()

    def close(self) -> None:
        """End the processes."""
        self._checker.close()
        self._worker.close()

    def _deliver(self, event: EngineEvent) -> None:
        with self._one_at_a_time:
            self._on_event(event)


class _Worker:
    """A process that answers one request after the other; the newest request replaces one that waits.

    Args:
        name: the process, in messages.
        deliver: callback for its events.
    """

    def __init__(self, name: str, deliver: Callable[[EngineEvent], None]) -> None:
        self._name, self._deliver = name, deliver
        self._lock = threading.RLock()
        self._open: AnyQuery | None = None  # the request in progress
        self._waiting: AnyQuery | None = None
        self._landed = (0, 0)  # flights that have landed, and those that completed
        self._starts, self._closing = 0, False
        self._process: ChildProcess | None = None
        self._start()

    def send(self, request: AnyQuery) -> None:
        with self._lock:
            if self._process is None and not self._closing:
                self._starts = 0
                self._start()
            self._waiting = request
            self._send_next()

    def cancel(self) -> None:
        """End the request in progress by ending the process, which starts again."""
        with self._lock:
            request, self._open, self._waiting = self._open, None, None
            if request is None or self._process is None:
                return
            self._starts = 0
            self._end_process()
            self._start()
        self._deliver(self._ended(request, cancelled=True))

    def close(self) -> None:
        with self._lock:
            self._closing, self._open, self._waiting = True, None, None
            self._end_process()

    def _end_process(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()

    def _start(self) -> None:
        self._starts += 1
        started: list[ChildProcess] = []
        ready = threading.Event()

        def receive(line: bytes) -> None:
            ready.wait()
            self._receive(started[0], line)

        process = ChildProcess(_MODULE, b"", receive)
        started.append(process)
        self._process = process
        ready.set()

    def _send_next(self) -> None:
        if self._open is None and self._waiting is not None and self._process is not None:
            self._open, self._waiting, self._landed = self._waiting, None, (0, 0)
            if not self._process.send(msgspec.json.encode(self._open)):
                self._process.kill()  # the request did not fit into the pipe, or the process has ended

    def _receive(self, process: ChildProcess, line: bytes) -> None:
        if not line:
            process.wait()
            self._restart(process)
            return
        try:
            event = msgspec.json.decode(line, type=AnyEvent, dec_hook=decode_scene)
        except msgspec.MsgspecError:
            return
        with self._lock:
            if process is not self._process or (event.number and self._open is None):
                return  # an event of a cancelled request
            if isinstance(event, FlyProgress):
                self._landed = (event.done, event.completed)
            if isinstance(event, Checked | Planned | FlightsFlown):
                self._open, self._starts = None, 0
                self._send_next()
        self._deliver(event)

    def _restart(self, process: ChildProcess) -> None:
        with self._lock:
            if process is not self._process or self._closing:
                return
            request, self._open, self._process = self._open, None, None
            again = self._starts < _MOST_STARTS
            if again:
                self._start()
            repeats = again and isinstance(request, CheckQuery) and self._starts < _MOST_STARTS
            if repeats and self._waiting is None:
                self._waiting = request
            self._send_next()
        then = "it was started again" if again else "the next request starts it"
        self._deliver(EngineDied(message=f"{self._name} ended unexpectedly; {then}"))
        if request is not None and not repeats:
            self._deliver(self._ended(request, cancelled=False))

    def _ended(self, request: AnyQuery, *, cancelled: bool) -> EngineEvent:
        """Return the last event of a request whose process has ended."""
        problem = None if cancelled else f"{self._name} ended unexpectedly"
        if isinstance(request, CheckQuery):
            return Checked(request.number, findings=[Finding("file", False, "error", problem or "cancelled")])
        if isinstance(request, PlanQuery):
            return Planned(
                request.number, error=problem, cancelled=cancelled, summary="cancelled" * cancelled
            )
        done, completed = self._landed
        summary = f"cancelled after {done} of {request.fly.flights} flights" if cancelled else ""
        return FlightsFlown(
            request.number, done, completed, summary=summary, error=problem, cancelled=cancelled
        )
