"""The program of a flight over MAVSDK: it connects to the vehicle and runs the threads around the core.

The threads are:
    MAVSDK's thread builds records and queues them. Near a wall it also steps the core (`core_thread`).
    The core thread steps the core and sends setpoints.
    The lock thread, if there is a lock, steps the lock's state machine and may block on the lock's driver.
    The log thread encodes and writes records.
    The event loop (asyncio) handles the connection, arming, mode changes, signals and the operator's keys.
    The terminal thread passes the records to `progress`.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from dart_flight.base.records import (
    CommandResult,
    ContactAnswer,
    LockPhase,
    LockState,
    OperatorRequest,
    Phase,
    PlanAnswer,
    PoseSample,
    Record,
    Request,
    Setpoint,
    StatusText,
    VehicleAction,
)
from dart_flight.base.signals import StopSignals, describe_repeat
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import LockConfig, LockDriver
from dart_flight.core.flight_core import FlightCore
from dart_flight.lock.drivers import ActuatorLink, Driver, DriverError, owned_driver
from dart_flight.lock.drivers.mock import MockDriver, MockFaults
from dart_flight.lock.drivers.modelled_horn import DriverWithModelledHorn
from dart_flight.lock.lock_session import LockSession
from dart_flight.lock.state_machine import status_text
from dart_flight.run.core_thread import CoreThread
from dart_flight.run.deadman import CORE, FEED_PERIOD_S, LOOP, Deadman, SystemdNotice
from dart_flight.run.lock_thread import LockThread
from dart_flight.run.operator_buttons import reply_in_flight
from dart_flight.run.planner_process import PlannerProcess, kinds_of_requests
from dart_flight.run.shell import Observe, Shell
from dart_flight.run.timing import LockstepTime, RealTime
from dart_flight.vehicle.clock import Clock
from dart_flight.vehicle.command_server import Press, Result
from dart_flight.vehicle.motion_capture.pose_bridge import MotionCaptureBridge, forwarded_pose
from dart_flight.vehicle.motion_capture.source import PoseSource, open_source
from dart_flight.vehicle.vehicle_session import NoAnswerError, VehicleSession, connect

_SHOW_PERIOD_S = 0.2  # update period of the live line
_SWITCH_INTERVAL_S = 0.001  # longest time that one thread may run before MAVSDK's callbacks can run
_KEY_PAUSE_S = 0.5
_LOOK_PERIOD_S = 0.5  # period of the checks for other vehicles and for the end of the simulation
_END_GRACE_S = 0.3  # after the flight, wait this long for the last records

Progress = Callable[[Record], None]


class Simulator(Protocol):
    """The app's interface to a simulated world, for everything that MAVLink does not carry."""

    @property
    def died(self) -> bool:
        """Whether the world has ended by itself."""

    @property
    def cause(self) -> str:
        """The reason why the world has ended."""

    def send_horn(self, pulse_us: float) -> None:
        """Send the position of the mock servo's horn to the plant."""

    def send_line(self, line: bytes) -> object:
        """Send a lockstep report to the world."""


class WorldLink(NamedTuple):
    """The link to a simulated world, and the clock that app and world share.

    Attributes:
        clock: autopilot's clock, or None if the autopilot's time advances with real time.
        lockstep: whether the world waits for this program. If so, the program's clock is simulated time.
        lock_faults: faults of the mock servo from the start of the flight.
        mocap_url: URL of the emulated motion capture, or None to use the vehicle's `mocap.url`.
    """

    world: Simulator
    clock: Clock | None = None
    lockstep: bool = False
    lock_faults: MockFaults | None = None
    mocap_url: str | None = None


class AppOptions(NamedTuple):
    """Settings from the command that starts the flight.

    Attributes:
        progress: callback for every record. It runs on a separate thread, because a terminal may block.
        deadman_note: file in which the deadman reports why it killed the program, or None for no deadman.
        unwanted: numbers of MAVLink messages; the app asks the vehicle not to send them on this link.
    """

    progress: Progress = lambda record: None
    deadman_note: Path | None = None
    opened: Callable[[], None] = lambda: None
    unwanted: Sequence[int] = ()


