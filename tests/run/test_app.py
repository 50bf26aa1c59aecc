"""The app of a flight on a scripted session: the core's outputs, its threads, lock, planners and systemd."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import threading
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import ANY, Mock, call

import pytest

from dart_flight.base.records import (
    CommandResult,
    ContactRequest,
    ImpactOnset,
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
    PlanAnswer,
    PlanRequest,
    Record,
    Request,
    Setpoint,
    Silence,
    VehicleAction,
    VehicleCommand,
    WallEstimate,
)
from dart_flight.config.vehicle import LockDriver
from dart_flight.lock.state_machine import status_text
from dart_flight.run import app as module
from dart_flight.run.app import AppOptions
from dart_flight.run.lock_thread import LockThread
from dart_flight.run.prepare import load_flyable, with_driver
from dart_flight.vehicle.clock import host_us
from dart_flight.vehicle.vehicle_session import NoAnswerError
from tests.doubles.emulated_maestro import EmulatedMaestro
from tests.real_time import wait_until
from tests.run.conftest import ROOT, FlyApp
from tests.run.scripted_session import AppFlight, ScriptedSession, World, until

SETPOINT = Setpoint(1, 1, (0.0, 0.0, -1.0), 0.0)


# --- outputs of the core ----------------------------------------------------------------------------------


@pytest.mark.parametrize("problem", ["", "DENIED"])
def test_the_result_of_a_vehicle_action_is_passed_to_the_core(fly_app: FlyApp, problem: str) -> None:
    async def script(flight: AppFlight) -> None:
        flight.app.shell.execute(VehicleCommand(1, VehicleAction.LAND))
        await flight.has(1, CommandResult)
        assert flight.session.calls == [VehicleAction.LAND]

    flight = fly_app(script, session=ScriptedSession(problem))
    (result,) = flight.records_of(CommandResult)
    assert (result.command, result.ok, result.detail) == ("land", not problem, problem)


@pytest.mark.parametrize("last", [Silence(1, ""), MissionEnd(1, Outcome.COMPLETED, None, None)])
def test_silence_and_the_mission_end_silence_the_session_and_only_the_end_ends_the_flight(
    fly_app: FlyApp, last: Output
) -> None:
    async def script(flight: AppFlight) -> None:
        flight.app.shell.execute(last)
        assert flight.session.calls == ["silence"]
        await asyncio.sleep(0.1)
        ended.append("core" not in {thread.name for thread in threading.enumerate()})

    ended = list[bool]()
    fly_app(script)
    assert ended == [isinstance(last, MissionEnd)]


def test_a_setpoint_is_sent_at_once_and_a_failure_is_reported_once(fly_app: FlyApp) -> None:
    """PX4 holds the last setpoint until its failsafe acts."""

    async def script(flight: AppFlight) -> None:
        flight.app.send(SETPOINT)
        assert flight.session.calls == [SETPOINT]
        flight.session.sending_fails = RuntimeError("no system")
        for _ in range(2):
            flight.app.send(SETPOINT)
        flight.app.resume()
        await flight.has(1)  # the request was queued after the reports

    assert fly_app(script).notes == ["setpoint not sent: RuntimeError: no system"]


def test_every_phase_is_sent_to_the_ground_station(fly_app: FlyApp) -> None:
    async def script(flight: AppFlight) -> None:
        flight.app.shell.execute(PhaseChange(1, Phase.CLIMB, Phase.TRANSIT, "arrived", 1))
        await until(lambda: flight.session.calls, "the text")

    assert fly_app(script).session.texts == ["phase transit"]


# --- planners ---------------------------------------------------------------------------------------------

PLACE, REST = (1.0, 0.0, 1.0), (0.0, 0.0, 0.0)
PLAN = PlanRequest(0, 1, 100_000, 2, PLACE, REST, REST, (2.0, 0.0, 1.0), 450_000)
CONTACT = ContactRequest(
    0, 1, ImpactOnset(0, 0, 0, REST, REST, PLACE), None, (1.0, 0.0), None, 0.0, (0.0, 0.0), 0.1, REST
)
ESTIMATE = WallEstimate(0, 0, "wood", None, None, 0.0, *(1.0,) * 8, 0.1, 0.1, 0.1, 0.1)


@pytest.mark.parametrize(
    ("name", "kinds"),
    [
        ("square", []),
        ("paper_dual_collision", [ContactRequest]),
        ("dual_collision_replan", [ContactRequest, PlanRequest]),
    ],
)
def test_each_planner_lives_as_long_as_the_flight_and_gets_its_requests(
    fly_app: FlyApp, monkeypatch: pytest.MonkeyPatch, name: str, kinds: list[type]
) -> None:
    planners: dict[type, Mock] = {}

    def create(mission: object, kind: type, answer: object, clock: object) -> Mock:
        assert clock is host_us
        planners[kind] = Mock(answer=answer)
        return planners[kind]

    async def script(flight: AppFlight) -> None:
        for output in (PLAN, ESTIMATE, CONTACT):
            flight.app.shell.execute(output)
        for planner in planners.values():
            planner.stop.assert_not_called()
        if PlanRequest in planners:
            planners[PlanRequest].answer(PlanAnswer(0, 1, 0))
            await flight.has(1, PlanAnswer)

    monkeypatch.setattr(module, "PlannerProcess", create)
    flight = fly_app(script, name)
    assert list(planners) == kinds
    wanted: dict[type, list[Any]] = {
        PlanRequest: [call.send(PLAN), call.send(ESTIMATE)],
        ContactRequest: [call.send(CONTACT)],
    }
    for kind, planner in planners.items():
        assert [c for c in planner.mock_calls if c != call.answer(ANY)] == [*wanted[kind], call.stop()]
    assert len(flight.records_of(PlanAnswer)) == (PlanRequest in kinds)


# --- lock -------------------------------------------------------------------------------------------------


class Lock:
    """A double of the lock that records its calls in order."""

    def __init__(self, keep: Any) -> None:
        self.calls: list[object] = []
        self.state = LockState(0, LockPhase.UNKNOWN, None)
        self._keep = keep

    def start(self) -> None:
        self.calls.append("start")

    def obey(self, order: LockCommand | LockPermission) -> None:
        self.calls.append(order)
        if isinstance(order, LockCommand):
            self._keep(LockState(1, LockPhase.SETTLED, order.mode))

    def poll(self) -> None:
        """Do nothing."""


def test_the_lock_is_created_only_once_the_autopilots_clock_is_known() -> None:
    """A host timestamp taken earlier would make the lock wait until the autopilot's clock reaches it."""
    known, created, delivered = threading.Event(), list[Lock](), list[LockState]()

    def make(keep: Any) -> Any:
        assert known.is_set()
        created.append(Lock(keep))
        return created[0]

    thread = LockThread(make, known.is_set, delivered.append)
    thread.thread.start()
    orders: list[LockCommand | LockPermission] = [LockCommand(1, Mode.RIGID), LockPermission(2, False)]
    for order in orders:
        thread.obey(order)
    assert not created
    known.set()
    wait_until(lambda: created and len(created[0].calls) == 3, 5.0, "the orders")
    thread.stop()
    assert not thread.thread.is_alive()
    assert created[0].calls == ["start", *orders]
    assert [state.mode for state in delivered] == [Mode.RIGID]


