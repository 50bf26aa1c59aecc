"""The shell's own decisions, without a link: what an operator asks, what the core's outputs become."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import queue
import signal
import socket
import sys
import threading
from collections.abc import AsyncIterator, Callable, Iterable
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
from dart_flight.run.app import FlightApp, LockThread
from dart_flight.run.operator_buttons import Button
from dart_flight.run.prepare import load_flyable
from dart_flight.vehicle.clock import ClockEstimate, host_us
from dart_flight.vehicle.command_server import Press, Result
from dart_flight.vehicle.vehicle_session import NoAnswerError

ROOT = Path(__file__).parents[2]


class Session:
    """In the place of a vehicle: what was asked of it, in order."""

    def __init__(self, problem: str = "") -> None:
        self.asked: list[object] = []
        self.problem = problem
        self.clock = ClockEstimate()

    def send(self, setpoint: Setpoint) -> None:
        self.asked.append(setpoint)

    def silence(self) -> None:
        self.asked.append("silence")

    def set_actuator(self, index: int, value: float) -> None:
        self.asked.append((index, value))

    def send_text(self, text: str) -> None:
        self.asked.append(text)

    async def perform(self, action: VehicleAction) -> str:
        self.asked.append(action)
        return self.problem


def app_with(
    monkeypatch: pytest.MonkeyPatch, session: Session | None = None
) -> tuple[FlightApp, list[Input]]:
    """An app, and what it hands to its core."""
    app = FlightApp(load_flyable(ROOT / "missions/dual_collision.yaml"), "udpin://nowhere:1", lambda *_: None)
    told: list[Input] = []
    monkeypatch.setattr(app._core, "put", told.append)
    monkeypatch.setattr(app, "_session", session)
    return app, told


def requests(told: list[Input]) -> list[Request]:
    return [item.request for item in told if isinstance(item, OperatorRequest)]


def test_the_first_stop_lands_and_only_the_next_one_releases(monkeypatch: pytest.MonkeyPatch) -> None:
    app, told = app_with(monkeypatch)
    for _ in range(3):
        app.stop()
    assert requests(told) == [Request.LAND, Request.RELEASE, Request.RELEASE]


def test_the_button_lands_and_leaves_ctrl_c_its_first_time(monkeypatch: pytest.MonkeyPatch) -> None:
    app, told = app_with(monkeypatch, Session())
    assert app._answer_button(Press(Button.LAND)) == (Result.ACCEPTED, "landing")
    app._answer_button(Press(Button.LAND))
    app.stop()
    assert requests(told) == [Request.LAND] * 3
    assert app._answer_button(Press(Button.CONTINUE))[0] is Result.DENIED
    carry_out(app, monkeypatch, PhaseChange(1, Phase.WAYPOINT, Phase.PAUSE, ""))
    assert app._answer_button(Press(Button.CONTINUE))[0] is Result.ACCEPTED
    assert requests(told)[3:] == [Request.CONTINUE]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_every_signal_that_ends_a_program_stops_the_flight(
    monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    app, told = app_with(monkeypatch)

    async def signalled() -> None:
        monkeypatch.setattr(app, "loop", asyncio.get_running_loop())
        app._listen_for_signals()
        signal.raise_signal(number)
        for _ in range(100):  # until the loop has heard of it
            if told:
                break
            await asyncio.sleep(0.01)
        signal.raise_signal(signal.SIGUSR1)
        for _ in range(100):
            if len(told) == 2:
                break
            await asyncio.sleep(0.01)

    asyncio.run(signalled())
    assert requests(told) == [Request.LAND, Request.CONTINUE]


def carry_out(app: FlightApp, monkeypatch: pytest.MonkeyPatch, *outputs: Output) -> None:
    """Hand outputs to the app as its core thread does, and let its event loop do what they start."""

    async def hand_over() -> None:
        monkeypatch.setattr(app, "loop", asyncio.get_running_loop())
        for output in outputs:
            app.execute(output)
        for _ in range(5):
            await asyncio.sleep(0)

    asyncio.run(hand_over())


@pytest.mark.parametrize("problem", ["", "DENIED"])
def test_an_action_is_performed_and_its_result_is_an_input(
    monkeypatch: pytest.MonkeyPatch, problem: str
) -> None:
    session = Session(problem)
    app, told = app_with(monkeypatch, session)
    carry_out(app, monkeypatch, VehicleCommand(1, VehicleAction.LAND))
    assert session.asked == [VehicleAction.LAND]
    assert [(r.command, r.ok, r.detail) for r in told if isinstance(r, CommandResult)] == [
        ("land", not problem, problem)
    ]


@pytest.mark.parametrize("last", [Silence(1, ""), MissionEnd(1, Outcome.COMPLETED, None, None)])
def test_with_silence_and_at_the_end_the_session_falls_silent(
    monkeypatch: pytest.MonkeyPatch, last: Output
) -> None:
    session = Session()
    app, _ = app_with(monkeypatch, session)
    carry_out(app, monkeypatch, last)
    assert session.asked == ["silence"]
    assert app._done.is_set() is isinstance(last, MissionEnd)


def test_orders_of_the_lock_go_to_its_thread_and_nowhere_else(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session()
    app, _ = app_with(monkeypatch, session)
    orders: list[object] = []
    monkeypatch.setattr(app, "_lock", type("Orders", (), {"put": staticmethod(orders.append)}))
    command, permission = LockCommand(1, Mode.RIGID), LockPermission(2, False)
    carry_out(app, monkeypatch, command, permission)
    assert (orders, session.asked) == ([command, permission], [])


def test_what_concerns_the_planner_goes_to_it_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session()
    app, _ = app_with(monkeypatch, session)
    here, still = (1.0, 0.0, 1.0), (0.0, 0.0, 0.0)
    request = PlanRequest(0, 1, 100_000, 2, here, still, still, (2.0, 0.0, 1.0), 450_000)
    coefficients, plane = (1.0,) * 8, (0.1, 0.1, 0.1, 0.1)
    felt = WallEstimate(0, 0, "wood", None, None, 0.0, *coefficients, *plane)
    onset = ImpactOnset(0, 0, 0, still, still, here)
    contact = ContactRequest(0, 1, onset, None, (1.0, 0.0), None, 0.0, (0.0, 0.0), 0.1, still)
    carry_out(app, monkeypatch, request, felt, contact)  # there is none
    planner, fitter = Mock(), Mock()
    monkeypatch.setattr(app, "_planners", {PlanRequest: planner, ContactRequest: fitter})
    carry_out(app, monkeypatch, request, felt, contact)
    assert planner.mock_calls == [call.send(request), call.send(felt)]
    assert fitter.mock_calls == [call.send(contact)]
    assert session.asked == []


def test_what_the_lock_says_goes_to_the_core_and_on_arrival_to_the_ground(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = Session()
    app, told = app_with(monkeypatch, session)
    travelling, settled = (LockState(1, p, Mode.RIGID) for p in (LockPhase.TRAVELLING, LockPhase.SETTLED))
    app._handle_lock_state(travelling)
    assert (told, session.asked) == ([travelling], [])
    app._handle_lock_state(settled)
    assert (told, session.asked) == ([travelling, settled], [status_text(settled)])


@pytest.mark.parametrize("records", [0, 1, 3])
def test_what_is_still_to_be_shown_at_the_end_is_shown_and_then_it_ends(
    monkeypatch: pytest.MonkeyPatch, records: int
) -> None:
    app, _ = app_with(monkeypatch)
    shown: list[Record] = []
    monkeypatch.setattr(app, "_progress", shown.append)
    app._ended.set()
    wanted = [LockPermission(i, True) for i in range(records)]
    for record in wanted[:2]:
        app.show(record)
    for record in wanted[2:]:  # the core's
        app._observe_record(record, 7)
    thread = threading.Thread(target=app._show, daemon=True)
    thread.start()
    thread.join(5.0)
    ended = not thread.is_alive()
    app.show(LockPermission(9, True))  # lets go of one that waits for something to show
    assert ended
    assert shown == wanted


class Lock:
    """In the place of a lock's session: what it was asked, in order."""

    def __init__(self, states: queue.SimpleQueue[LockState]) -> None:
        self.asked: list[object] = []
        self.state = LockState(0, LockPhase.UNKNOWN, None)
        self._states = states

    def start(self) -> None:
        self.asked.append("start")

    def command(self, mode: Mode) -> None:
        self.asked.append(mode)
        self._states.put(LockState(1, LockPhase.SETTLED, mode))

    def permit(self, permitted: bool) -> None:
        self.asked.append(permitted)

    def poll(self) -> None:
        self.asked.append("poll")


