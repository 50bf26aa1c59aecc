"""The app without a link: operator requests, execution of the core's outputs, its threads, a whole run."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import signal
import socket
import sys
import threading
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock, call

import msgspec
import pytest

from dart_flight.base.records import (
    CommandResult,
    ContactRequest,
    ImpactOnset,
    Input,
    LockCommand,
    LockPermission,
    LockPhase,
    LockState,
    MissionEnd,
    Mode,
    OperatorRequest,
    Outcome,
    Output,
    Phase,
    PhaseChange,
    PlanRequest,
    Record,
    Request,
    Setpoint,
    Silence,
    StatusText,
    VehicleAction,
    VehicleCommand,
    WallEstimate,
)
from dart_flight.config.vehicle import LockDriver
from dart_flight.lock.state_machine import status_text
from dart_flight.run import app as module
from dart_flight.run.app import AppOptions, FlightApp, LockThread, WorldLink
from dart_flight.run.operator_buttons import Button
from dart_flight.run.prepare import load_flyable
from dart_flight.vehicle.clock import ClockEstimate, host_us
from dart_flight.vehicle.command_server import Press, Result
from dart_flight.vehicle.vehicle_session import NoAnswerError

ROOT = Path(__file__).parents[2]


class Session:
    """A double of the vehicle session that records its calls in order."""

    def __init__(self, problem: str = "") -> None:
        self.calls: list[object] = []
        self.problem = problem
        self.clock = ClockEstimate()

    def send(self, setpoint: Setpoint) -> None:
        self.calls.append(setpoint)

    def silence(self) -> None:
        self.calls.append("silence")

    def set_actuator(self, index: int, value: float) -> None:
        self.calls.append((index, value))

    def send_text(self, text: str) -> None:
        self.calls.append(text)

    async def perform(self, action: VehicleAction) -> str:
        self.calls.append(action)
        return self.problem


def make_app(
    monkeypatch: pytest.MonkeyPatch, session: Session | None = None
) -> tuple[FlightApp, list[Input]]:
    """Return an app and the list of inputs that it passes to its core."""
    app = FlightApp(load_flyable(ROOT / "missions/dual_collision.yaml"), "udpin://nowhere:1", lambda *_: None)
    inputs: list[Input] = []
    monkeypatch.setattr(app._core, "put", inputs.append)
    monkeypatch.setattr(app, "_session", session)
    return app, inputs


def operator_requests(inputs: list[Input]) -> list[Request]:
    return [item.request for item in inputs if isinstance(item, OperatorRequest)]


def test_the_first_stop_lands_and_later_stops_release_the_vehicle(monkeypatch: pytest.MonkeyPatch) -> None:
    app, inputs = make_app(monkeypatch)
    for _ in range(3):
        app.stop()
    assert operator_requests(inputs) == [Request.LAND, Request.RELEASE, Request.RELEASE]


def test_the_land_button_does_not_count_as_a_first_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    app, inputs = make_app(monkeypatch, Session())
    assert app._answer_button(Press(Button.LAND)) == (Result.ACCEPTED, "landing")
    app._answer_button(Press(Button.LAND))
    app.stop()
    assert operator_requests(inputs) == [Request.LAND] * 3
    assert app._answer_button(Press(Button.CONTINUE))[0] is Result.DENIED
    execute_outputs(app, monkeypatch, PhaseChange(1, Phase.WAYPOINT, Phase.PAUSE, ""))
    assert app._answer_button(Press(Button.CONTINUE))[0] is Result.ACCEPTED
    assert operator_requests(inputs)[3:] == [Request.CONTINUE]


async def send_signals(app: FlightApp, inputs: list[Input], numbers: Sequence[signal.Signals]) -> None:
    """Raise signals; wait for the input of the app's core that the last signal must cause."""
    app.loop = asyncio.get_running_loop()
    with app._listening_for_operator():
        for number in numbers:
            before = len(inputs)
            signal.raise_signal(number)
            for _ in range(100 if number is numbers[-1] else 2):  # until the loop has handled the signal
                await asyncio.sleep(0.01)
                if len(inputs) > before:
                    break
        app.loop.remove_signal_handler(signal.SIGUSR1)


