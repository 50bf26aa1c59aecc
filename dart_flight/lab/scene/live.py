"""The part of a live view in the flight's process: it passes on records and never waits for viewers.

The flight's own thread only checks the type of a record and appends the record to a queue. A thread of this
module downsamples, encodes and writes to a non-blocking pipe; records that do not fit are dropped and
counted. Translation, WebSocket and viewers run in a separate process (`scene.server`). If that process fails,
the flight prints a line and continues.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import queue
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable

import msgspec

from dart_flight.base.processes import ChildProcess
from dart_flight.base.records import Record
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.packages import missing_package
from dart_flight.lab.scene.downsampling import WANTED, Downsampler
from dart_flight.recording.encoding import encode

_START_S = 30.0
_TURN_S = 0.03
_END_S = 2.0
_MAX_WAITING = 4096  # maximum number of queued records, about four seconds of a flight
_MAX_BYTES = 1 << 18  # maximum number of encoded bytes not yet written to the pipe


class LiveViewSpec(msgspec.Struct):
    """The content and the address of a live view.

    Attributes:
        host, port: address to listen on.
        frame_known: whether the origin of the mission frame is known from the beginning of the flight. If
            not, the flight's anchor record provides the origin.
        from_truth: whether to show the true pose of a simulated vehicle (`SceneTranslator`).
    """

    mission: Mission
    host: str
    port: int
    show_room: bool = True
    frame_known: bool = False
    from_truth: bool = False


class PortStatus(msgspec.Struct):
    """The open port, or the problem that prevented the process from opening it."""

    port: int | None = None
    problem: str = ""


class LiveViewProcess:
    """A live view of one flight; call the object with every record.

    Args:
        print_line: called with lines for the terminal, on a thread of the view.

    Attributes:
        port: port for viewers.
        dropped: number of records dropped because the process of the view was too slow.

    Raises:
        InputError: foxglove-sdk is missing, or the port cannot be opened.
    """

    def __init__(self, show: LiveViewSpec, print_line: Callable[[str], None]) -> None:
        if importlib.util.find_spec("foxglove") is None:
            raise missing_package("--live needs foxglove-sdk", "live")
        self._say = print_line
        self.dropped = 0
        self._waiting: deque[Record] = deque()
        self._thinning = Downsampler()
        self._unsent = bytearray()
        self._closing = threading.Event()
        output: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        first = msgspec.json.encode(show)
        self.process = ChildProcess("dart_flight.lab.scene.server", first, output.put, subprocess.DEVNULL)
        self.port = self._await_port(show, output)
        self._thread = threading.Thread(target=self._run, name="live view", daemon=True)
        self._thread.start()

    def _await_port(self, show: LiveViewSpec, output: queue.SimpleQueue[bytes]) -> int:
        line = b""
        with contextlib.suppress(queue.Empty):
            line = output.get(timeout=_START_S)
        opened = (
            msgspec.json.decode(line, type=PortStatus)
            if line
            else PortStatus(problem="the process did not start")
        )
        if opened.port is None:
            self.process.end(_END_S)
            where = f"{show.host}:{show.port}"
            if "in use" in opened.problem:
                raise InputError(
                    f"port {show.port} is in use; choose another port with --live-port", source=where
                )
            raise InputError(f"no live view: {opened.problem}", source=where)
        return opened.port

    def __call__(self, record: Record) -> None:
        """Queue a record, from any thread and without blocking."""
        if type(record) in WANTED:
            if len(self._waiting) >= _MAX_WAITING:
                self.dropped += 1
            else:
                self._waiting.append(record)

    def feed(self, record: Record) -> None:
        """Queue a record that was read from a log, and wait if the queue is full."""
        while len(self._waiting) >= _MAX_WAITING and self._thread.is_alive():
            time.sleep(_TURN_S)
        self(record)

    def close(self) -> None:
        self._closing.set()
        self._thread.join(_END_S)
        self.process.end(_END_S)
        if self.dropped:
            self._say(f"live view: {self.dropped} records dropped because the viewer was too slow")

    def _run(self) -> None:
        while not self._closing.wait(_TURN_S):
            if not self._pass_on():
                self._say("live view failed; the flight continues without it")
                return
        self._pass_on()

    def _pass_on(self) -> bool:
        """Write waiting records until the pipe is full; return False if the process has ended."""
        while self._waiting and len(self._unsent) < _MAX_BYTES:
            for record in self._thinning.select(self._waiting.popleft()):
                self._unsent += record.topic.encode() + b" " + encode(record) + b"\n"
        try:
            while self._unsent:
                del self._unsent[: os.write(self.process.pipe, self._unsent)]
        except BlockingIOError:
            pass
        except OSError:
            return False
        return self.process.poll() is None


def open_live_view(
    mission: Mission,
    host: str,
    port: int,
    show_room: bool,
    frame_known: bool,
    from_truth: bool,
    print_line: Callable[[str], None],
) -> LiveViewProcess:
    return LiveViewProcess(LiveViewSpec(mission, host, port, show_room, frame_known, from_truth), print_line)
