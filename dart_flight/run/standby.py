"""Standby, which holds link and lock between flights and passes the link to `check` and `fly` processes.

`StandbyDesk` decides without I/O. `Standby` has the connection, the lock and the child processes. Standby
starts a flight with the command that an operator would type, so flights also work without standby.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

import msgspec

from dart_flight.base.records import LockCommand, LockPhase, LockState, Mode
from dart_flight.base.signals import StopSignals, describe_repeat
from dart_flight.config.held_files import pass_kept
from dart_flight.config.vehicle import LockConfig, VehicleConfig
from dart_flight.lock.drivers import ActuatorLink, DriverError
from dart_flight.lock.ground import GroundLock, clock_us, ground_driver
from dart_flight.lock.lock_session import LockSession
from dart_flight.lock.persistence import CommandStore, ServoInUseError, load_last
from dart_flight.lock.state_machine import describe, status_text
from dart_flight.run.deadman import SystemdNotice
from dart_flight.run.lock_thread import LockThread
from dart_flight.run.operator_buttons import (
    CANCELLED,
    Button,
    Errand,
    RcSwitch,
    Reply,
    StandbyButtons,
    StandbyState,
    button_of,
)
from dart_flight.vehicle import messages
from dart_flight.vehicle.command_server import Press, Result
from dart_flight.vehicle.link import LinkInUseError, LinkLease
from dart_flight.vehicle.motion_capture.pose_bridge import MotionCaptureBridge, forwarding
from dart_flight.vehicle.motion_capture.source import AbsentSourceError, open_source
from dart_flight.vehicle.vehicle_session import VehicleError, VehicleSession, connect

_RETRY_S: Final = 5.0
_CONNECT_S: Final = 5.0  # in each attempt to connect, wait this long for the autopilot's heartbeat
_ALIVE_S: Final = 0.5
_SYSTEMD: Final = (
    "NOTIFY_SOCKET",
    "WATCHDOG_USEC",
    "WATCHDOG_PID",
)  # systemd's variables, which child processes must not inherit
_TEXT_PAUSE_S: Final = 0.3  # pause between messages: PX4 buffers only about 580 bytes and drops the rest
_LAST_WORDS_S: Final = 0.3  # wait this long for the last answers before the connection closes
_RADIO_S: Final = 3.0  # after this time without PX4's report, a remote control counts as lost
_RC_RECEIVER: Final = 65536  # MAV_SYS_STATUS_SENSOR
_NO_GOES: Final = 3  # the ground station receives this many no-gos of a check, and the journal all of them


class Ended(NamedTuple):
    """Result of a child process: status (negative if ended by a signal), output, and last line of stderr."""

    status: int
    output: bytes
    last_line: str


class StandbyDesk:
    """State and decisions of standby, without I/O and without a clock.

    `rc_channel` is the channel of the switch that moves the lock, or None.
    """

    def __init__(self, missions: Sequence[str], rc_channel: int | None, has_lock: bool) -> None:
        self._missions, self._has_lock, self._channel = tuple(missions), has_lock, rc_channel
        self.reset()

    def reset(self) -> None:
        """Reset the state, which may have changed while another process had the link."""
        self._buttons, self._switch = StandbyButtons(), RcSwitch()
        self._radio_s = -math.inf  # time of PX4's last report of a remote control
        self._armed: bool | None = None
        self._travelling: Mode | None = None

    def press(self, press: Press, now_s: float) -> Reply:
        radio = now_s - self._radio_s <= _RADIO_S
        state = StandbyState(self._missions, self._has_lock, self._travelling, self._armed, radio)
        return self._buttons.reply(press, state, now_s)

    def update_lock(self, state: LockState) -> None:
        self._travelling = state.mode if state.phase is LockPhase.TRAVELLING else None

    def update_armed(self, armed: bool) -> None:
        self._armed = armed

    def update_sensors(self, present: int, now_s: float) -> None:
        """Store whether PX4's sensor bits `present` include a valid remote control."""
        self._radio_s = now_s if present & _RC_RECEIVER else -math.inf

    def update_switch(self, pulses_us: Sequence[int], now_s: float) -> Mode | None:
        """Return the mode to which the transmitter's switch moves the lock."""
        if now_s - self._radio_s > _RADIO_S or self._channel is None or self._channel > len(pulses_us):
            return None  # a receiver that has lost its transmitter may send preset positions
        return self._switch.update(pulses_us[self._channel - 1], now_s)


