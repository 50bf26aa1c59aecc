"""A MAVSDK connection to one autopilot: telemetry as records, setpoints and commands.

MAVSDK's callbacks run on MAVSDK's thread. Each callback builds a record and passes it to `deliver`. An
acknowledgement does not prove success: PX4 acknowledges a take-off even while disarmed. The core therefore
detects the effect of a command in the telemetry.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import queue
import re
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Collection, Iterable
from typing import Any, NamedTuple

import msgspec
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.action import Action
from mavsdk.plugins.events import Events
from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkMessage
from mavsdk.plugins.offboard import AccelerationNed, Offboard, PositionNedYaw, VelocityNedYaw

from dart_flight.base.errors import FlightError
from dart_flight.base.motor_outputs import MotorOutputDecoder
from dart_flight.base.records import (
    ActuatorSample,
    ClockOffset,
    EscSample,
    EstimatorSample,
    FlightMode,
    HealthReport,
    ImuSample,
    Input,
    LandedState,
    OdometrySample,
    OtherVehicle,
    Setpoint,
    StatusSample,
    StatusText,
    VehicleAction,
)
from dart_flight.base.streams import STREAMS, Stream
from dart_flight.config.document import InputError
from dart_flight.config.link_url import mavsdk_url
from dart_flight.config.vehicle import Estimation
from dart_flight.vehicle import arming_problems as reasons
from dart_flight.vehicle import messages, sdk_log
from dart_flight.vehicle.batteries import Batteries
from dart_flight.vehicle.callback_thread import pin_thread_state
from dart_flight.vehicle.clock import Clock, ClockEstimate, host_us
from dart_flight.vehicle.command_server import CommandServer, Press, Result
from dart_flight.vehicle.messages import AUTOPILOT, MessageEntry, Unusable
from dart_flight.vehicle.own_system import send_as
from dart_flight.vehicle.text_parts import TextAssembler, split_text

_ACTION_TIMEOUT_S = 5.0
_CLOSE_S = 3.0
_logger = logging.getLogger("dart_flight.mavsdk")
_RESULT = re.compile(r'"result":\s*(\d+)')
_SET_MESSAGE_INTERVAL = 511  # MAV_CMD
_REPEATED_US = 100_000  # interval at which an unchanged setpoint is sent again
_REQUEST_PERIOD_S = 0.1  # interval of the TIMESYNC requests
_MAX_REQUESTS = 256  # maximum number of stored requests; an answer may arrive seconds later
_MAX_TEXT_ID = 65535
_AIRBORNE = (LandedState.IN_AIR, LandedState.TAKING_OFF)
_REPORTED_US = 3_000_000  # minimum time between reports of an unusable stream
_ENOUGH_MESSAGES = 10  # consecutive unusable messages before a report


class Sender(NamedTuple):
    """The sender of a message: system, component, and instance within the component."""

    message: str
    system: int
    component: int
    instance: int


class SenderCount(msgspec.Struct):
    """The number of messages and of usable messages from a sender.

    `reason` states why the last unusable message could not be used.
    """

    messages: int = 0
    usable: int = 0
    reason: str = ""
    unusable_in_a_row: int = 0


def _without_stamps(s: Setpoint) -> tuple[object, ...]:
    return (s.position_ned, s.yaw_ned_rad, s.velocity_ned, s.acceleration_ned)


class VehicleError(FlightError):
    """The vehicle cannot be reached."""


class NoAnswerError(InputError):
    """The vehicle sends telemetry but does not answer requests, so the link cannot be used for a flight."""


class VehicleSession:
    """One connected autopilot.

    Args:
        mavsdk: the connection, kept open by the caller.
        deliver: receives every record, on MAVSDK's thread.

    Attributes:
        senders: one `SenderCount` for each sender of each subscribed message, including ignored senders.
        motor_outputs: decoder of the motor outputs, or None before `subscribe`.
        checked: whether PX4 has sent a report of its arming checks.
    """

    def __init__(
        self, mavsdk: Any, system: Any, deliver: Callable[[Input], None], clock: Clock | None = None
    ) -> None:
        self._mavsdk, self._system, self._deliver = mavsdk, system, deliver
        self._raw = getattr(system, "_system", system)
        self._offboard = Offboard(self._raw)
        self._action = Action(self._raw)
        self._direct = MavlinkDirect(self._raw)
        self._extra: list[Stream] = []  # optional streams that are subscribed
        self._motors = 0
        self.senders: dict[tuple[str, int, int, int], SenderCount] = {}
        self.batteries = Batteries()
        self.motor_outputs: MotorOutputDecoder | None = None
        self._texts = TextAssembler()
        self._reported_us: dict[str, int] = {}  # time of the last report about each unusable message
        self._reports_unusable = False
        self._rpm: list[float] = []  # motor speeds with the same stamp; one message has four of them
        self._rpm_us: int | None = None
        self._reset_counter: int | None = None
        self.clock: Clock = clock if clock is not None else ClockEstimate()
        self._host_us = self.clock.host_us
        self._status = StatusSample(t_us=0, received_us=0)
        self._has_position = False  # whether a usable ODOMETRY has arrived
        self._estimator_ok = True  # from ESTIMATOR_STATUS, which not every vehicle sends
        self._silent = False
        self._sent: tuple[object, ...] | None = None  # values of the last setpoint sent
        self._sent_us = 0
        self._events = Events(self._raw)
        self._requests_us: deque[int] = deque(maxlen=_MAX_REQUESTS)  # host times of TIMESYNC requests
        self._text_id = 0
        self._server: CommandServer | None = None
        self._other: int | None = None  # system id of another autopilot on the link
        self.checked = False
        self._health: tuple[bool, tuple[str, ...], tuple[str, ...]] | None = None

    # -- telemetry --

    def subscribe(
        self, estimation: Estimation, motors: int, guarded: bool = True, lowest_battery_v: float = 0.0
    ) -> None:
        """Subscribe to the streams in the table and to status messages.

        Args:
            estimation: selects the sources of thrust.
            motors: number of the vehicle's motors.
            guarded: whether to subscribe also to the messages that only the core's guard needs.
            lowest_battery_v: lowest voltage at which the vehicle may fly (`guard.battery_v`).
        """
        self._motors, self.motor_outputs = motors, MotorOutputDecoder(motors)
        self.batteries = Batteries(lowest_battery_v)
        self._reports_unusable = guarded
        self.listen(messages.HIGHRES_IMU, self._on_imu)
        self.listen(messages.ATTITUDE_QUATERNION, lambda sample, _: self._deliver(sample))
        self.listen(messages.ODOMETRY, self._on_odometry)
        self.listen(messages.ACTUATOR_OUTPUT_STATUS, self._on_actuator)
        self.listen(messages.HEARTBEAT, self._on_heartbeat)
        self.listen(messages.EXTENDED_SYS_STATE, lambda landed, _: self._on_status(landed=landed))
        self.listen(messages.BATTERY_STATUS, self._on_battery, self._on_battery_gone)
        self.listen(messages.STATUSTEXT, self._on_status_text)
        if estimation.uses_esc:
            self._listen_optional(messages.ESC_STATUS, self._on_esc)
        if guarded:
            self._listen_optional(messages.ESTIMATOR_STATUS, self._on_estimator_status)
            self._listen_optional(messages.CURRENT_MODE, self._on_mode)
            self._subscribe_events()

    def _listen_optional(self, entry: MessageEntry, on_value: Callable[[Any, int], Unusable | None]) -> None:
        """Subscribe to an optional stream, which `set_rates` then requests."""
        assert entry.stream is not None
        self._extra.append(entry.stream)
        self.listen(entry, on_value)

    def listen(
        self,
        entry: MessageEntry,
        on_value: Callable[[Any, int], Unusable | None],
        on_unusable: Callable[[int], None] | None = None,
    ) -> Any:
        """Subscribe to a message in the table; return MAVSDK's handle of the subscription.

        Args:
            on_value: receives each usable value from the autopilot's component, and the value's time of
                receipt. It returns None, or `Unusable` if it cannot use the value.
            on_unusable: receives the instance of each unusable message from the autopilot's component.
        """
        decode, counts, name = entry.reader(), self.senders, entry.message
        own = self._raw.get_system_id()
        is_needed = entry.stream is not None and entry.stream.expected_hz > 0.0

        def handle(message: Any, _: Any) -> None:
            received = self._host_us()
            is_own = message.component_id == AUTOPILOT and message.system_id == own

            def receive(stamp_us: int) -> int:
                nonlocal received
                if is_own:  # the clock must follow only the connected autopilot
                    received = self.clock.receive(stamp_us, received)
                return received

            instance, value = decode(message.fields_json, receive)
            sender = (name, message.system_id, message.component_id, instance)
            count = counts.get(sender)
            if count is None:
                count = counts[sender] = SenderCount()
            count.messages += 1
            if not is_own:
                return
            if not isinstance(value, Unusable):
                value = on_value(value, received)
                if value is None:
                    count.usable += 1
                    count.unusable_in_a_row = 0
                    return
            elif on_unusable is not None:
                on_unusable(instance)
            count.reason = value.reason
            count.unusable_in_a_row += 1
            if is_needed and count.unusable_in_a_row >= _ENOUGH_MESSAGES:
                self._report_unusable(name, value.reason, received)

        return self._direct.subscribe_message(name, handle)

    def unlisten(self, handle: Any) -> None:
        self._direct.unsubscribe_message(handle)

    def newest(self, entry: MessageEntry, seconds: float) -> Any:
        """Block for `seconds` and return the newest usable value received."""
        found: list[Any] = []

        def keep(value: Any, _: int) -> None:
            found[:] = [value]

        handle = self.listen(entry, keep)
        time.sleep(seconds)
        self.unlisten(handle)
        return found[0] if found else None

    def next(self, entry: MessageEntry, timeout_s: float) -> Any:
        """Block until the next usable value arrives, and return the value; return None after the timeout."""
        came: queue.SimpleQueue[Any] = queue.SimpleQueue()
        handle = self.listen(entry, lambda value, _: came.put(value))
        try:
            return came.get(timeout=timeout_s)
        except queue.Empty:
            return None
        finally:
            self.unlisten(handle)

    def unusable_reason(self, entry: MessageEntry) -> str:
        """Return why the autopilot's last message of this kind was unusable, or "" if it was usable."""
        own = self._raw.get_system_id()
        for (name, system, component, _), count in self.senders.items():
            if (name, system, component) == (entry.message, own, AUTOPILOT) and count.unusable_in_a_row:
                return count.reason
        return ""

    def _report_unusable(self, name: str, reason: str, received: int) -> None:
        """At most every 3 s, deliver the reason why a stream has no usable message."""
        if self._reports_unusable and received - self._reported_us.get(name, -_REPORTED_US) >= _REPORTED_US:
            self._reported_us[name] = received
            text = f"{name} arrives, but no message is usable: {reason}"
            t_us = self.clock.to_autopilot(received)
            self._deliver(StatusText(t_us, received, "error", text, found_here=True))

    async def set_rates(self, names: Collection[str] | None = None, watching: bool = False) -> list[str]:
        """Request the rates in the table; return the names of the streams that PX4 refused.

        Args:
            names: streams to request, or None for all. Subscribed optional streams are always requested.
            watching: whether to request lower rates, which suffice for a display.
        """
        wanted = [s for s in STREAMS if names is None or s.name in names]
        rates = [(s, s.watched_hz if watching else s.rate_hz) for s in wanted]
        rates += [(s, s.rate_hz) for s in self._extra]
        return [s.name for s, hz in rates if not await self._request_rate(s, hz)]

    async def _request_rate(self, stream: Stream, rate_hz: float) -> bool | None:
        return await asyncio.to_thread(self._request_interval, stream.number, round(1e6 / rate_hz))

    async def stop_messages(self, numbers: Iterable[int]) -> None:
        """Ask PX4 to stop sending these messages on this link; ignore a refusal."""
        for number in numbers:
            await asyncio.to_thread(self._request_interval, number, -1)

    async def measure_link(self, timeout_s: float) -> list[str]:
        """Wait for the first answer to a request; return the unanswered requests if no answer arrives.

        The requests are TIMESYNC and, if the vehicle does not answer TIMESYNC, a rate request.
        """
        loop, heard = asyncio.get_running_loop(), asyncio.Event()

        def handle(answer: messages.Timesync, received: int) -> Unusable | None:
            refused = self._handle_answer(answer, received)
            if refused is None and not heard.is_set():  # an answer may arrive after the end of the loop
                loop.call_soon_threadsafe(heard.set)
            return refused

        self.listen(messages.TIMESYNC, handle)
        asking = asyncio.create_task(self.keep_measuring())
        try:
            await asyncio.wait_for(heard.wait(), timeout_s)
            return []
        except TimeoutError:
            pass
        finally:
            asking.cancel()
        sent, stream = host_us(), STREAMS[0]
        if await self._request_rate(stream, stream.rate_hz) is None:
            return ["TIMESYNC", f"rate of {stream.message}"]
        self._deliver(self.clock.round_trip(sent, host_us(), None))
        return []

    async def keep_measuring(self) -> None:
        """Send TIMESYNC requests periodically; the subscription of `measure_link` handles the answers."""
        while True:
            with contextlib.suppress(Exception):  # missing answers reveal a broken link
                self.request_time()
            await asyncio.sleep(_REQUEST_PERIOD_S)

    def request_time(self) -> None:
        """Send a TIMESYNC request; the answer repeats the host time and adds the autopilot's time."""
        now = host_us()  # real time, because simulated time may stop in lockstep
        self._requests_us.append(now)
        fields = {"tc1": 0, "ts1": 1000 * now, "target_system": 0, "target_component": 0}
        text = msgspec.json.encode(fields).decode()
        self.send_message(MavlinkMessage("TIMESYNC", 0, 0, 0, 0, text))

    def _handle_answer(self, answer: messages.Timesync, _: int) -> Unusable | None:
        if answer.sent_us not in self._requests_us:
            return Unusable("the message answers another program's request")
        self._deliver(self.clock.round_trip(answer.sent_us, host_us(), answer.autopilot_us))
        return None

    def _request_interval(self, number: int, interval_us: int) -> bool | None:
        """Send SET_MESSAGE_INTERVAL; return whether PX4 accepted the interval, or None without an answer."""
        fields = {
            "target_system": self._raw.get_system_id(),
            "target_component": 1,
            "command": _SET_MESSAGE_INTERVAL,
            "confirmation": 0,
            "param1": number,
            "param2": interval_us,
            **{f"param{i}": 0 for i in range(3, 8)},
        }
        command = MavlinkMessage("COMMAND_LONG", 0, 0, 0, 0, msgspec.json.encode(fields).decode())
        try:
            answer = self._direct.send_command(command)
        except MavsdkError:
            return None
        found = _RESULT.search(answer.fields_json)
        return found is not None and int(found[1]) == 0

    def _stamp(self, t_us: int, received_us: int) -> None:
        offset = self.clock.update(t_us, received_us)
        if offset is not None:
            self._deliver(ClockOffset(received_us, offset))

    def _on_imu(self, sample: ImuSample, received: int) -> None:
        self._stamp(sample.t_us, received)
        self._deliver(sample)

    def _on_odometry(self, estimate: tuple[OdometrySample, int], _: int) -> None:
        sample, reset_counter = estimate
        if reset_counter != self._reset_counter:
            self._reset_counter = reset_counter
            self._deliver_estimator(reset_counter=reset_counter)
        self._deliver(sample)
        if not self._has_position:
            self._has_position = True
            self._update_local_position()

    def _on_estimator_status(self, estimator: messages.EstimatorState, _: int) -> None:
        self._estimator_ok = estimator.healthy
        self._deliver_estimator(healthy=estimator.healthy, position_sd_m=estimator.position_sd_m)
        self._update_local_position()

    def _update_local_position(self) -> None:
        ok = self._has_position and self._estimator_ok
        if self._status.local_position_ok is not ok:
            self._on_status(local_position_ok=ok)

    def _deliver_estimator(self, **what: Any) -> None:
        received = self._host_us()
        self._deliver(EstimatorSample(self.clock.to_autopilot(received), received, **what))

    def _on_actuator(self, outputs: messages.Outputs, received: int) -> Unusable | None:
        assert self.motor_outputs is not None
        throttles = self.motor_outputs.decode(outputs.values, self._status.landed in _AIRBORNE)
        if isinstance(throttles, str):
            return Unusable(f"the motors' outputs are invalid: {throttles}")
        self._deliver(ActuatorSample(outputs.t_us, received, throttles))
        return None

    def _on_esc(self, group: messages.EscGroup, received: int) -> Unusable | None:
        if group.first == 0:
            self._rpm, self._rpm_us = [], group.t_us
        if group.t_us != self._rpm_us or group.first != len(self._rpm):
            return Unusable("a group of motors with the same time stamp is missing")
        self._rpm += map(float, group.rpm)
        if len(self._rpm) >= self._motors:
            self._deliver(EscSample(group.t_us, received, tuple(self._rpm[: self._motors])))
            self._rpm_us = None
        return None

    def _on_status(self, **changes: Any) -> None:
        received = self._host_us()
        pin_thread_state()  # all callbacks share one thread, so an infrequent callback suffices for this
        self._status = msgspec.structs.replace(
            self._status, t_us=self.clock.to_autopilot(received), received_us=received, **changes
        )
        self._deliver(self._status)

    def _on_heartbeat(self, beat: messages.Heartbeat, received: int) -> None:
        for text in self._texts.overdue():
            self._deliver_text(text, received)
        self._on_status(armed=beat.armed, flight_mode=beat.flight_mode, system_status=beat.system_status)

    def _on_mode(self, mode: FlightMode, _: int) -> None:
        if mode is not self._status.flight_mode:
            self._on_status(flight_mode=mode)

    def _on_battery(self, reading: messages.BatteryReading, _: int) -> None:
        self.batteries.update(reading)
        self._deliver_battery()

    def _on_battery_gone(self, number: int) -> None:
        if self.batteries.remove(number):
            self._deliver_battery()

    def _deliver_battery(self) -> None:
        worst = self.batteries.worst()
        if worst is None:
            self._on_status(battery_v=None, battery_remaining=None, battery_id=None)
        else:
            self._on_status(battery_v=worst.voltage_v, battery_remaining=worst.remaining, battery_id=worst.id)

    def _on_status_text(self, chunk: messages.TextChunk, received: int) -> None:
        for text in self._texts.add(chunk):
            self._deliver_text(text, received)

    def _deliver_text(self, text: tuple[str, str], received: int) -> None:
        self._deliver(StatusText(self.clock.to_autopilot(received), received, *text))

    async def detect_other_autopilot(self) -> None:
        """Deliver one record if an autopilot with a different system id sends on the link."""
        if self._other is not None:
            return
        own = self._raw.get_system_id()
        for system in await self._mavsdk.get_systems():
            raw = getattr(system, "_system", system)
            if raw.has_autopilot() and raw.get_system_id() != own:
                self._other = int(raw.get_system_id())
                received = self._host_us()
                self._deliver(OtherVehicle(self.clock.to_autopilot(received), received, self._other))
                return

    def _subscribe_events(self) -> None:
        """Subscribe to PX4's events and to its health and arming checks.

        MAVSDK reads the event texts from the vehicle or from MAVSDK's cache. A vehicle without event texts
        provides only STATUSTEXT and SYS_STATUS.
        """
        self.listen(messages.SYS_STATUS, self._on_sys_status)
        with contextlib.suppress(Exception):  # a flight does not depend on the events
            self._events.subscribe_events(self._on_event)
            self._events.subscribe_health_and_arming_checks(self._on_checks)

    def _on_event(self, event: Any, _: Any) -> None:
        if event.compid != AUTOPILOT:
            return
        received = self._host_us()
        text = StatusText(
            self.clock.to_autopilot(received),
            received,
            reasons.severity(event.log_level),
            event.message,
            event.event_name,
        )
        self._deliver(text)

    def _on_checks(self, report: Any, _: Any) -> None:
        self.checked = True
        self._deliver_health(*reasons.report_from_checks(report))

    def _on_sys_status(self, sensors: messages.Sensors, _: int) -> None:
        if not self.checked:
            self._deliver_health(*reasons.report_from_sys_status(sensors))

    def _deliver_health(self, can_arm: bool, blocking: tuple[str, ...], others: tuple[str, ...]) -> None:
        now = (can_arm, blocking, others)
        if now != self._health:
            self._health = now
            received = self._host_us()
            self._deliver(HealthReport(self.clock.to_autopilot(received), received, *now))

    # -- commands --

    def send(self, setpoint: Setpoint) -> None:
        """Send a setpoint immediately, from any thread; MAVSDK repeats it at 20 Hz until the next setpoint.

        In offboard mode, a setpoint equal to the last setpoint is skipped for 0.1 s, because MAVSDK repeats
        the last setpoint. In other modes MAVSDK repeats nothing and needs a setpoint to start offboard mode,
        so no setpoint is skipped. A recovery setpoint is never skipped.
        """
        if self._silent:
            return
        values, now_us = _without_stamps(setpoint), self._host_us()
        repeats = self._status.flight_mode is FlightMode.OFFBOARD and now_us - self._sent_us < _REPEATED_US
        if repeats and values == self._sent and not setpoint.recovery:
            return
        self._sent, self._sent_us = values, now_us
        yaw = math.degrees(setpoint.yaw_ned_rad)
        position = PositionNedYaw(*setpoint.position_ned, yaw)
        v, a = setpoint.velocity_ned, setpoint.acceleration_ned
        if v is None:
            self._offboard.set_position_ned(position)
        elif a is None:
            self._offboard.set_position_velocity_ned(position, VelocityNedYaw(*v, yaw))
        else:
            self._offboard.set_position_velocity_acceleration_ned(
                position, VelocityNedYaw(*v, yaw), AccelerationNed(*a)
            )

    async def perform(self, action: VehicleAction) -> str:
        """Perform an action; return the reason if it was not performed, otherwise an empty string."""
        if self._silent:
            return "silent"
        calls: dict[VehicleAction, Callable[..., Any]] = {
            VehicleAction.OFFBOARD: self._offboard.start_async,
            VehicleAction.ARM: self._action.arm_async,
            VehicleAction.LAND: self._action.land_async,
            VehicleAction.DISARM: self._action.disarm_async,
            VehicleAction.KILL: self._action.kill_async,
        }
        # Use callbacks: the blocking calls never return if the connection is closed meanwhile.
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[str] = loop.create_future()

        def settle(name: str) -> None:
            if not answer.done():
                answer.set_result(name)

        calls[action](lambda result, _: loop.call_soon_threadsafe(settle, result.name))
        try:
            name = await asyncio.wait_for(answer, _ACTION_TIMEOUT_S)
        except TimeoutError:
            return "no answer"
        return "" if name == "SUCCESS" else name

    def send_message(self, message: MavlinkMessage) -> None:
        """Send a raw message from any thread; ignore errors, because missing answers reveal a broken link."""
        with contextlib.suppress(MavsdkError):
            self._direct.send_message(message)

    @property
    def armed(self) -> bool:
        """Whether the vehicle is armed, according to the newest heartbeat."""
        return self._status.armed

    def silence(self) -> None:
        """Stop sending messages; MAVSDK repeats the last setpoint until PX4 leaves offboard mode."""
        self._silent = True

    def set_actuator(self, index: int, value: float) -> None:
        """Command a peripheral output and wait for PX4's acknowledgement, which does not prove movement.

        Raise VehicleError if PX4 refuses the command or does not answer.
        """
        try:
            self._action.set_actuator(index, value)
        except MavsdkError as error:
            raise VehicleError(str(error)) from error

    def send_text(self, text: str) -> None:
        """Send a text to the ground station as STATUSTEXT, in parts if it is long; ignore errors."""
        self._text_id = self._text_id % _MAX_TEXT_ID + 1
        with contextlib.suppress(Exception):
            for fields in split_text(text, self._text_id):
                self._direct.send_message(
                    MavlinkMessage("STATUSTEXT", 0, 0, 0, 0, msgspec.json.encode(fields).decode())
                )

    def serve_operator(self, system_id: int, answer: Callable[[Press], tuple[Result, str]]) -> None:
        """Respond to a ground station's commands, on MAVSDK's thread (`CommandServer`).

        Each answer is also sent to the ground station as a text and delivered as a record.
        """

        def note(text: str) -> None:
            self.send_text(text)
            received = self._host_us()
            t_us = self.clock.to_autopilot(received)
            self._deliver(StatusText(t_us, received, "info", f"ground station: {text}", found_here=True))

        self._server = CommandServer(self._mavsdk, system_id, answer, note)


