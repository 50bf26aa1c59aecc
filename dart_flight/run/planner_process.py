"""Planner of a flight over MAVSDK, in its own process so that planning does not delay the core.

The process reads requests, wall estimates and frame corrections as lines of JSON, and writes answers. One
process plans and a second process fits contacts, so that a plan does not wait for a fit. If a planner dies or
hangs, the flight continues with the paper's recovery setpoint, without new estimates of walls and modes.
`FlightApp` starts the processes.
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
from dart_flight.base.records import (
    AfterImpact,
    ContactAnswer,
    ContactRequest,
    FrameAnchor,
    PlanAnswer,
    PlanRequest,
    WallEstimate,
)
from dart_flight.config.mission import Mission
from dart_flight.planning.contact_fit import ContactFitter
from dart_flight.planning.replanner import Replanner
from dart_flight.vehicle.clock import host_us

PlanItem = PlanRequest | ContactRequest | WallEstimate | FrameAnchor
_NICE = 5  # planning has a lower priority than the flight, whose setpoints come first
_END_S = 1.0
# Every line begins with one of these letters. The first line gives the kind of the requests, and the mission.
_KINDS: dict[type[PlanItem], bytes] = {
    ContactRequest: b"c",
    FrameAnchor: b"a",
    PlanRequest: b"p",
    WallEstimate: b"w",
}


class PlannerProcess:
    """Process that plans trajectories for one mission, or fits the contacts of that mission.

    Args:
        deliver: callback for every answer, on a thread of the planner; must not block.
        host_us: returns the host's time; in lockstep this is simulated time.
    """

    def __init__(
        self,
        mission: Mission,
        kind: type[PlanRequest | ContactRequest],
        deliver: Callable[[PlanAnswer | ContactAnswer], None],
        host_us: Callable[[], int] = host_us,
    ) -> None:
        self._deliver, self._host_us = deliver, host_us
        self._answer: type[PlanAnswer | ContactAnswer] = PlanAnswer if kind is PlanRequest else ContactAnswer
        self._open: dict[int, PlanRequest | ContactRequest] = {}
        self.process = ChildProcess(__name__, _KINDS[kind] + msgspec.json.encode(mission), self._receive)

    def send(self, item: PlanItem) -> None:
        """Send without blocking. If the planner has died, answer immediately with a `problem`."""
        if isinstance(item, PlanRequest | ContactRequest):
            self._open[item.number] = item
        if self.process.poll() is not None or not self.process.send(
            _KINDS[type(item)] + msgspec.json.encode(item)
        ):
            self._answer_open()

    def stop(self) -> None:
        self.process.end(_END_S)

    def _answer_open(self) -> None:
        """Answer the requests that were open when the planner died."""
        while self._open:
            with contextlib.suppress(KeyError):  # another thread has just answered the last request
                number, request = self._open.popitem()
                now_us, problem = self._host_us(), "the planner process ended"
                if isinstance(request, PlanRequest):
                    self._deliver(PlanAnswer(now_us, number, request.begin_us, problem=problem))
                else:
                    self._deliver(ContactAnswer(now_us, number, problem=problem))

    def _receive(self, line: bytes) -> None:
        if not line:
            self._answer_open()
            return
        with contextlib.suppress(msgspec.MsgspecError):
            answer = msgspec.json.decode(line, type=self._answer)
            self._open.pop(answer.number, None)
            self._deliver(msgspec.structs.replace(answer, received_us=self._host_us()))


class Planner:
    """Plans trajectories for one mission, or fits the contacts of that mission, in the calling thread."""

    def __init__(self, mission: Mission, kind: type[PlanRequest | ContactRequest]) -> None:
        self._replanner = Replanner(mission) if kind is PlanRequest else None
        self._fitter = ContactFitter(mission.vehicle) if kind is ContactRequest else None

    def take(self, item: PlanItem) -> PlanAnswer | ContactAnswer | None:
        """Return the answer to a request; store a wall's estimate or a new frame."""
        if self._fitter is not None:
            return self._fitter.answer(item) if isinstance(item, ContactRequest) else None
        assert self._replanner is not None
        if isinstance(item, PlanRequest):
            return self._replanner.answer(item)
        if isinstance(item, WallEstimate):
            self._replanner.update_wall(item)
        elif isinstance(item, FrameAnchor):
            self._replanner.move_frame(item)
        return None


def kinds_of_requests(mission: Mission) -> list[type[PlanRequest | ContactRequest]]:
    """Return the kinds of requests that the core makes on this mission."""
    kinds = list[type[PlanRequest | ContactRequest]]()
    if mission.walls or mission.collisions:
        kinds.append(ContactRequest)
    if mission.after_impact is AfterImpact.REPLAN:
        kinds.append(PlanRequest)
    return kinds


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer requests until the stream ends; the first line has the kind of the requests and the mission."""
    first = requests.readline()
    kind = PlanRequest if first.startswith(_KINDS[PlanRequest]) else ContactRequest
    planner = Planner(msgspec.json.decode(first[1:], type=Mission), kind)
    kinds = {letter: kind for kind, letter in _KINDS.items()}
    for line in requests:
        answer = planner.take(msgspec.json.decode(line[1:], type=kinds[line[:1]]))
        if answer is not None:
            answers.write(msgspec.json.encode(answer) + b"\n")
            answers.flush()


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(_NICE)
    serve(sys.stdin.buffer, sys.stdout.buffer)