_DEFAULT_OPTIONS = AppOptions()


class FlightApp:
    """One flight over MAVSDK.

    Args:
        observe: callback for every record and the record's input number, on the core thread.
        world_link: link to the simulated world, or None for a real vehicle.

    Attributes:
        mock: driver of the mock servo, or None if the lock has another driver.
    """

    def __init__(
        self,
        mission: Mission,
        url: str,
        observe: Observe,
        options: AppOptions = _DEFAULT_OPTIONS,
        world_link: WorldLink | None = None,
    ) -> None:
        self._mission, self._url, self._observe, self._options = mission, url, observe, options
        self._world: Simulator | None = None
        self._lock_faults: MockFaults | None = None
        self._mocap_url = mission.vehicle.mocap.url
        self._time = RealTime()
        if world_link is not None:
            self._world, self._lock_faults = world_link.world, world_link.lock_faults
            self._mocap_url = world_link.mocap_url or self._mocap_url
            self._time = RealTime(world_link.clock)
            if world_link.lockstep:
                plan_us = round(1e6 * mission.vehicle.simulation.replan_latency_s)
                batches = self._mocap_url is None
                self._time = LockstepTime(world_link.world.send_line, plan_us, batches)
        self._host_us = self._time.host_us
        self._shown: deque[Record] = deque()
        self._deadman: Deadman | None = None
        self.mock: MockDriver | None = None
        self._session: VehicleSession | None = None
        self._bridge: MotionCaptureBridge | None = None
        self._unsent: set[str] = set()  # errors already reported for setpoints that were not sent
        self._done = asyncio.Event()
        self._ended = threading.Event()
        self.loop: asyncio.AbstractEventLoop | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._stops = 0
        self._phase, self._lock_text = Phase.READYING, ""  # determine the answers to the operator's buttons
        self._stopped = asyncio.Event()
        self.shell = Shell(FlightCore(mission), self, self._observe_record, self._time)
        self._core = CoreThread(self.shell, lambda: self._feed(CORE), self._after_step)
        self._lock: LockThread | None = None

    async def run(self) -> None:
        """Fly, and return when the flight has ended.

        Raises:
            VehicleError: there is no autopilot at the URL.
            NoAnswerError: the autopilot does not answer requests.
            InputError: the motion capture does not answer or does not track the configured body; or the servo
                is in use or missing.
        """
        with contextlib.ExitStack() as held:
            driver = held.enter_context(self._owned_driver())
            source = None if self._mocap_url is None else open_source(self._mocap_url)
            try:
                await self._fly(source, driver, held)
            finally:
                if source is not None and self._bridge is None:  # the pose bridge stops its own source
                    source.stop()

    async def _fly(
        self, source: PoseSource | None, driver: Driver | None, held: contextlib.ExitStack
    ) -> None:
        self.loop = asyncio.get_running_loop()
        timeout_s = self._mission.vehicle.connection.timeout_s
        async with connect(
            self._url, timeout_s, self._core.arrive, clock=self._time.clock, opened=self._options.opened
        ) as session:
            self._session = session
            unanswered = await session.measure_link(timeout_s)
            if unanswered:
                message = f"the vehicle sends telemetry but does not answer requests: {', '.join(unanswered)}"
                raise NoAnswerError(message, source=self._url)
            if driver is not None and self._mission.vehicle.lock is not None:
                self.shell.lock = self._lock = self._make_lock(driver, self._mission.vehicle.lock)
            planners = {
                kind: PlannerProcess(self._mission, kind, self._handle_answer, self._host_us)
                for kind in kinds_of_requests(self._mission)
            }
            self.shell.planners = planners
            sys.setswitchinterval(_SWITCH_INTERVAL_S)
            # Garbage collections in flight then skip the objects loaded so far.
            gc.collect()
            gc.freeze()
            terminal = threading.Thread(target=self._show, name="terminal", daemon=True)
            terminal.start()
            self._core.thread.start()
            if self._lock is not None:
                self._lock.thread.start()
            vehicle = self._mission.vehicle
            motors, lowest_v = len(vehicle.airframe.motors), vehicle.guard.battery_v
            session.subscribe(vehicle.estimation, motors, lowest_battery_v=lowest_v)
            session.serve_operator(vehicle.ground_station.system_id, self._answer_button)
            held.enter_context(self._listening_for_operator())
            if source is not None:
                self.shell.poses = self._bridge = self._open_bridge(session, source)
            keeper = asyncio.create_task(self._keep_alive())
            # In lockstep a round trip takes no time.
            measuring = None if self._time.waits else asyncio.create_task(session.keep_measuring())
            try:
                await session.stop_messages(self._options.unwanted)
                await session.set_rates()
                self._time.begin()
                await self._watch(session)
                if self._bridge is not None and self._world is None:
                    await self._forward_until_disarmed(session)
            finally:
                if self._bridge is not None:
                    self._bridge.stop()
                keeper.cancel()
                if measuring is not None:
                    measuring.cancel()
                if self._deadman is not None:
                    self._deadman.disarm()
                self._core.stop()
                if self._lock is not None:
                    self._lock.stop()
                for planner in planners.values():
                    planner.stop()
                self._ended.set()
                terminal.join(timeout=1.0)
                for task in list(self._tasks):
                    task.cancel()

    def show(self, record: Record) -> None:
        """Queue a record that is not from the core, for display. Any thread may call this."""
        self._shown.append(record)

    def stop(self) -> None:
        """Land after the first call; stop the setpoints after the second call."""
        self._stops += 1
        self._stopped.set()
        request = Request.LAND if self._stops == 1 else Request.RELEASE
        self._core.put(OperatorRequest(self._host_us(), request))

    def resume(self) -> None:
        """End a pause of the mission; otherwise this has no effect."""
        self._core.put(OperatorRequest(self._host_us(), Request.CONTINUE))

    def _answer_button(self, press: Press) -> tuple[Result, str]:
        reply = reply_in_flight(press, self._phase, self._lock_text)
        if isinstance(reply.effect, Request):
            self._core.put(OperatorRequest(self._host_us(), reply.effect))
        return reply.result, reply.text

    # -- deadman and terminal --

    def _feed(self, part: bytes) -> None:
        if self._deadman is not None:
            self._deadman.feed(part)

    async def _keep_alive(self) -> None:
        """Feed the deadman from the event loop; while the core thread is alive, also feed systemd."""
        systemd = SystemdNotice()
        systemd.ready(f"flying {self._mission.name}")
        starve_s = self._mission.vehicle.guard.deadman_s
        if self._options.deadman_note is not None:
            self._deadman = Deadman(starve_s, self._options.deadman_note)
            self._deadman.arm()
        try:
            while True:
                if self._deadman is not None:
                    self._deadman.feed(LOOP)
                    self._deadman.restart_if_dead()
                if self._core.age_s() < starve_s:
                    systemd.alive()
                await asyncio.sleep(FEED_PERIOD_S if self._deadman is None else self._deadman.feed_period_s)
        finally:
            systemd.stopping()

    def _show(self) -> None:
        """Show queued records periodically; a wake-up for every record would delay the core thread."""
        while not (self._ended.wait(_SHOW_PERIOD_S) and not self._shown):
            while self._shown:
                with contextlib.suppress(OSError):
                    while self._shown:
                        self._options.progress(self._shown.popleft())

    async def _watch(self, session: VehicleSession) -> None:
        reported = False
        while not self._done.is_set():
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._done.wait(), _LOOK_PERIOD_S)
            await session.detect_other_autopilot()
            problem = self._bridge.missing if self._bridge is not None else None
            if problem is not None and not reported:
                self._warn(session, f"no poses: {problem}")
            reported = problem is not None
            if self._world is not None and self._world.died and not self._done.is_set():
                self._core.put(OperatorRequest(self._host_us(), Request.WORLD_DIED, self._world.cause))
        await asyncio.sleep(_END_GRACE_S)

    @contextlib.contextmanager
    def _listening_for_operator(self) -> Iterator[None]:
        """Within the context, handle signals and the operator's key presses."""
        loop = self.loop
        assert loop is not None
        with contextlib.suppress(NotImplementedError, RuntimeError, ValueError):  # not the main thread
            loop.add_signal_handler(signal.SIGUSR1, self.resume)
        self._listen_for_key()
        with StopSignals(
            lambda number: loop.call_soon_threadsafe(self.stop),
            lambda number: loop.call_soon_threadsafe(self._report, "info", describe_repeat(number)),
        ):
            yield

    def _report(self, severity: str, text: str) -> None:
        """Add a text of this program to the flight's log."""
        assert self._session is not None
        now_us = self._host_us()
        t_us = self._session.clock.to_autopilot(now_us)
        self._core.put(StatusText(t_us, now_us, severity, text, found_here=True))

    def _listen_for_key(self) -> None:
        if self.loop is not None and sys.stdin is not None and sys.stdin.isatty():
            self.loop.add_reader(sys.stdin.fileno(), self._read_key)

    def _read_key(self) -> None:
        """Read what the operator typed; Enter ends a pause."""
        assert self.loop is not None
        terminal = sys.stdin.fileno()
        if _in_background(terminal):
            # Reading the terminal in the background would stop this program in flight.
            self.loop.remove_reader(terminal)
            self.loop.call_later(_KEY_PAUSE_S, self._listen_for_key)
            return
        try:
            typed = os.read(terminal, 1024)
        except OSError:
            typed = b""
        if not typed:  # the terminal is closed
            self.loop.remove_reader(terminal)
        elif b"\n" in typed:
            self.resume()

    # -- motion capture --

    def _open_bridge(self, session: VehicleSession, source: PoseSource) -> MotionCaptureBridge:
        def send(message: Any) -> None:
            if self._time.waits:
                pose = forwarded_pose(message)
                self._time.sent_pose((pose.x, pose.y, pose.z))
            session.send_message(message)

        def deliver(pose: PoseSample) -> None:
            if session.clock.offset_us is not None:  # without the offset, a pose gets no autopilot time
                self._core.arrive(pose)

        bridge = MotionCaptureBridge(self._mission.vehicle.mocap, source, send, session.clock, deliver)
        bridge.start()
        return bridge

    def _warn(self, session: VehicleSession, text: str) -> None:
        now_us = self._host_us()
        self.show(StatusText(session.clock.to_autopilot(now_us), now_us, "warning", text, found_here=True))

    async def _forward_until_disarmed(self, session: VehicleSession) -> None:
        """Forward poses until the vehicle is disarmed.

        A pilot may have taken control and still needs PX4's position, which comes from the poses.
        """
        if not session.armed:
            return
        self._warn(session, "forwarding poses until the vehicle is disarmed; Ctrl-C ends the forwarding")
        self._stopped.clear()
        while session.armed and not self._stopped.is_set():
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._stopped.wait(), _LOOK_PERIOD_S)

    # -- lock --

    @contextlib.contextmanager
    def _owned_driver(self) -> Iterator[Driver | None]:
        """Within the context, own the servo and return its driver, or None if there is no lock.

        Raise InputError if another process owns the servo, or its hardware is missing.
        """
        config = self._mission.vehicle.lock
        if config is None:
            yield None
            return

        def set_actuator(index: int, value: float) -> None:
            assert self._session is not None
            with self._time.command():
                self._session.set_actuator(index, value)

        link = ActuatorLink(set_actuator, self._url)
        owned = owned_driver(config, clock_us=self._autopilot_us, link=link, faults=self._lock_faults)
        with contextlib.ExitStack() as held:
            try:
                driver = held.enter_context(owned)
            except DriverError as error:
                raise InputError(str(error), source=self._mission.source, key=("lock", *error.key)) from None
            yield driver

    def _autopilot_us(self) -> int:
        assert self._session is not None
        return self._session.clock.to_autopilot(self._host_us())

    def _make_lock(self, driver: Driver, config: LockConfig) -> LockThread:
        clock_us = self._autopilot_us
        self.mock = driver if isinstance(driver, MockDriver) else None
        if self._world is not None and self.mock is None and config.driver is not LockDriver.PX4:
            # The servo is real but the vehicle is simulated: model the horn, which moves the simulated arms.
            driver = DriverWithModelledHorn(driver, config, clock_us)
        sent: list[float] = []

        def after_poll() -> None:
            # In a dry-run the modelled horn moves the simulated arms.
            if self._world is not None and isinstance(driver, MockDriver | DriverWithModelledHorn):
                pulse = driver.horn_pulse_us(clock_us())
                if sent != [pulse]:
                    sent[:] = [pulse]
                    self._world.send_horn(pulse)

        return LockThread(
            lambda keep: LockSession(config, driver, clock_us, keep),
            lambda: self._session is not None and self._session.clock.offset_us is not None,
            self._handle_lock_state,
            after_poll,
            self._time,
        )

    def _after_step(self) -> None:
        """In lockstep, poll the lock's driver if a poll is due, and deliver due answers from the planners."""
        if self._lock is not None:
            self._lock.poll_if_due()
        self._deliver_answers()

    def _handle_answer(self, answer: PlanAnswer | ContactAnswer) -> None:
        self._time.hold_answer(answer)
        self._deliver_answers()

    def _deliver_answers(self) -> None:
        for answer in self.shell.due_answers():
            self._core.put(answer)

    def _handle_lock_state(self, state: LockState) -> None:
        self._core.put(state)
        self._lock_text = status_text(state)
        if state.phase is not LockPhase.TRAVELLING and self._session is not None:
            self._session.send_text(self._lock_text)

    # -- commands of the core, on the core thread (`shell.Transport`) --

    def send(self, setpoint: Setpoint) -> None:
        """Send a setpoint immediately. If sending fails, report the error, but each error text only once."""
        assert self._session is not None
        try:
            self._session.send(setpoint)
        except Exception as error:
            # Do not end the core: PX4 keeps the last setpoint until PX4's failsafe acts.
            self._report_unsent(f"setpoint not sent: {type(error).__name__}: {error}")
            return
        self._time.sent(setpoint)

    def _report_unsent(self, text: str) -> None:
        if text not in self._unsent:
            self._unsent.add(text)
            self._report("critical", text)

    def act(self, action: VehicleAction) -> None:
        assert self.loop is not None
        self.loop.call_soon_threadsafe(self._start_action, action)

    def enter(self, phase: Phase) -> None:
        assert self._session is not None
        assert self.loop is not None
        self._phase = phase
        # `monitor` shows this text. Setpoints must not wait, so the event loop sends the text.
        self.loop.call_soon_threadsafe(self._session.send_text, f"phase {phase}")

    def fall_silent(self) -> None:
        assert self._session is not None
        self._session.silence()

    def finish(self) -> None:
        assert self.loop is not None
        self.loop.call_soon_threadsafe(self._done.set)

    def _start_action(self, action: VehicleAction) -> None:
        assert self.loop is not None
        task = self.loop.create_task(self._perform(action))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _perform(self, action: VehicleAction) -> None:
        assert self._session is not None
        problem = await self._session.perform(action)
        t_us = self._session.clock.to_autopilot(self._host_us())
        self._core.put(CommandResult(t_us, action.value, not problem, problem))

    def _observe_record(self, record: Record, number: int) -> None:
        self._observe(record, number)
        self._shown.append(record)


def _in_background(terminal: int) -> bool:
    """Return whether another job has the terminal."""
    try:
        return os.tcgetpgrp(terminal) != os.getpgrp()
    except OSError:  # another session's terminal: there is no job control
        return False