@pytest.fixture
def hangup() -> Iterator[Callable[[Any], object]]:
    """Set what the process does at SIGHUP; restore this after the test."""
    before = signal.getsignal(signal.SIGHUP)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield partial(signal.signal, signal.SIGHUP)
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("hangup")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_terminating_signals_land_the_vehicle_and_sigusr1_continues(
    monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    app, inputs = make_app(monkeypatch)
    asyncio.run(send_signals(app, inputs, [number, signal.SIGUSR1]))
    assert operator_requests(inputs) == [Request.LAND, Request.CONTINUE]


@pytest.mark.usefixtures("hangup")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_repeated_signal_is_logged_and_does_not_release_the_vehicle(
    monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    """GNU timeout signals the program and then its group."""
    app, inputs = make_app(monkeypatch, Session())
    asyncio.run(send_signals(app, inputs, [number, number]))
    assert operator_requests(inputs) == [Request.LAND]
    (text,) = (item.text for item in inputs if isinstance(item, StatusText))
    assert text == f"{number.name} again within 0.3 s: counted once"
    other = signal.SIGTERM if number is signal.SIGINT else signal.SIGINT
    asyncio.run(send_signals(app, inputs, [other]))
    assert operator_requests(inputs) == [Request.LAND, Request.RELEASE]


def test_an_ignored_hangup_does_not_land_the_vehicle(
    monkeypatch: pytest.MonkeyPatch, hangup: Callable[[Any], object]
) -> None:
    app, inputs = make_app(monkeypatch)
    hangup(signal.SIG_IGN)
    asyncio.run(send_signals(app, inputs, [signal.SIGHUP, signal.SIGUSR1]))
    assert operator_requests(inputs) == [Request.CONTINUE]
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


def execute_outputs(app: FlightApp, monkeypatch: pytest.MonkeyPatch, *outputs: Output) -> None:
    """Execute outputs as the core thread does, and let the event loop run the tasks that they start."""

    async def hand_over() -> None:
        monkeypatch.setattr(app, "loop", asyncio.get_running_loop())
        for output in outputs:
            app.execute(output)
        for _ in range(5):
            await asyncio.sleep(0)

    asyncio.run(hand_over())


@pytest.mark.parametrize("problem", ["", "DENIED"])
def test_the_result_of_a_vehicle_action_is_passed_to_the_core(
    monkeypatch: pytest.MonkeyPatch, problem: str
) -> None:
    session = Session(problem)
    app, inputs = make_app(monkeypatch, session)
    execute_outputs(app, monkeypatch, VehicleCommand(1, VehicleAction.LAND))
    assert session.calls == [VehicleAction.LAND]
    assert [(r.command, r.ok, r.detail) for r in inputs if isinstance(r, CommandResult)] == [
        ("land", not problem, problem)
    ]


@pytest.mark.parametrize("last", [Silence(1, ""), MissionEnd(1, Outcome.COMPLETED, None, None)])
def test_silence_and_the_mission_end_silence_the_session(
    monkeypatch: pytest.MonkeyPatch, last: Output
) -> None:
    session = Session()
    app, _ = make_app(monkeypatch, session)
    execute_outputs(app, monkeypatch, last)
    assert session.calls == ["silence"]
    assert app._done.is_set() is isinstance(last, MissionEnd)


def test_lock_commands_go_to_the_lock_thread_only(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session()
    app, _ = make_app(monkeypatch, session)
    orders: list[object] = []
    monkeypatch.setattr(app, "_lock", type("Orders", (), {"put": staticmethod(orders.append)}))
    command, permission = LockCommand(1, Mode.RIGID), LockPermission(2, False)
    execute_outputs(app, monkeypatch, command, permission)
    assert (orders, session.calls) == ([command, permission], [])


def test_planner_requests_go_to_the_planner_processes_if_any(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session()
    app, _ = make_app(monkeypatch, session)
    position, rest = (1.0, 0.0, 1.0), (0.0, 0.0, 0.0)
    request = PlanRequest(0, 1, 100_000, 2, position, rest, rest, (2.0, 0.0, 1.0), 450_000)
    coefficients, plane = (1.0,) * 8, (0.1, 0.1, 0.1, 0.1)
    estimate = WallEstimate(0, 0, "wood", None, None, 0.0, *coefficients, *plane)
    onset = ImpactOnset(0, 0, 0, rest, rest, position)
    contact = ContactRequest(0, 1, onset, None, (1.0, 0.0), None, 0.0, (0.0, 0.0), 0.1, rest)
    execute_outputs(app, monkeypatch, request, estimate, contact)  # no planner process yet
    planner, fitter = Mock(), Mock()
    monkeypatch.setattr(app, "_planners", {PlanRequest: planner, ContactRequest: fitter})
    execute_outputs(app, monkeypatch, request, estimate, contact)
    assert planner.mock_calls == [call.send(request), call.send(estimate)]
    assert fitter.mock_calls == [call.send(contact)]
    assert session.calls == []


def test_lock_states_go_to_the_core_and_settled_states_to_the_ground_station(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = Session()
    app, inputs = make_app(monkeypatch, session)
    travelling, settled = (LockState(1, p, Mode.RIGID) for p in (LockPhase.TRAVELLING, LockPhase.SETTLED))
    app._handle_lock_state(travelling)
    assert (inputs, session.calls) == ([travelling], [])
    app._handle_lock_state(settled)
    assert (inputs, session.calls) == ([travelling, settled], [status_text(settled)])


@pytest.mark.parametrize("records", [0, 1, 3])
def test_queued_records_are_shown_before_the_display_thread_ends(
    monkeypatch: pytest.MonkeyPatch, records: int
) -> None:
    app, _ = make_app(monkeypatch)
    shown: list[Record] = []
    monkeypatch.setattr(app, "_options", AppOptions(shown.append))
    app._ended.set()
    wanted = [LockPermission(i, True) for i in range(records)]
    for record in wanted[:2]:
        app.show(record)
    for record in wanted[2:]:  # records of the core
        app._observe_record(record, 7)
    thread = threading.Thread(target=app._show, daemon=True)
    thread.start()
    thread.join(5.0)
    ended = not thread.is_alive()
    app.show(LockPermission(9, True))  # ends a display thread that still waits for a record
    assert ended
    assert shown == wanted


class Lock:
    """A double of the lock that records its calls in order."""

    def __init__(self, keep: Callable[[LockState], None]) -> None:
        self.calls: list[object] = []
        self.state = LockState(0, LockPhase.UNKNOWN, None)
        self._keep = keep

    def start(self) -> None:
        self.calls.append("start")

    def command(self, mode: Mode) -> None:
        self.calls.append(mode)
        self._keep(LockState(1, LockPhase.SETTLED, mode))

    def permit(self, permitted: bool) -> None:
        self.calls.append(permitted)

    def poll(self) -> None:
        self.calls.append("poll")


def test_the_lock_is_created_only_once_the_autopilots_clock_is_known() -> None:
    """A host timestamp taken earlier would make the lock wait until the autopilot's clock reaches it."""
    known, created, delivered = threading.Event(), list[Lock](), list[LockState]()
    polled = threading.Event()

    def make(keep: Callable[[LockState], None]) -> Any:
        assert known.is_set()
        created.append(Lock(keep))
        return created[0]

    def after_poll() -> None:
        if Mode.RIGID in created[0].calls and False in created[0].calls:
            polled.set()

    thread = LockThread(make, known.is_set, delivered.append, after_poll)
    thread.thread.start()
    thread.put(LockCommand(1, Mode.RIGID))
    thread.put(LockPermission(2, False))
    assert not created
    known.set()
    assert polled.wait(5.0)
    thread.stop()
    assert not thread.thread.is_alive()
    assert [a for a in created[0].calls if a != "poll"] == ["start", Mode.RIGID, False]
    assert [state.mode for state in delivered] == [Mode.RIGID]


class Flight(Session):
    """A session for a whole run of the app; `end` decides when the flight is over."""

    def __init__(self, end: Callable[[], None]) -> None:
        super().__init__()
        self.end = end
        self.motors = 0

    async def measure_link(self, timeout_s: float) -> list[str]:
        return []

    async def keep_measuring(self) -> None:
        await asyncio.sleep(60.0)

    def serve_operator(self, system_id: int, answer: object) -> None:
        self.calls.append(("serve", system_id))

    def subscribe(self, estimation: object, motors: int, *, lowest_battery_v: float) -> None:
        self.motors = motors
        self.clock.update(5_000_000, host_us())  # the autopilot has been up for five seconds

    async def stop_messages(self, numbers: Iterable[int]) -> None:
        pass

    async def set_rates(self) -> list[str]:
        return []

    async def detect_other_autopilot(self) -> None:
        self.end()


class World:
    """A simulated world that records the commanded positions of the servo's horn."""

    died, cause = False, ""

    def __init__(self) -> None:
        self.horns: list[float] = []

    def send_horn(self, pulse_us: float) -> None:
        self.horns.append(pulse_us)

    def send_line(self, line: bytes) -> object:
        raise AssertionError("not in real time")


def connect_to(session: Flight, monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Connect the app to `session`, whatever its URL; return the app's changes to its process, in order."""
    changes: list[object] = []

    @contextlib.asynccontextmanager
    async def connected(*_: object, **__: object) -> AsyncIterator[Flight]:
        yield session

    monkeypatch.setattr(module, "connect", connected)
    # The app's changes to its process must not affect the test process.
    monkeypatch.setattr(gc, "collect", lambda: changes.append("collect"))
    monkeypatch.setattr(gc, "freeze", lambda: changes.append("freeze"))
    monkeypatch.setattr(sys, "setswitchinterval", changes.append)
    return changes


def test_a_run_starts_and_ends_lock_terminal_and_deadman(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    mission = load_flyable(ROOT / "missions/paper_single_wall.yaml")
    assert mission.vehicle.lock is not None
    world, shown, deadman_checks, watchers = World(), list[Record](), list[bool](), list[int]()
    options = AppOptions(shown.append, deadman_note=tmp_path / "note")
    app = FlightApp(mission, "udpin://nowhere:1", lambda *_: None, options, WorldLink(world))

    def end() -> None:
        """End the flight once the horn has moved; the deadman must run until then."""
        deadman_checks.append(app._deadman is not None)
        assert app._deadman is not None
        if len(deadman_checks) == 1:
            watchers.append(app._deadman.pid)
            os.kill(app._deadman.pid, signal.SIGKILL)
        if len(deadman_checks) == 2:  # half a second after the first record was shown
            app.show(OperatorRequest(2, Request.CONTINUE))
        app.execute(LockPermission(1, True))
        app.execute(LockCommand(2, Mode.RIGID))
        if (len(world.horns) > 1 and len(deadman_checks) > 2) or len(deadman_checks) > 40:
            app.execute(MissionEnd(1, Outcome.COMPLETED, None, None))

    session = Flight(end)
    connect_to(session, monkeypatch)
    app.show(OperatorRequest(1, Request.CONTINUE))
    asyncio.run(app.run())
    assert session.motors == len(mission.vehicle.airframe.motors)
    assert {OperatorRequest(1, Request.CONTINUE), OperatorRequest(2, Request.CONTINUE)} <= set(shown)
    assert all(deadman_checks)
    assert app._deadman is not None
    assert app._deadman.pid not in watchers  # a dead deadman is replaced
    flexible, rigid = (mission.vehicle.lock.servo.pulse_us(mode) for mode in (Mode.FLEXIBLE, Mode.RIGID))
    assert world.horns[0] == flexible
    assert len(world.horns) > 1
    assert min(flexible, rigid) <= min(world.horns)
    assert max(world.horns) <= max(flexible, rigid)
    assert all(a != b for a, b in pairwise(world.horns))  # only changes are sent
    assert not (tmp_path / "note").exists()  # the deadman was dismissed
    running = {thread.name for thread in threading.enumerate()}
    assert not running & {"lock", "terminal"}


def test_systemd_is_notified_of_start_and_end_and_no_task_survives_the_flight(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A finished mission must not disturb the next one of the same program."""
    app = FlightApp(load_flyable(ROOT / "missions/square.yaml"), "udpin://nowhere:1", lambda *_: None)

    class Held(Flight):
        async def perform(self, action: VehicleAction) -> str:
            await asyncio.sleep(60.0)
            return ""

    def end() -> None:
        handled.append(signal.getsignal(signal.SIGTERM))
        app.execute(VehicleCommand(1, VehicleAction.LAND))  # still unanswered at the end
        app.execute(MissionEnd(1, Outcome.COMPLETED, None, None))

    async def fly_and_list_tasks() -> set[asyncio.Task[Any]]:
        await app.run()
        for _ in range(5):
            await asyncio.sleep(0)
        return asyncio.all_tasks() - {asyncio.current_task()}

    handled: list[object] = []
    before = signal.getsignal(signal.SIGTERM)
    changes = connect_to(Held(end), monkeypatch)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "10000000")
        monkeypatch.delenv("WATCHDOG_PID", raising=False)
        assert asyncio.run(fly_and_list_tasks()) == set()
        notifications = []
        with contextlib.suppress(BlockingIOError):
            while True:
                notifications.append(systemd.recv(200).decode())
    assert notifications == ["READY=1\nSTATUS=flying square", "WATCHDOG=1", "STOPPING=1"]
    assert not app._core.thread.is_alive()
    assert handled
    assert before not in handled  # in flight a signal must land, not end the program
    switch_interval_s, *collector = changes
    assert isinstance(switch_interval_s, float)
    assert switch_interval_s <= 0.001  # computations must not delay incoming messages
    assert collector == ["collect", "freeze"]  # the garbage collector skips old objects in flight


def test_a_dead_simulator_ends_the_flight_with_its_cause(monkeypatch: pytest.MonkeyPatch) -> None:
    records: list[Record] = []
    world = World()
    world.died, world.cause = True, "PX4 has ended by SIGKILL"
    app = FlightApp(
        load_flyable(ROOT / "missions/square.yaml"),
        "udpin://nowhere:1",
        lambda record, _: records.append(record),
        world_link=WorldLink(world),
    )
    connect_to(Flight(lambda: None), monkeypatch)
    asyncio.run(asyncio.wait_for(app.run(), 30.0))
    (end,) = [record for record in records if isinstance(record, MissionEnd)]
    assert end.reason == "world_died: PX4 has ended by SIGKILL"


def test_a_link_that_answers_no_requests_prevents_the_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    class Deaf(Flight):
        async def measure_link(self, timeout_s: float) -> list[str]:
            return ["TIMESYNC", "rate of HIGHRES_IMU"]

    app, _ = make_app(monkeypatch)
    session = Deaf(lambda: None)
    connect_to(session, monkeypatch)
    with pytest.raises(NoAnswerError, match="does not answer requests: TIMESYNC, rate of HIGHRES_IMU"):
        asyncio.run(app.run())
    assert session.motors == 0  # the app subscribed to nothing
    assert not app._core.thread.is_alive()


@pytest.mark.parametrize(
    ("name", "kinds"),
    [
        ("dual_collision_replan", [ContactRequest, PlanRequest]),
        ("paper_dual_collision", [ContactRequest]),
    ],
)
def test_each_planner_process_lives_as_long_as_the_flight(
    monkeypatch: pytest.MonkeyPatch, name: str, kinds: list[type]
) -> None:
    app = FlightApp(load_flyable(ROOT / f"missions/{name}.yaml"), "udpin://nowhere:1", lambda *_: None)
    created = Mock()
    monkeypatch.setattr(module, "PlannerProcess", created)

    def end() -> None:
        created.return_value.stop.assert_not_called()
        app.execute(MissionEnd(1, Outcome.COMPLETED, None, None))

    connect_to(Flight(end), monkeypatch)
    asyncio.run(app.run())
    expected_calls = [call(app._mission, kind, app._handle_answer, host_us) for kind in kinds]
    assert created.mock_calls == expected_calls + [call().stop()] * len(kinds)


@pytest.mark.parametrize(
    ("driver", "simulated", "moves_arms"),
    [
        (LockDriver.MOCK, True, True),
        (LockDriver.MAESTRO, True, True),  # on the bench: the modelled horn moves the simulated arms
        (LockDriver.PX4, True, False),  # PX4's own output moves them
        (LockDriver.MOCK, False, False),
    ],
)
def test_the_app_moves_the_simulated_arms_unless_the_driver_does(
    monkeypatch: pytest.MonkeyPatch, driver: LockDriver, simulated: bool, moves_arms: bool
) -> None:
    session = Session()
    app, _ = make_app(monkeypatch, session)
    world, config = World(), app._mission.vehicle.lock
    assert config is not None
    monkeypatch.setattr(app, "_world", world if simulated else None)
    session.clock.update(5_000_000, host_us())
    config = msgspec.structs.replace(config, driver=driver)
    vehicle = msgspec.structs.replace(app._mission.vehicle, lock=config)
    monkeypatch.setattr(app, "_mission", msgspec.structs.replace(app._mission, vehicle=vehicle))
    with app._owned_driver() as made:
        assert made is not None
        lock = app._make_lock(made, config)
    for _ in range(3):
        lock._after_poll()
    assert world.horns == [config.servo.pulse_us(Mode.FLEXIBLE)] * moves_arms
    assert (app.mock is not None) is (driver is LockDriver.MOCK)


def test_a_setpoint_is_sent_at_once_and_a_failure_is_reported_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """PX4 holds the last setpoint until its failsafe acts."""
    session = Session()
    app, _ = make_app(monkeypatch, session)
    setpoint = Setpoint(1, 1, (0.0, 0.0, -1.0), 0.0)
    app.send(setpoint)
    assert session.calls == [setpoint]

    def refuse(_: Setpoint) -> None:
        raise RuntimeError("no system")

    reported: list[Input] = []
    monkeypatch.setattr(app._core, "put", reported.append)
    session.clock.update(5_000_000, host_us())
    monkeypatch.setattr(session, "send", refuse)
    app.send(setpoint)
    app.send(setpoint)
    (text,) = reported
    assert isinstance(text, StatusText)
    assert (text.found_here, text.text) == (True, "setpoint not sent: RuntimeError: no system")


def test_every_phase_is_sent_to_the_ground_station(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session()
    app, _ = make_app(monkeypatch, session)
    execute_outputs(app, monkeypatch, PhaseChange(1, Phase.CLIMB, Phase.TRANSIT, "arrived", 1))
    assert session.calls == ["phase transit"]


@pytest.mark.parametrize(("offset", "expected"), [(0, False), (1, True)])
def test_a_terminal_of_another_job_is_not_read(
    monkeypatch: pytest.MonkeyPatch, offset: int, expected: bool
) -> None:
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp() + offset)
    assert module._in_background(0) is expected


def test_a_key_typed_for_another_job_pauses_the_keyboard_reader(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Otherwise the loop would call the reader again at once for a key that it must not read."""
    app, _ = make_app(monkeypatch)
    app.loop = asyncio.new_event_loop()
    master, terminal = os.openpty()
    with os.fdopen(master), os.fdopen(terminal) as keyboard, contextlib.closing(app.loop):
        monkeypatch.setattr(sys, "stdin", keyboard)
        monkeypatch.setattr(module, "_in_background", lambda _: True)
        app._listen_for_key()
        app._read_key()
        assert not app.loop.remove_reader(terminal), "the terminal is still watched"
