"""The planner of a flight in real time: a process of its own, so that its computing costs the core nothing.

Requests, and what was felt before them, go in and answers come out as lines of JSON. A planner that dies or
hangs is a planner that does not answer: the flight goes on by the paper's setpoint.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable
from typing import BinaryIO

import msgspec

from dart_flight.base.processes import ChildProcess
from dart_flight.base.records import FrameAnchor, PlanAnswer, PlanRequest, WallEstimate
from dart_flight.config.mission import Mission
from dart_flight.planning.replanner import Replanner
from dart_flight.vehicle.clock import host_us

_NICE = 5  # below the flight: setpoints go first
_END_S = 1.0
_FELT, _MOVED, _ASKED = b"w", b"a", b"p"  # what a line holds
_KINDS: dict[type, bytes] = {WallEstimate: _FELT, FrameAnchor: _MOVED, PlanRequest: _ASKED}


class ReplannerProcess:
    """Planner of one mission.

    Args:
        mission: what is flown.
        deliver: takes every answer, on a thread of the planner's; must not block.
        host_us: function that returns the host's time in microseconds, or simulated time in lockstep.

    Raises:
        OSError: the process cannot be started.
    """

    def __init__(
        self,
        mission: Mission,
        deliver: Callable[[PlanAnswer], None],
        host_us: Callable[[], int] = host_us,
    ) -> None:
        self._deliver, self._host_us = deliver, host_us
        self._open: dict[int, PlanRequest] = {}
        self.process = ChildProcess(__name__, msgspec.json.encode(mission), self._take)

    def send(self, item: PlanRequest | WallEstimate | FrameAnchor) -> None:
        """Send a request, or pass on what a contact has taught or moved the frame by; never blocks.

        Where there is no planner any more the answer to a request says so at once.
        """
        if isinstance(item, PlanRequest):
            self._open[item.number] = item
        if self.process.poll() is not None or not self.process.send(
            _KINDS[type(item)] + msgspec.json.encode(item)
        ):
            self._answer_open()

    def stop(self) -> None:
        """End it."""
        self.process.end(_END_S)

    def _answer_open(self) -> None:
        """Answer the requests that were open when the planner died."""
        while self._open:
            with contextlib.suppress(KeyError):  # another thread has answered the request
                _, request = self._open.popitem()
                problem = "the planner has died"
                self._deliver(PlanAnswer(self._host_us(), request.number, request.begin_us, problem=problem))

    def _take(self, line: bytes) -> None:
        if not line:
            self._answer_open()
            return
        with contextlib.suppress(msgspec.MsgspecError):
            answer = msgspec.json.decode(line, type=PlanAnswer)
            self._open.pop(answer.number, None)
            self._deliver(msgspec.structs.replace(answer, received_us=self._host_us()))


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer requests until there are no more; the first line is the mission."""
    replanner = Replanner(msgspec.json.decode(requests.readline(), type=Mission))
    for line in requests:
        if line.startswith(_FELT):
            replanner.update_wall(msgspec.json.decode(line[1:], type=WallEstimate))
        elif line.startswith(_MOVED):
            replanner.move_frame(msgspec.json.decode(line[1:], type=FrameAnchor))
        else:
            request = msgspec.json.decode(line[1:], type=PlanRequest)
            answers.write(msgspec.json.encode(replanner.answer(request, 0)) + b"\n")
            answers.flush()


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(_NICE)
    serve(sys.stdin.buffer, sys.stdout.buffer)