@pytest.mark.parametrize(
    ("driver", "simulated", "moves_arms"),
    [
        (LockDriver.MOCK, True, True),
        (LockDriver.MAESTRO, True, True),  # on the bench: the modelled horn moves the simulated arms
        (LockDriver.PX4, True, False),  # PX4's own output moves them
        (LockDriver.MOCK, False, False),
    ],
)
def test_lock_commands_move_the_servo_and_the_simulated_arms_unless_the_driver_does(
    fly_app: FlyApp, tmp_path: Path, driver: LockDriver, simulated: bool, moves_arms: bool
) -> None:
    """Every state goes to the core, and every settled state to the ground station."""
    settings = ["lock.servo.travel_s=0.05", f"lock.maestro.port={tmp_path}/maestro"]
    mission = with_driver(load_flyable(ROOT / "missions/square.yaml", None, settings), driver)
    lock = mission.vehicle.lock
    assert lock is not None
    flexible_us, rigid_us = (lock.servo.pulse_us(mode) for mode in (Mode.FLEXIBLE, Mode.RIGID))

    async def script(flight: AppFlight) -> None:
        await until(lambda: settled(flight) == [Mode.FLEXIBLE], "homing")
        flight.app.shell.execute(LockPermission(1, True))
        flight.app.shell.execute(LockCommand(2, Mode.RIGID))
        await until(lambda: settled(flight) == [Mode.FLEXIBLE, Mode.RIGID], "locking")
        assert (flight.app.mock is not None) is (driver is LockDriver.MOCK)

    def settled(flight: AppFlight) -> list[Mode | None]:
        return [s.mode for s in flight.records_of(LockState) if s.phase is LockPhase.SETTLED]

    maestro = EmulatedMaestro(
        lock.servo, tmp_path / "maestro", host_us, channel=lock.maestro.channel, horn_us=flexible_us
    )
    with maestro if driver is LockDriver.MAESTRO else contextlib.nullcontext():
        flight = fly_app(script, mission, world=World() if simulated else None)
    states = flight.records_of(LockState)
    assert LockPhase.TRAVELLING in {state.phase for state in states}
    texts = [status_text(state) for state in states if state.phase is not LockPhase.TRAVELLING]
    assert flight.session.texts == texts
    actuators = [call for call in flight.session.calls if isinstance(call, tuple)]
    assert [value > 0.0 for _, value in actuators] == [False, True] * (driver is LockDriver.PX4)
    horns = flight.world.horns if flight.world is not None else []
    if moves_arms:
        assert (horns[0], horns[-1]) == (flexible_us, rigid_us)
        assert all(flexible_us <= a < b <= rigid_us for a, b in pairwise(horns))  # only changes are sent
    else:
        assert horns == []