def describe_end(name: str, fly: bool, ended: Ended) -> list[str]:
    """Return the result of a `check` or `fly` process, as lines for the ground station."""
    try:
        report = msgspec.json.decode(ended.output)
    except ValueError:
        report = {}
    if not isinstance(report, dict):
        report = {}
    if ended.status < 0:
        how = signal.Signals(-ended.status).name
        after = ": PX4's failsafe flies the vehicle" if fly else ""
        return [f"{name}: the process was killed by {how}{after}"]
    if "outcome" in report:
        reason = f": {report['reason']}" if report.get("reason") else ""
        return [f"{name}: {report['outcome']}{reason}"]
    if "findings" in report:
        if report["go"]:
            return [f"{name}: go"]
        bad = [f for f in report["findings"] if not f["go"] and not f.get("overruled")]
        more = f" and {len(bad) - _NO_GOES} more" if len(bad) > _NO_GOES else ""
        return [f"{name}: no-go{more}", *(f"{f['item']}: {f['message']}" for f in bad[:_NO_GOES])]
    return [f"{name}: {ended.last_line or f'ended with status {ended.status}'}"]


class Standby:
    """Resident program that holds the link between flights.

    Args:
        missions: names and files of the missions, in the order of the buttons.
        options: additional options of `fly` and `check`.
        report: callback for messages: a kind (`standby`, `child` or `problem`) and a line.
    """

    def __init__(
        self,
        missions: Sequence[tuple[str, str]],
        vehicle: VehicleConfig,
        url: str,
        options: Sequence[str],
        report: Callable[[str, str], None],
    ) -> None:
        self._missions, self._vehicle, self._url = missions, vehicle, url
        self._options, self._say = options, report
        channel = None if vehicle.lock is None else vehicle.lock.rc_channel
        self._desk = StandbyDesk([name for name, _ in missions], channel, vehicle.has_lock)
        self._news: list[str] = []  # lines to send to the ground station once the link is back
        self._errand: Errand | None = None
        self._child: asyncio.subprocess.Process | None = None
        self._stops = 0
        self._wake = asyncio.Event()
        self._lock: LockThread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    async def run(self) -> None:
        """Stand by until SIGINT, SIGTERM or SIGHUP (`StopSignals`); a flight in progress lands first.

        Raise InputError if the motion capture or the state folder cannot be used.
        """
        self._loop = asyncio.get_running_loop()
        systemd = SystemdNotice()
        systemd.ready("standby")
        alive = asyncio.create_task(_keep_alive(systemd))
        problem = ""
        try:
            with StopSignals(self._receive_stop, self._receive_repeat):
                while not self._stops:
                    try:
                        await self._hold()
                        problem = ""
                    except (LinkInUseError, VehicleError, ServoInUseError, DriverError) as error:
                        if str(error) != problem:  # report it once
                            problem = str(error)
                            self._say("problem", f"{problem}; retrying")
                        await self._rest(_RETRY_S)
                    errand, self._errand = self._errand, None
                    if errand is not None and not self._stops:
                        await self._run_errand(errand)
        finally:
            alive.cancel()
            systemd.stopping()

    def _receive_stop(self, number: signal.Signals) -> None:
        assert self._loop is not None
        self._loop.call_soon_threadsafe(self._stop)

    def _receive_repeat(self, number: signal.Signals) -> None:
        assert self._loop is not None
        self._loop.call_soon_threadsafe(self._say, "standby", describe_repeat(number))

    def _stop(self) -> None:
        """End standby, and pass each signal to a flight in progress.

        After the first signal the vehicle lands. After the second signal the flight sends no more setpoints.
        The two signals differ, so that the flight can distinguish the second from a repeated first signal.
        """
        self._stops += 1
        self._wake.set()
        if self._child is not None and self._child.returncode is None:
            self._child.send_signal(signal.SIGTERM if self._stops % 2 else signal.SIGINT)

    async def _rest(self, seconds: float) -> None:
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._wake.wait(), seconds)

    # -- holding the link --

    async def _hold(self) -> None:
        """Hold link, lock and motion capture until a button starts another process or standby ends."""
        vehicle = self._vehicle
        self._wake.clear()
        self._desk.reset()
        async with contextlib.AsyncExitStack() as held:
            lease = held.enter_context(LinkLease(self._url, "standby"))
            opening = connect(self._url, _CONNECT_S, lambda record: None, opened=lease.lock_device)
            session = await held.enter_async_context(opening)
            if vehicle.lock is not None:
                self._lock = held.enter_context(self._holding_lock(vehicle.lock, session))
            session.listen(messages.HEARTBEAT, lambda beat, _: self._desk.update_armed(beat.armed))
            session.listen(
                messages.SYS_STATUS, lambda s, _: self._desk.update_sensors(s.present, time.monotonic())
            )
            session.listen(messages.RC_CHANNELS, lambda pulses, _: self._handle_channels(pulses))
            session.serve_operator(vehicle.ground_station.system_id, self._answer)
            self._say("standby", "holding the link")
            for text in [*self._news, "standby"]:
                session.send_text(text)
                await asyncio.sleep(_TEXT_PAUSE_S)
            self._news.clear()
            bridge: MotionCaptureBridge | None = None
            problem: str | None = None
            while not self._wake.is_set():
                before = problem
                if bridge is None and vehicle.mocap.url is not None:
                    bridge, problem = await self._open_poses(vehicle.mocap.url, session, held)
                elif bridge is not None:
                    problem = bridge.missing
                if problem is not None and before is None:
                    self._say("standby", f"no poses: {problem}")
                await self._rest(_RETRY_S)
            await asyncio.sleep(_LAST_WORDS_S)

    async def _open_poses(
        self, url: str, session: VehicleSession, held: contextlib.AsyncExitStack
    ) -> tuple[MotionCaptureBridge | None, str | None]:
        """Start forwarding poses; if the cameras are not running yet, return None and the reason."""
        try:
            source = await asyncio.to_thread(open_source, url)
        except AbsentSourceError as error:
            return None, f"{error}; retrying"
        poses = forwarding(
            self._vehicle.mocap, session.send_message, session.clock, lambda pose: None, source
        )
        return held.enter_context(poses), None

    @contextlib.contextmanager
    def _holding_lock(self, config: LockConfig, session: VehicleSession) -> Iterator[LockThread]:
        """Within the context, run the lock; the servo does not move without a command.

        Standby then owns the servo until standby's process ends. During a flight, the flight's process uses
        the servo.

        Raises:
            ServoInUseError: another process moves the servo.
            DriverError: the driver of the servo cannot be opened.
        """
        store = CommandStore(config.driver)

        def make_session(keep: Callable[[LockState], None]) -> LockSession:
            def store_and_keep(state: LockState) -> None:
                store.store(state)
                keep(state)

            return GroundLock(config, driver, store_and_keep).session

        def handle(state: LockState) -> None:
            self._desk.update_lock(state)
            if state.phase is not LockPhase.TRAVELLING:
                session.send_text(status_text(state))
                self._say("standby", f"lock {describe(state)}")

        link = ActuatorLink(session.set_actuator, self._url)
        with ground_driver(config, load_last(), link, lasting=True) as driver:
            lock = LockThread(make_session, lambda: True, handle)
            lock.thread.start()
            try:
                yield lock
            finally:
                self._lock = None
                lock.stop()

    def _answer(self, press: Press) -> tuple[Result, str]:
        """Answer a button, on MAVSDK's thread."""
        if self._errand is not None:
            if not self._errand.fly or button_of(press) is not Button.LAND:
                return Result.TEMPORARILY_REJECTED, "the link is being passed to another command"
            self._errand = None
            self._say("standby", CANCELLED)
            return Result.ACCEPTED, CANCELLED
        reply = self._desk.press(press, time.monotonic())
        if isinstance(reply.effect, Mode):
            self._move(reply.effect)
        elif isinstance(reply.effect, Errand):
            self._errand = reply.effect
            assert self._loop is not None
            self._loop.call_soon_threadsafe(self._wake.set)
        said = reply.result.name.lower().replace("_", " ")
        self._say("standby", f"button {press.button} {said}: {reply.text}")
        return reply.result, reply.text

    def _handle_channels(self, pulses_us: Sequence[int]) -> None:
        mode = self._desk.update_switch(pulses_us, time.monotonic())
        if mode is not None:
            self._say("standby", f"transmitter: moving to {mode}")
            self._move(mode)

    def _move(self, mode: Mode) -> None:
        if self._lock is not None:
            self._lock.obey(LockCommand(clock_us(), mode))

    # -- handing the link over --

    async def _run_errand(self, errand: Errand) -> None:
        """Run the processes of an errand in order, and store their results for the ground station."""
        for number in errand.missions:
            name, path = self._missions[number - 1]
            command = ["fly", path, "--yes"] if errand.fly else ["check", path]
            self._say("standby", f"passing the link to dart-flight {command[0]} {path}")
            lines = describe_end(name, errand.fly, await self._run_child(command))
            for line in lines:
                self._say("standby", line)
            self._news += lines
            if self._stops:
                break

    async def _run_child(self, command: Sequence[str]) -> Ended:
        """Run a `dart-flight` command on the link, and pass on all messages of the command."""
        # In a new session the child gets no Ctrl-C of its own; standby passes Ctrl-C on once.
        descriptors, kept = pass_kept()  # the child inherits the right to use the servo
        inherited = {name: value for name, value in os.environ.items() if name not in _SYSTEMD}
        child = self._child = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "dart_flight", *command, "--json", "--connection", self._url),
            *self._options,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            env=inherited | kept,
            pass_fds=descriptors,
            start_new_session=True,
        )
        assert child.stdout is not None
        reading = asyncio.create_task(self._pass_on(child))
        output = await child.stdout.read()
        last_line = await reading
        return Ended(await child.wait(), output, last_line)

    async def _pass_on(self, child: asyncio.subprocess.Process) -> str:
        """Pass on every line of a child's messages, and return the last line."""
        assert child.stderr is not None
        last = ""
        async for line in child.stderr:
            text = line.decode(errors="replace").rstrip()
            if text:
                last = text
                self._say("child", text)
        return last


async def _keep_alive(systemd: SystemdNotice) -> None:
    while True:
        systemd.alive()
        await asyncio.sleep(_ALIVE_S)