@contextlib.asynccontextmanager
async def connect(
    url: str,
    timeout_s: float,
    deliver: Callable[[Input], None],
    *,
    ground: bool = False,
    clock: Clock | None = None,
    opened: Callable[[], None] = lambda: None,
) -> AsyncIterator[VehicleSession]:
    """Connect to the first autopilot on a URL: `async with connect(...) as session`.

    Args:
        timeout_s: timeout of the first heartbeat.
        deliver: receives every record, on MAVSDK's thread.
        ground: whether to appear as a ground station instead of a companion computer. On the vehicle's
            computer this must be False. Otherwise PX4 could mistake this program's heartbeat for the real
            ground station's, and would not detect the loss of the station's link.
        clock: clock of an autopilot whose time is not real time, such as `LockstepClock`.
        opened: called as soon as MAVSDK has opened the link and an autopilot has answered.

    Raises:
        VehicleError: on entering, if the URL cannot be opened or no autopilot answers.
    """
    sdk_log.redirect()
    component = ComponentType.GROUND_STATION if ground else ComponentType.COMPANION_COMPUTER
    mavsdk: Any = Mavsdk(Configuration.create_with_component_type(component))
    await mavsdk.__aenter__()
    try:
        system = await _first_autopilot(mavsdk, url, timeout_s)
        if not ground:
            send_as(mavsdk, component, int(getattr(system, "_system", system).get_system_id()))
        opened()
        yield VehicleSession(mavsdk, system, deliver, clock)
    finally:
        with sdk_log.closing():
            _close(mavsdk)


def _close(mavsdk: Any) -> None:
    """Close the connection, but do not wait longer than `_CLOSE_S` for a callback that never returns."""
    closing = threading.Thread(target=mavsdk.destroy, name="MAVSDK close", daemon=True)
    closing.start()
    closing.join(_CLOSE_S)
    if closing.is_alive():
        _logger.error("MAVSDK did not close within %g s; it ends with this program", _CLOSE_S)


async def _first_autopilot(mavsdk: Any, url: str, timeout_s: float) -> Any:
    """Open the link and return the first autopilot on it."""
    try:
        await mavsdk.add_any_connection(mavsdk_url(url))
        system = await mavsdk.first_autopilot(timeout_s=timeout_s)
    except Exception as error:
        raise VehicleError(f"cannot open {url}: {error}") from error
    if system is None:
        raise VehicleError(f"no autopilot on {url} within {timeout_s:g} s")
    return system