# --- a whole run ------------------------------------------------------------------------------------------


def child_processes() -> set[int]:
    return set(map(int, Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()))


def test_a_run_shows_its_records_and_has_a_deadman_that_is_replaced_if_it_dies(
    fly_app: FlyApp, tmp_path: Path
) -> None:
    before, shown = child_processes(), list[Record]()

    def deadman() -> set[int]:
        return child_processes() - before

    async def script(flight: AppFlight) -> None:
        flight.app.show(OperatorRequest(1, Request.CONTINUE))
        await until(lambda: shown, "the first record is shown")
        await until(deadman, "the deadman")
        (first,) = deadman()
        os.kill(first, signal.SIGKILL)
        await until(lambda: deadman() - {first}, "another deadman")
        flight.app.resume()
        await flight.has(1)
        flight.app.show(OperatorRequest(2, Request.CONTINUE))  # just before the end

    options = AppOptions(shown.append, deadman_note=tmp_path / "note")
    flight = fly_app(script, options=options)
    assert [r for r in shown if r in flight.records] == flight.records  # in their order
    assert {OperatorRequest(1, Request.CONTINUE), OperatorRequest(2, Request.CONTINUE)} <= set(shown)
    assert deadman() == set()
    assert not (tmp_path / "note").exists()  # the deadman was dismissed
    assert not {thread.name for thread in threading.enumerate()} & {"lock", "terminal", "core"}


def test_systemd_is_notified_of_start_and_end_and_no_task_survives_the_flight(
    fly_app: FlyApp, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A finished mission must not disturb the next one of the same program."""
    before, tasks = signal.getsignal(signal.SIGTERM), set[asyncio.Task[Any]]()

    async def script(flight: AppFlight) -> None:
        assert signal.getsignal(signal.SIGTERM) != before  # in flight a signal must land, not end the program
        own = asyncio.all_tasks()
        flight.app.shell.execute(VehicleCommand(1, VehicleAction.LAND))  # still unanswered at the end
        await until(lambda: asyncio.all_tasks() - own, "the action's task")
        tasks.update(asyncio.all_tasks() - own)

    session = ScriptedSession()
    session.hangs = True
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "10000000")
        monkeypatch.delenv("WATCHDOG_PID", raising=False)
        fly_app(script, session=session)
        notifications = []
        with contextlib.suppress(BlockingIOError):
            while True:
                notifications.append(systemd.recv(200).decode())
    assert notifications == ["READY=1\nSTATUS=flying square", "WATCHDOG=1", "STOPPING=1"]
    assert tasks
    assert all(task.cancelled() for task in tasks)
    assert signal.getsignal(signal.SIGTERM) == before
    switch_interval_s, *collector = fly_app.changes
    assert isinstance(switch_interval_s, float)
    assert switch_interval_s <= 0.001  # computations must not delay incoming messages
    assert collector == ["collect", "freeze"]  # the garbage collector skips old objects in flight


def test_a_dead_simulator_ends_the_flight_with_its_cause(fly_app: FlyApp) -> None:
    async def script(flight: AppFlight) -> None:
        world.died, world.cause = True, "PX4 has ended by SIGKILL"
        await flight.has(1, MissionEnd)

    world = World()
    (end,) = fly_app(script, world=world, real_core=True).records_of(MissionEnd)
    assert end.reason == "world_died: PX4 has ended by SIGKILL"


def test_a_link_that_answers_no_requests_prevents_the_flight(fly_app: FlyApp) -> None:
    session = ScriptedSession(unanswered=["TIMESYNC", "rate of HIGHRES_IMU"])
    with pytest.raises(NoAnswerError, match="does not answer requests: TIMESYNC, rate of HIGHRES_IMU"):
        fly_app(session=session)
    assert session.motors == 0  # the app subscribed to nothing
    assert "core" not in {thread.name for thread in threading.enumerate()}
