"""The flight's end of a live view: hands over records without ever waiting for whoever looks.

On the flight's own thread a record costs one look at its type and one append. A thread of this module thins
out, encodes and writes to a pipe that never blocks; what does not fit is dropped and counted. Translation,
WebSocket and viewers are in a process of their own (`scene.server`): its death is a line on the terminal.
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
_MAX_WAITING = 4096  # records; four seconds of a flight
_MAX_BYTES = 1 << 18  # encoded and not yet in the pipe


class LiveViewSpec(msgspec.Struct):
    """What the process is to show, and where.

    Attributes:
        mission: whose room and vehicle it is.
        host, port: to listen at.
        show_room: whether the mission's room is to be seen.
        frame_known: the mission's frame lies where the mission says, from the beginning on.
        from_truth: a simulated vehicle alone, shown as it really flies.
    """

    mission: Mission
    host: str
    port: int
    show_room: bool = True
    frame_known: bool = False
    from_truth: bool = False


class PortStatus(msgspec.Struct):
    """Whether the port is open."""

    port: int | None = None
    problem: str = ""


class LiveViewProcess:
    """A live view of one flight; call it with every record.

    Args:
        show: what, and where.
        say: takes a line for the terminal, on a thread of the view's.

    Attributes:
        port: that viewers connect to.
        dropped: records that were left out because the process did not keep up.

    Raises:
        InputError: foxglove-sdk is missing, or the port cannot be opened.
    """

    def __init__(self, show: LiveViewSpec, say: Callable[[str], None]) -> None:
        if importlib.util.find_spec("foxglove") is None:
            raise missing_package("--live needs foxglove-sdk", "live")
        self._say = say
        self.dropped = 0
        self._waiting: deque[Record] = deque()
        self._thinning = Downsampler()
        self._unsent = bytearray()
        self._closing = threading.Event()
        said: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        first = msgspec.json.encode(show)
        self.process = ChildProcess("dart_flight.lab.scene.server", first, said.put, subprocess.DEVNULL)
        self.port = self._await_port(show, said)
        self._thread = threading.Thread(target=self._run, name="live view", daemon=True)
        self._thread.start()

    def _await_port(self, show: LiveViewSpec, said: queue.SimpleQueue[bytes]) -> int:
        line = b""
        with contextlib.suppress(queue.Empty):
            line = said.get(timeout=_START_S)
        opened = (
            msgspec.json.decode(line, type=PortStatus) if line else PortStatus(problem="it did not start")
        )
        if opened.port is None:
            self.process.end(_END_S)
            where = f"{show.host}:{show.port}"
            if "in use" in opened.problem:
                raise InputError(f"port {show.port} is in use, choose another with --live-port", source=where)
            raise InputError(f"no live view: {opened.problem}", source=where)
        return opened.port

    def __call__(self, record: Record) -> None:
        """Take a record; any thread, never blocks."""
        if type(record) in WANTED:
            if len(self._waiting) >= _MAX_WAITING:
                self.dropped += 1
            else:
                self._waiting.append(record)

    def feed(self, record: Record) -> None:
        """As a call, for those who may wait: whoever reads a log that was written long before."""
        while len(self._waiting) >= _MAX_WAITING and self._thread.is_alive():
            time.sleep(_TURN_S)
        self(record)

    def close(self) -> None:
        """The flight is over; says how much was left out."""
        self._closing.set()
        self._thread.join(_END_S)
        self.process.end(_END_S)
        if self.dropped:
            self._say(f"live view: {self.dropped} records dropped, the viewer was too slow")

    def _run(self) -> None:
        while not self._closing.wait(_TURN_S):
            if not self._pass_on():
                self._say("live view failed; the flight continues without it")
                return
        self._pass_on()

    def _pass_on(self) -> bool:
        """Hand over what waits, as far as the pipe takes it; False where nobody is there any more."""
        while self._waiting and len(self._unsent) < _MAX_BYTES:
            for record in self._thinning.take(self._waiting.popleft()):
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
    furnished: bool,
    placed: bool,
    from_truth: bool,
    say: Callable[[str], None],
) -> LiveViewProcess:
    """A live view (`LiveViewSpec`), opened; raises what `LiveViewProcess` raises."""
    return LiveViewProcess(LiveViewSpec(mission, host, port, furnished, placed, from_truth), say)