def test_the_lock_is_not_made_before_the_autopilots_clock_is_known() -> None:
    """Whatever remembers a stamp of the host's would wait for the autopilot's clock to get there."""
    states: queue.SimpleQueue[LockState] = queue.SimpleQueue()
    known, made, delivered = threading.Event(), list[Lock](), list[LockState]()
    polled = threading.Event()

    def make() -> Any:
        assert known.is_set()
        made.append(Lock(states))
        return made[0]

    def after_poll() -> None:
        if Mode.RIGID in made[0].asked and False in made[0].asked:
            polled.set()

    thread = LockThread(make, states, known.is_set, delivered.append, after_poll)
    thread.thread.start()
    thread.put(LockCommand(1, Mode.RIGID))
    thread.put(LockPermission(2, False))
    assert not made
    known.set()
    assert polled.wait(5.0)
    thread.stop()
    assert not thread.thread.is_alive()
    assert [a for a in made[0].asked if a != "poll"] == ["start", Mode.RIGID, False]
    assert [state.mode for state in delivered] == [Mode.RIGID]


class Flight(Session):
    """A session for a whole run of the app; the flight is over as soon as the app's threads have shown up."""

    def __init__(self, end: Callable[[], None]) -> None:
        super().__init__()
        self.end = end
        self.motors = 0

    async def measure_link(self, timeout_s: float) -> list[str]:
        return []

    async def keep_measuring(self) -> None:
        await asyncio.sleep(60.0)

    def serve_operator(self, system_id: int, answer: object) -> None:
        self.asked.append(("serve", system_id))

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
    """A simulated world that notes where the servo's horn is told to be."""

    died, cause = False, ""

    def __init__(self) -> None:
        self.horns: list[float] = []

    def send_horn(self, pulse_us: float) -> None:
        self.horns.append(pulse_us)

    def send_line(self, line: bytes) -> object:
        raise AssertionError("not in real time")


