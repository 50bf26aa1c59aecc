"""The kinds of time for the core's shell: real time, lockstep with a world, or simulated time in process.

In lockstep (`sim.lockstep`) the world waits for the application. The application counts its unfinished tasks:
queued inputs, lock orders, requests to the autopilot, plans. Whenever no task is left, the application sends
a report to the world. The world then advances: near a wall by one tick, elsewhere by 20 ms. The core
processes the samples of 20 ms as one batch (`core.pace`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import ClassVar, Final

import msgspec

from dart_flight.base.geometry import Vec3
from dart_flight.base.records import (
    CommandResult,
    ContactAnswer,
    ContactRequest,
    ImuSample,
    Input,
    PlanAnswer,
    PlanRequest,
    PoseSample,
    Setpoint,
)
from dart_flight.base.streams import SAMPLED_NAME
from dart_flight.core.pace import BATCH_S
from dart_flight.planning.contact_fit import FIT_US
from dart_flight.sim.pipe import Stepped
from dart_flight.vehicle.clock import Clock, SimulatedTime, host_us

Answer = PlanAnswer | ContactAnswer
_ANSWERS: Final[dict[type, type]] = {PlanRequest: PlanAnswer, ContactRequest: ContactAnswer}
_BATCH_US: Final = round(1e6 * BATCH_S)
_MARGIN_US: Final = 40_000  # shortest time from a planner's answer to the start of the answered trajectory
_UNUSED: Final = (None, None, None)


class RealTime:
    """Real time: no world waits, so the methods that count the application's tasks have no effect.

    A planner's answer is due immediately. Every method is thread-safe.

    Args:
        clock: relation of the autopilot's clock to the host's clock, or None if the session estimates this
            relation.
    """

    waits: ClassVar[bool] = False  # whether the world waits for the application

    def __init__(self, clock: Clock | None = None) -> None:
        self.clock = clock
        self.host_us: Callable[[], int] = host_us if clock is None else clock.host_us
        self._guard = threading.Lock()
        # Due time of an answer, by its kind and the request's number.
        self._due: dict[tuple[type, int], int] = {}
        self._answers: list[Answer] = []  # answers that are not due yet

    def begin(self) -> None:
        """Make the world wait for the application; call this after the streams are requested."""

    def end(self) -> None:
        """Let the world continue without the application, which must send nothing afterwards."""

    def open(self) -> None:
        """Count one more unfinished task; `close` removes the task."""

    def completes_batch(self, item: Input) -> bool:
        """Return whether the core must process this input now, because it completes a batch.

        Inputs from the vehicle are not counted as tasks, because the world counts the samples that it has
        sent.
        """
        return True

    def close(self, items: Sequence[Input] = (), work: int = 1, batched: bool | None = None) -> None:
        """Remove finished tasks from the count, and report to the world if no task is left.

        Args:
            work: number of finished tasks; telemetry does not count as a task.
            batched: whether the core processes the next samples in batches, or None for no change.
        """

    def open_command(self) -> None:
        """Count a request to the autopilot as unfinished until its `CommandResult` arrives."""

    @contextmanager
    def command(self) -> Iterator[None]:
        """Within the context, count a request to the autopilot as unfinished."""
        yield

    def open_request(self, request: PlanRequest | ContactRequest) -> None:
        """Count a request to a planner as unfinished until the core has processed the answer."""

    def hold_answer(self, answer: Answer) -> None:
        """Hold a planner's answer until it is due."""
        with self._guard:
            self._answers.append(answer)

    def due_answers(self) -> list[Answer]:
        """Remove and return the answers that are due, in the order of their due times."""
        if not self._answers:
            return []
        with self._guard:
            now_us = self.host_us()
            due = [(self._due.get((type(a), a.number), 0), a) for a in self._answers]
            self._answers = [answer for due_us, answer in due if due_us > now_us]
            return [answer for due_us, answer in sorted(due, key=lambda one: one[0]) if due_us <= now_us]

    def sent(self, setpoint: Setpoint) -> None:
        """Note a setpoint that was passed to MAVSDK."""

    def sent_pose(self, position_ned: Vec3) -> None:
        """Note a pose that was passed to MAVSDK."""


class InProcessTime(RealTime):
    """Simulated time for app and vehicle in one process; a planner's answer takes a fixed simulated time."""

    def __init__(self, clock: Clock, plan_us: int) -> None:
        super().__init__(clock)
        self._plan_us = plan_us

    def open_request(self, request: PlanRequest | ContactRequest) -> None:
        latency_us = self._plan_us if isinstance(request, PlanRequest) else FIT_US
        self._due[_ANSWERS[type(request)], request.number] = self.host_us() + latency_us


class LockstepTime(RealTime):
    """Simulated time of a world that waits for the application.

    Args:
        send: writes one line to the world; must not block.
        plan_us: time from a replanning request to its answer.
        batches: whether the world may advance by a batch of ticks in one step. This must be False if poses
            are forwarded: within a batch, the order of poses and samples would depend on the computer's load.
    """

    waits = True

    def __init__(self, send: Callable[[bytes], object], plan_us: int, batches: bool = True) -> None:
        super().__init__(SimulatedTime())
        self._send, self._plan_us, self._batches = send, plan_us, batches
        self._open = 0
        self._commands = 0
        self._batched = False
        self._hold_us = 0  # IMU samples with an earlier stamp wait until their batch is complete
        self._streams: dict[str, int] = {}
        self._sent: dict[str, tuple[float | None, ...]] = {}
        self._begun, self._flies = False, True

    def begin(self) -> None:
        with self._guard:
            self._begun = True
            self._report()

    def end(self) -> None:
        with self._guard:
            self._flies = False
            self._report()

    def open(self) -> None:
        with self._guard:
            self._open += 1

    def completes_batch(self, item: Input) -> bool:
        with self._guard:
            return not self._hold_us or (isinstance(item, ImuSample) and item.t_us >= self._hold_us)

    def close(self, items: Sequence[Input] = (), work: int = 1, batched: bool | None = None) -> None:
        with self._guard:
            if batched is not None:
                self._batched = batched and self._batches
            for item in items:
                stream = SAMPLED_NAME.get(type(item))
                if stream is not None:
                    self._streams[stream] = max(item.t_us, self._streams.get(stream, 0))  # type: ignore[union-attr]
                elif isinstance(item, PoseSample):
                    self._streams["pose"] = item.frame_number or 0
                elif isinstance(item, CommandResult):
                    self._commands -= 1
                elif isinstance(item, PlanAnswer | ContactAnswer):
                    self._due.pop((type(item), item.number), None)
            self._open -= work
            # Report even if commands are open: PX4 may need simulated time to answer a lock order.
            if not self._open or self._commands:
                self._report()

    def open_command(self) -> None:
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

    def open_request(self, request: PlanRequest | ContactRequest) -> None:
        """Count a request to a planner as unfinished until the core has processed the answer.

        If the trajectory begins before the end of the planner's latency, the plan is due shortly before the
        trajectory begins.
        """
        with self._guard:
            due_us = request.t_us + FIT_US
            if isinstance(request, PlanRequest):
                due_us = request.t_us + self._plan_us
                due_us = min(max(request.begin_us - _MARGIN_US, request.t_us), due_us)
            self._due[_ANSWERS[type(request)], request.number] = due_us

    def sent(self, setpoint: Setpoint) -> None:
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
