"""A scripted end of the link for the programs that hold it: the app of a flight, and standby.

The fixture `fly_app` runs an app on a `ScriptedSession`, with a core that does nothing by itself. Tests give
the app inputs by its public methods, signals and buttons, and look at its records and at the session.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from typing import Any, TypeVar

from dart_flight.base.records import (
    Input,
    MissionEnd,
    OperatorRequest,
    Outcome,
    Output,
    Record,
    Request,
    Setpoint,
    StatusText,
    Tick,
    VehicleAction,
)
from dart_flight.config.mission import Mission
from dart_flight.core.pace import Pace
from dart_flight.run.app import AppOptions, FlightApp, WorldLink
from dart_flight.vehicle.clock import ClockEstimate, host_us
from dart_flight.vehicle.command_server import Press, Result
from tests.real_time import TooSlow

_PATIENCE_S = 20.0
_R = TypeVar("_R", bound=Record)


class ScriptedSession:
    """A double of the vehicle session.

    Args:
        problem: the vehicle's answer to an action.
        unanswered: requests that the vehicle does not answer.
        armed_checks: number of looks at the end of a flight for which the vehicle stays armed.

    Attributes:
        calls: what the program sent: setpoints, actions, texts, outputs of PX4 and `silence`.
        answered: answers to the pressed buttons.
        messages: MAVLink messages that the program sent.
        motors: number of motors in the subscription, or 0 before it.
        sending_fails: error of every setpoint, or None.
        hangs: whether actions are never answered.
    """

    def __init__(self, problem: str = "", unanswered: Iterable[str] = (), armed_checks: int = 0) -> None:
        self.calls: list[object] = []
        self.answered: list[tuple[Result, str]] = []
        self.messages: list[Any] = []
        self.motors = 0
        self.clock = ClockEstimate()
        self.sending_fails: Exception | None = None
        self.hangs = False
        self._problem, self._unanswered, self._armed_checks = problem, list(unanswered), armed_checks
        self._answer: Callable[[Press], tuple[Result, str]] | None = None
        self._listeners: dict[str, Callable[[Any, Any], None]] = {}

    # -- the test's side --

    def press(self, button: int, value: int = 0) -> tuple[Result, str]:
        """Press a button of the ground station."""
        assert self._answer is not None, "the program serves no operator"
        self.answered.append(self._answer(Press(button, value)))
        return self.answered[-1]

    def deliver(self, message: str, value: Any) -> None:
        """Deliver a decoded message to the program."""
        self._listeners[message](value, None)

    @property
    def texts(self) -> list[str]:
        """Texts that the program sent to the ground station."""
        return [call for call in self.calls if isinstance(call, str) and call != "silence"]

    # -- as `VehicleSession` --

    @property
    def armed(self) -> bool:
        self._armed_checks -= 1
        return self._armed_checks >= 0

    def send(self, setpoint: Setpoint) -> None:
        if self.sending_fails is not None:
            raise self.sending_fails
        self.calls.append(setpoint)

    def silence(self) -> None:
        self.calls.append("silence")

    def set_actuator(self, index: int, value: float) -> None:
        self.calls.append((index, value))

    def send_text(self, text: str) -> None:
        self.calls.append(text)

    def send_message(self, message: Any) -> None:
        self.messages.append(message)

    async def perform(self, action: VehicleAction) -> str:
        self.calls.append(action)
        if self.hangs:
            await asyncio.sleep(60.0)
        return self._problem

    async def measure_link(self, timeout_s: float) -> list[str]:
        return self._unanswered

    async def keep_measuring(self) -> None:
        await asyncio.sleep(60.0)

    def serve_operator(self, system_id: int, answer: Callable[[Press], tuple[Result, str]]) -> None:
        self._answer = answer

    def listen(self, entry: Any, handle: Callable[[Any, Any], None]) -> None:
        self._listeners[entry.message] = handle

    def subscribe(self, estimation: object, motors: int, *, lowest_battery_v: float) -> None:
        self.motors = motors
        self.clock.update(5_000_000, host_us())  # the autopilot has been up for five seconds

    async def stop_messages(self, numbers: Iterable[int]) -> None:
        """Stop nothing."""

    async def set_rates(self) -> list[str]:
        return []

    async def detect_other_autopilot(self) -> None:
        """Find none."""


class IdleCore:
    """A double of the core without outputs."""

    pace = Pace.BATCHED

    def __init__(self, mission: Mission) -> None:
        """Ignore the mission."""

    def step(self, item: Input) -> list[Output]:
        return []


class World:
    """A simulated world that records the commanded positions of the servo's horn."""

    died, cause = False, ""

    def __init__(self) -> None:
        self.horns: list[float] = []

    def send_horn(self, pulse_us: float) -> None:
        self.horns.append(pulse_us)

    def send_line(self, line: bytes) -> object:
        raise AssertionError("not in real time")


async def until(condition: Callable[[], object], what: str) -> None:
    """Let the event loop run until a condition is true."""
    for _ in range(round(_PATIENCE_S / 0.005)):
        if condition():
            return
        await asyncio.sleep(0.005)
    raise TooSlow(f"{what}: not within {_PATIENCE_S:g} s")


class AppFlight:
    """A flight of the app on a scripted session.

    Attributes:
        records: records of the core thread, without its ticks.
        ended: whether the app has returned.
    """

    def __init__(
        self, mission: Mission, session: ScriptedSession, options: AppOptions, world: World | None
    ) -> None:
        self.session, self.world, self.ended = session, world, False
        self.records: list[Record] = []
        link = None if world is None else WorldLink(world)
        self.app = FlightApp(mission, "udpin://nowhere:1", self._observe, options, link)

    def _observe(self, record: Record, number: int) -> None:
        if not isinstance(record, Tick):
            self.records.append(record)

    def records_of(self, kind: type[_R]) -> list[_R]:
        """Return the records of a kind."""
        return [record for record in self.records if isinstance(record, kind)]

    @property
    def requests(self) -> list[Request]:
        """The operator's requests that have reached the core."""
        return [record.request for record in self.records_of(OperatorRequest)]

    @property
    def notes(self) -> list[str]:
        """Texts of the program in the flight's log."""
        return [record.text for record in self.records_of(StatusText)]

    async def has(self, count: int, kind: type[Record] = OperatorRequest) -> None:
        """Wait for a number of records of a kind."""
        await until(lambda: len(self.records_of(kind)) >= count, f"{count} {kind.__name__}")

    def end(self, outcome: Outcome = Outcome.COMPLETED) -> None:
        """End the mission."""
        self.app.shell.execute(MissionEnd(1, outcome, None, None))

    async def run(self, script: Callable[[AppFlight], Awaitable[None]]) -> None:
        """Run the app; run the script once the app has subscribed, and then end the mission."""
        running = asyncio.create_task(self.app.run())
        try:
            await until(lambda: self.session.motors or running.done(), "the subscription")
            if not running.done():
                await script(self)
                self.end()
            await asyncio.wait_for(running, _PATIENCE_S)
            self.ended = True
        finally:
            running.cancel()


def connecting_to(sessions: Iterable[Any]) -> Callable[..., Any]:
    """Return a `connect` that opens the sessions in order; an exception in their place is raised."""
    remaining = iter(sessions)

    @contextlib.asynccontextmanager
    async def connect(*_: object, **__: object) -> AsyncIterator[Any]:
        session = next(remaining)
        if isinstance(session, Exception):
            raise session
        yield session

    return connect