def connect_to(session: Flight, monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """What the app connects to, whatever its URL; returns what the app does to its process, as it comes."""
    did: list[object] = []

    @contextlib.asynccontextmanager
    async def connected(*_: object, **__: object) -> AsyncIterator[Flight]:
        yield session

    monkeypatch.setattr(module, "connect", connected)
    # What it does to its process is not for a process of tests.
    monkeypatch.setattr(gc, "collect", lambda: did.append("collect"))
    monkeypatch.setattr(gc, "freeze", lambda: did.append("freeze"))
    monkeypatch.setattr(sys, "setswitchinterval", did.append)
    return did


def test_a_run_starts_lock_terminal_and_deadman_and_ends_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    mission = load_flyable(ROOT / "missions/paper_single_wall.yaml")
    assert mission.vehicle.lock is not None
    world, shown, looks, watchers = World(), list[Record](), list[bool](), list[int]()
    app = FlightApp(
        mission, "udpin://nowhere:1", lambda *_: None, world, shown.append, deadman_note=tmp_path / "note"
    )

    def end() -> None:
        """Once the horn has moved as ordered, and the deadman was there meanwhile."""
        looks.append(app._deadman is not None)
        assert app._deadman is not None
        if len(looks) == 1:
            watchers.append(app._deadman.pid)
            os.kill(app._deadman.pid, signal.SIGKILL)
        if len(looks) == 2:  # half a second after the first one was shown
            app.show(OperatorRequest(2, Request.CONTINUE))
        app.execute(LockPermission(1, True))
        app.execute(LockCommand(2, Mode.RIGID))
        if (len(world.horns) > 1 and len(looks) > 2) or len(looks) > 40:
            app.execute(MissionEnd(1, Outcome.COMPLETED, None, None))

    session = Flight(end)
    connect_to(session, monkeypatch)
    app.show(OperatorRequest(1, Request.CONTINUE))
    asyncio.run(app.run())
    assert session.motors == len(mission.vehicle.airframe.motors)
    assert {OperatorRequest(1, Request.CONTINUE), OperatorRequest(2, Request.CONTINUE)} <= set(shown)
    assert all(looks)
    assert app._deadman is not None
    assert app._deadman.pid not in watchers  # one that dies is replaced
    flexible, rigid = (mission.vehicle.lock.servo.pulse_us(mode) for mode in (Mode.FLEXIBLE, Mode.RIGID))
    assert world.horns[0] == flexible
    assert len(world.horns) > 1
    assert min(flexible, rigid) <= min(world.horns)
    assert max(world.horns) <= max(flexible, rigid)
    assert all(a != b for a, b in pairwise(world.horns))  # told only what has changed
    assert not (tmp_path / "note").exists()  # the deadman was let go
    running = {thread.name for thread in threading.enumerate()}
    assert not running & {"lock", "terminal"}


def test_systemd_hears_of_a_flight_from_its_beginning_to_its_end_and_nothing_of_it_goes_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Who flies several missions from one program is left alone by those that are over."""
    app = FlightApp(load_flyable(ROOT / "missions/square.yaml"), "udpin://nowhere:1", lambda *_: None)

    class Held(Flight):
        async def perform(self, action: VehicleAction) -> str:
            await asyncio.sleep(60.0)
            return ""

    def end() -> None:
        handled.append(signal.getsignal(signal.SIGTERM))
        app.execute(VehicleCommand(1, VehicleAction.LAND))  # not answered before the end
        app.execute(MissionEnd(1, Outcome.COMPLETED, None, None))

    async def fly_and_look() -> set[asyncio.Task[Any]]:
        await app.run()
        for _ in range(5):
            await asyncio.sleep(0)
        return asyncio.all_tasks() - {asyncio.current_task()}

    handled: list[object] = []
    before = signal.getsignal(signal.SIGTERM)
    did = connect_to(Held(end), monkeypatch)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "10000000")
        monkeypatch.delenv("WATCHDOG_PID", raising=False)
        assert asyncio.run(fly_and_look()) == set()
        said = []
        with contextlib.suppress(BlockingIOError):
            while True:
                said.append(systemd.recv(200).decode())
    assert said == ["READY=1\nSTATUS=flying square", "WATCHDOG=1", "STOPPING=1"]
    assert not app._core.thread.is_alive()
    assert handled
    assert before not in handled  # a signal stops the flight, and not the program
    switch_interval_s, *collector = did
    assert isinstance(switch_interval_s, float)
    assert switch_interval_s <= 0.001  # what computes does not hold up what arrives
    assert collector == ["collect", "freeze"]  # nothing old is walked in flight


def test_a_world_that_has_died_ends_the_flight_with_its_cause(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Record] = []
    world = World()
    world.died, world.cause = True, "PX4 has ended by SIGKILL"
    app = FlightApp(
        load_flyable(ROOT / "missions/square.yaml"),
        "udpin://nowhere:1",
        lambda record, _: seen.append(record),
        world,
    )
    connect_to(Flight(lambda: None), monkeypatch)
    asyncio.run(asyncio.wait_for(app.run(), 30.0))
    (end,) = [record for record in seen if isinstance(record, MissionEnd)]
    assert end.reason == "world_died: PX4 has ended by SIGKILL"


def test_a_link_that_answers_nothing_is_not_flown_over(monkeypatch: pytest.MonkeyPatch) -> None:
    class Deaf(Flight):
        async def measure_link(self, timeout_s: float) -> list[str]:
            return ["TIMESYNC", "rate of HIGHRES_IMU"]

    app, _ = app_with(monkeypatch)
    session = Deaf(lambda: None)
    connect_to(session, monkeypatch)
    with pytest.raises(NoAnswerError, match="does not answer requests: TIMESYNC, rate of HIGHRES_IMU"):
        asyncio.run(app.run())
    assert session.motors == 0  # nothing has begun
    assert not app._core.thread.is_alive()


@pytest.mark.parametrize(
    ("name", "kinds"),
    [
        ("dual_collision_replan", [ContactRequest, PlanRequest]),
        ("paper_dual_collision", [ContactRequest]),
    ],
)
def test_a_planner_lives_as_long_as_the_flight_and_contacts_have_one_of_their_own(
    monkeypatch: pytest.MonkeyPatch, name: str, kinds: list[type]
) -> None:
    app = FlightApp(load_flyable(ROOT / f"missions/{name}.yaml"), "udpin://nowhere:1", lambda *_: None)
    made = Mock()
    monkeypatch.setattr(module, "PlannerProcess", made)

    def end() -> None:
        made.return_value.stop.assert_not_called()
        app.execute(MissionEnd(1, Outcome.COMPLETED, None, None))

    connect_to(Flight(end), monkeypatch)
    asyncio.run(app.run())
    begun = [call(app._mission, kind, app._handle_answer, host_us) for kind in kinds]
    assert made.mock_calls == begun + [call().stop()] * len(kinds)


@pytest.mark.parametrize(
    ("driver", "simulated", "moves_it"),
    [
        (LockDriver.MOCK, True, True),
        (LockDriver.MAESTRO, True, True),  # on the table: its modelled horn moves the simulated arms
        (LockDriver.PX4, True, False),  # its own output does
        (LockDriver.MOCK, False, False),
    ],
)
def test_the_simulated_arms_are_moved_by_what_stands_for_the_servo(
    monkeypatch: pytest.MonkeyPatch, driver: LockDriver, simulated: bool, moves_it: bool
) -> None:
    session = Session()
    app, _ = app_with(monkeypatch, session)
    world, config = World(), app._mission.vehicle.lock
    assert config is not None
    monkeypatch.setattr(app, "_world", world if simulated else None)
    session.clock.update(5_000_000, host_us())
    lock = app._make_lock(session, msgspec.structs.replace(config, driver=driver))  # type: ignore[arg-type]
    for _ in range(3):
        lock._after_poll()
    assert world.horns == [config.servo.pulse_us(Mode.FLEXIBLE)] * moves_it
    assert (app.mock is not None) is (driver is LockDriver.MOCK)


def test_a_setpoint_leaves_at_once_and_one_that_is_refused_is_no_fault(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """PX4 keeps the last one, and then its failsafe acts; the cause is reported once."""
    session = Session()
    app, _ = app_with(monkeypatch, session)
    setpoint = Setpoint(1, 1, (0.0, 0.0, -1.0), 0.0)
    app.send(setpoint)
    assert session.asked == [setpoint]

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


def test_the_ground_hears_of_every_phase(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session()
    app, _ = app_with(monkeypatch, session)
    carry_out(app, monkeypatch, PhaseChange(1, Phase.CLIMB, Phase.TRANSIT, "arrived", 1))
    assert session.asked == ["phase transit"]


@pytest.mark.parametrize(("theirs", "expected"), [(0, False), (1, True)])
def test_a_terminal_of_another_job_is_not_read(
    monkeypatch: pytest.MonkeyPatch, theirs: int, expected: bool
) -> None:
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp() + theirs)
    assert module._in_background(0) is expected


def test_a_key_that_was_typed_for_another_job_is_left_alone_for_a_while(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Else the loop would call again at once, for what nobody here may read."""
    app, _ = app_with(monkeypatch)
    app.loop = asyncio.new_event_loop()
    master, terminal = os.openpty()
    with os.fdopen(master), os.fdopen(terminal) as keyboard, contextlib.closing(app.loop):
        monkeypatch.setattr(sys, "stdin", keyboard)
        monkeypatch.setattr(module, "_in_background", lambda _: True)
        app._listen_for_key()
        app._read_key()
        assert not app.loop.remove_reader(terminal), "it was listened to still"
