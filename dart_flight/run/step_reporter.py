"""The application's side of the lockstep with a simulated world (`sim.lockstep`).

Whatever the application still has to do is open work: inputs that are queued, lock orders, requests to the
autopilot, plans. Each time that no work is open, a report goes to the world, which may then advance: by one
tick near a wall, elsewhere by a batch of 20 ms, whose samples are stepped together (`core.pace`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final

import msgspec

from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    CommandResult,
    ImuSample,
    Input,
    LockState,
    OdometrySample,
    OperatorRequest,
    PlanAnswer,
    PlanRequest,
    Setpoint,
)
from dart_flight.core.pace import BATCH_S
from dart_flight.sim.pipe import Stepped
from dart_flight.vehicle.clock import SimulatedTime

_STREAMS: Final[dict[type, str]] = {
    ImuSample: "imu",
    AttitudeSample: "attitude",
    OdometrySample: "odometry",
    ActuatorSample: "actuator",
}
_WORK: Final = (LockState, CommandResult, PlanAnswer, OperatorRequest)  # inputs that are not telemetry
_BATCH_US: Final = round(1e6 * BATCH_S)
_MARGIN_US: Final = (
    40_000  # at least from the answer to the beginning of its trajectory: later ones do not count
)
_UNUSED: Final = (None, None, None)


class StepReporter:
    """Reports to the simulated world what the application has done; every method from any thread.

    Args:
        send: writes one line to the world; must not block.

    Attributes:
        clock: simulated time.
    """

    def __init__(self, send: Callable[[bytes], object]) -> None:
        self.clock = SimulatedTime()
        self._send = send
        self._guard = threading.Lock()
        self._open = 0
        self._commands = 0
        self._plans: dict[int, int] = {}  # number of a request -> when its answer is due
        self._answers: list[PlanAnswer] = []  # that are not due yet
        self._batched = False
        self._hold_us = 0  # IMU samples stamped earlier wait for the rest of their batch
        self._streams: dict[str, int] = {}
        self._setpoint: tuple[float | None, ...] | None = None
        self._begun, self._flies = False, True

    def begin(self) -> None:
        """The streams are requested: from now on the world waits."""
        with self._guard:
            self._begun = True
            self._report()

    def end(self) -> None:
        """The application sends nothing more: the world goes on without it."""
        with self._guard:
            self._flies = False
            self._report()

    def open(self) -> None:
        """Something is to be done."""
        with self._guard:
            self._open += 1

    def completes_batch(self, item: Input) -> bool:
        """Whether to step an input of the vehicle, and what waits before it, now.

        The world knows what it has sent: these inputs are no open work.
        """
        with self._guard:
            return not self._hold_us or (isinstance(item, ImuSample) and item.t_us >= self._hold_us)

    def close(self, items: Sequence[Input] = (), batched: bool | None = None) -> None:
        """Something has been done.

        Args:
            items: inputs that are stepped; empty: a piece of other work.
            batched: whether the core steps the next samples in batches; None: as before.
        """
        with self._guard:
            if batched is not None:
                self._batched = batched
            for item in items:
                stream = _STREAMS.get(type(item))
                if stream is not None:
                    self._streams[stream] = max(item.t_us, self._streams.get(stream, 0))  # type: ignore[union-attr]
                elif isinstance(item, CommandResult):
                    self._commands -= 1
                elif isinstance(item, PlanAnswer):
                    self._plans.pop(item.number, None)
            self._open -= sum(isinstance(item, _WORK) for item in items) if items else 1
            if not self._open:
                self._report()

    def open_command(self) -> None:
        """A request goes to the autopilot; its `CommandResult` closes it."""
        with self._guard:
            self._commands += 1
            self._report()

    @contextmanager
    def command(self) -> Iterator[None]:
        """Send a request to the autopilot and wait for its result."""
        self.open_command()
        try:
            yield
        finally:
            with self._guard:
                self._commands -= 1
                self._report()

    def open_plan(self, request: PlanRequest, latency_us: int) -> None:
        """The planner works; its answer counts so long after the request, and closes it."""
        with self._guard:
            latest_us = max(request.begin_us - _MARGIN_US, request.t_us)
            self._plans[request.number] = min(latest_us, request.t_us + latency_us)

    def hold_answer(self, answer: PlanAnswer) -> None:
        """Keep an answer of the planner until it is due."""
        with self._guard:
            self._answers.append(answer)

    def due_answers(self) -> list[PlanAnswer]:
        """Return the answers that are due, once."""
        with self._guard:
            now_us = self.clock.host_us()
            due = [answer for answer in self._answers if self._plans.get(answer.number, 0) <= now_us]
            self._answers = [answer for answer in self._answers if answer not in due]
            return due

    def sent(self, setpoint: Setpoint) -> None:
        """A setpoint was handed to MAVSDK."""
        with self._guard:
            self._setpoint = (
                *setpoint.position_ned,
                *(setpoint.velocity_ned or _UNUSED),
                *(setpoint.acceleration_ned or _UNUSED),
            )

    def _report(self) -> None:
        if not self._begun:
            return
        due_us = min(self._plans.values(), default=None)
        imu_us = self._streams.get("imu")
        waits = bool(self._commands or self._plans)
        batch_us = _BATCH_US if self._batched and imu_us is not None and not waits else 0
        self._hold_us = 0 if imu_us is None or not batch_us else imu_us + batch_us
        report = Stepped(self._streams, self._setpoint, self._commands, due_us, batch_us, self._flies)
        self._send(msgspec.json.encode(report))
