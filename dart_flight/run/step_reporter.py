"""The application's side of the lockstep with a simulated world (`sim.lockstep`).

The reporter counts the tasks that the application has not finished: queued inputs, lock orders, requests to
the autopilot, plans. Whenever no task is left, the reporter sends a report to the world, which may then
advance. Near a wall the world advances by one tick. Away from walls the world advances by 20 ms, and the core
then steps all samples of these 20 ms together as a batch (`core.pace`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final

import msgspec

from dart_flight.base.geometry import Vec3
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    CommandResult,
    ContactAnswer,
    ContactRequest,
    ImuSample,
    Input,
    OdometrySample,
    PlanAnswer,
    PlanRequest,
    PoseSample,
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
_ANSWERS: Final[dict[type, type]] = {PlanRequest: PlanAnswer, ContactRequest: ContactAnswer}
_BATCH_US: Final = round(1e6 * BATCH_S)
_MARGIN_US: Final = 40_000  # an answer must precede its trajectory by at least this time
_UNUSED: Final = (None, None, None)


class StepReporter:
    """Reporter of the application's progress to the simulated world; all methods are thread-safe.

    Args:
        send: writes one line to the world; must not block.
        batches: whether the world may advance by a batch of ticks at once. This must be False if poses are
            forwarded, because the order of poses and samples in a batch would depend on the computer's load.
    """

    def __init__(self, send: Callable[[bytes], object], batches: bool = True) -> None:
        self.clock = SimulatedTime()
        self._batches = batches
        self._send = send
        self._guard = threading.Lock()
        self._open = 0
        self._commands = 0
        # Due time of an answer, by its kind and the number of the request.
        self._due: dict[tuple[type, int], int] = {}
        self._answers: list[PlanAnswer | ContactAnswer] = []  # answers that are not due yet
        self._batched = False
        self._hold_us = 0  # IMU samples with an earlier stamp wait until their batch is complete
        self._streams: dict[str, int] = {}
        self._sent: dict[str, tuple[float | None, ...]] = {}
        self._begun, self._flies = False, True

    def begin(self) -> None:
        """Make the world wait for the application; call this after the streams are requested."""
        with self._guard:
            self._begun = True
            self._report()

    def end(self) -> None:
        """Let the world continue without the application, which must send nothing afterwards."""
        with self._guard:
            self._flies = False
            self._report()

    def open(self) -> None:
        """Count one more unfinished task; `close` removes the task."""
        with self._guard:
            self._open += 1

    def completes_batch(self, item: Input) -> bool:
        """Return whether this input from the vehicle completes a batch, so that the core must process it now.

        Inputs from the vehicle are not counted as tasks, because the world itself counts what it has sent.
        """
        with self._guard:
            return not self._hold_us or (isinstance(item, ImuSample) and item.t_us >= self._hold_us)

    def close(self, items: Sequence[Input] = (), work: int = 1, batched: bool | None = None) -> None:
        """Remove finished tasks from the count, and report to the world if no task is left.

        Args:
            work: number of finished tasks; telemetry does not count as a task.
            batched: whether the core processes the next samples in batches, or None for no change.
        """
        with self._guard:
            if batched is not None:
                self._batched = batched and self._batches
            for item in items:
                stream = _STREAMS.get(type(item))
                if stream is not None:
                    self._streams[stream] = max(item.t_us, self._streams.get(stream, 0))  # type: ignore[union-attr]
                elif isinstance(item, PoseSample):
                    self._streams["pose"] = item.frame_number or 0
                elif isinstance(item, CommandResult):
                    self._commands -= 1
                elif isinstance(item, PlanAnswer | ContactAnswer):
                    self._due.pop((type(item), item.number), None)
            self._open -= work
            # Report even if commands are open: a lock order may wait for PX4, which needs time to advance.
            if not self._open or self._commands:
                self._report()

    def open_command(self) -> None:
        """Count a request to the autopilot as unfinished until its `CommandResult` arrives."""
        with self._guard:
            self._commands += 1
            self._report()

    @contextmanager
    def command(self) -> Iterator[None]:
        self.open_command()
        try:
            yield
        finally:
            with self._guard:
                self._commands -= 1
                self._report()

    def open_request(self, request: PlanRequest | ContactRequest, latency_us: int) -> None:
        """Count a request to a planner as unfinished until the core has processed the answer.

        The answer is due `latency_us` after the request. If the planned trajectory begins before this time,
        the plan is due shortly before the trajectory begins.
        """
        with self._guard:
            due_us = request.t_us + latency_us
            if isinstance(request, PlanRequest):
                due_us = min(max(request.begin_us - _MARGIN_US, request.t_us), due_us)
            self._due[_ANSWERS[type(request)], request.number] = due_us

    def hold_answer(self, answer: PlanAnswer | ContactAnswer) -> None:
        """Store an answer of the planner until it is due."""
        with self._guard:
            self._answers.append(answer)

    def due_answers(self) -> list[PlanAnswer | ContactAnswer]:
        """Remove and return the answers that are due."""
        with self._guard:
            now_us = self.clock.host_us()
            due = [a for a in self._answers if self._due.get((type(a), a.number), 0) <= now_us]
            self._answers = [answer for answer in self._answers if answer not in due]
            return due

    def sent(self, setpoint: Setpoint) -> None:
        """Store the values of the setpoint that was passed to MAVSDK."""
        with self._guard:
            self._sent["setpoint"] = (
                *setpoint.position_ned,
                *(setpoint.velocity_ned or _UNUSED),
                *(setpoint.acceleration_ned or _UNUSED),
            )

    def sent_pose(self, position_ned: Vec3) -> None:
        with self._guard:
            self._sent["pose"] = position_ned

    def _report(self) -> None:
        if not self._begun:
            return
        due_us = min(self._due.values(), default=None)
        imu_us = self._streams.get("imu")
        waits = bool(self._commands or self._due)
        batch_us = _BATCH_US if self._batched and imu_us is not None and not waits else 0
        self._hold_us = 0 if imu_us is None or not batch_us else imu_us + batch_us
        report = Stepped(self._streams, self._sent, self._commands, due_us, batch_us, self._flies)
        self._send(msgspec.json.encode(report))
