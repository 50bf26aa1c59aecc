"""A MAVSDK connection to one autopilot: telemetry to samples, setpoints and commands out.

MAVSDK's callbacks come on its own thread: they build one record and hand it to `deliver`, nothing else.
Acknowledgements prove nothing (a take-off while disarmed is acknowledged): what commands have done is seen in
telemetry, by the core.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import re
from collections import deque
from collections.abc import Callable, Collection, Iterable
from typing import Any

import msgspec
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.events import Events
from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkMessage
from mavsdk.plugins.offboard import AccelerationNed, Offboard, PositionNedYaw, VelocityNedYaw
from mavsdk.plugins.server_utility import ServerUtility
from mavsdk.plugins.server_utility import StatusTextType as OwnStatusTextType
from mavsdk.plugins.telemetry import FlightMode as SdkFlightMode
from mavsdk.plugins.telemetry import LandedState as SdkLandedState
from mavsdk.plugins.telemetry import Telemetry

from dart_flight.base.errors import FlightError
from dart_flight.base.records import (
    MOTOR_FULL_US,
    MOTOR_STOP_US,
    ActuatorSample,
    AttitudeSample,
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
    SystemStatus,
    VehicleAction,
)
from dart_flight.base.streams import ESC, ESTIMATOR, MESSAGE_ID, STREAMS, Stream
from dart_flight.config.document import InputError
from dart_flight.config.vehicle import Estimation
from dart_flight.vehicle import arming_problems as reasons
from dart_flight.vehicle import sdk_log
from dart_flight.vehicle.callback_thread import pin_thread_state
from dart_flight.vehicle.clock import Clock, ClockEstimate, host_us
from dart_flight.vehicle.local_position import LocalPosition, is_healthy, position_sd_m
from dart_flight.vehicle.timesync import answer_of, request

_MODES = {
    SdkFlightMode.READY: FlightMode.READY,
    SdkFlightMode.TAKEOFF: FlightMode.TAKEOFF,
    SdkFlightMode.HOLD: FlightMode.HOLD,
    SdkFlightMode.MISSION: FlightMode.MISSION,
    SdkFlightMode.RETURN_TO_LAUNCH: FlightMode.RETURN,
    SdkFlightMode.LAND: FlightMode.LAND,
    SdkFlightMode.OFFBOARD: FlightMode.OFFBOARD,
    SdkFlightMode.FOLLOW_ME: FlightMode.MISSION,
    SdkFlightMode.UNKNOWN: FlightMode.UNKNOWN,
}
_LANDED = {
    SdkLandedState.ON_GROUND: LandedState.ON_GROUND,
    SdkLandedState.IN_AIR: LandedState.IN_AIR,
    SdkLandedState.TAKING_OFF: LandedState.TAKING_OFF,
    SdkLandedState.LANDING: LandedState.LANDING,
}
_STATUSES = tuple(SystemStatus)[1:]  # in the order of MAV_STATE's numbers
_AUTOPILOT_COMPONENT = 1
_ACTION_TIMEOUT_S = 5.0
_SYSTEM_STATUS = re.compile(r'"system_status":\s*(\d+)')
_RESULT = re.compile(r'"result":\s*(\d+)')
_SET_MESSAGE_INTERVAL = 511  # MAV_CMD
_MOTOR_SPAN_US = MOTOR_FULL_US - MOTOR_STOP_US
_REPEATED_US = 100_000  # a setpoint that stays the same leaves as often
_ASK_PERIOD_S = 0.1  # the round trip
_MAX_ASKED = 256  # requests remembered; their answers may come seconds later


class _ActuatorOutputs(msgspec.Struct):
    """ACTUATOR_OUTPUT_STATUS as JSON; NaN arrives as null."""

    time_usec: int
    actuator: list[float | None]


class _EscStatusJson(msgspec.Struct):
    """ESC_STATUS as JSON."""

    time_usec: int
    index: int
    rpm: list[int]


class _Odometry(msgspec.Struct):
    """ODOMETRY as JSON. PX4 sends NaN until its estimator is ready, which arrives as null.

    Position and velocity are in local NED, whatever its frames are called.
    """

    time_usec: int
    x: float | None
    y: float | None
    z: float | None
    vx: float | None
    vy: float | None
    vz: float | None
    reset_counter: int = 0  # an extension of the message: older autopilots leave it out


_decode_actuator = msgspec.json.Decoder(_ActuatorOutputs).decode
_decode_odometry = msgspec.json.Decoder(_Odometry).decode
_decode_esc = msgspec.json.Decoder(_EscStatusJson).decode


def _without_stamps(s: Setpoint) -> tuple[object, ...]:
    """What a setpoint says to the vehicle, without its stamps."""
    return (s.position_ned, s.yaw_ned_rad, s.velocity_ned, s.acceleration_ned)


def _throttle(pwm_us: float | None) -> float:
    """A motor's output, 0 (stopped) to 1."""
    if pwm_us is None or pwm_us <= MOTOR_STOP_US:
        return 0.0
    if pwm_us >= MOTOR_FULL_US:
        return 1.0
    return (pwm_us - MOTOR_STOP_US) / _MOTOR_SPAN_US


class VehicleError(FlightError):
    """The vehicle cannot be reached."""


class NoAnswerError(InputError):
    """The vehicle sends, but does not answer what it is asked: nothing can be flown over such a link."""


class VehicleSession:
    """One connected autopilot.

    Args:
        mavsdk: the connection, kept open by the caller.
        system: the autopilot on it.
        deliver: takes every record, on MAVSDK's thread.
        clock: relates the autopilot's time and the host's.
    """

    def __init__(
        self, mavsdk: Any, system: Any, deliver: Callable[[Input], None], clock: Clock | None = None
    ) -> None:
        self._mavsdk, self._system, self._deliver = mavsdk, system, deliver
        self._raw = getattr(system, "_system", system)
        self._telemetry = Telemetry(self._raw)
        self._offboard = Offboard(self._raw)
        self._action = Action(self._raw)
        self._utility = ServerUtility(self._raw)
        self._direct = MavlinkDirect(self._raw)
        self._extra: list[Stream] = []  # beside the table, as the configuration asks
        self._motors = 0
        self._rpm: list[float] = []  # of one stamp; a message has four motors
        self._rpm_us: int | None = None
        self._reset_counter: int | None = None
        self.clock: Clock = clock if clock is not None else ClockEstimate()
        self._host_us = self.clock.host_us
        self._status = StatusSample(t_us=0, received_us=0)
        self._place = LocalPosition()
        self._silent = False
        self._sent: tuple[object, ...] | None = None  # the last setpoint, and when it left
        self._sent_us = 0
        self._events = Events(self._raw)
        self._asked: deque[int] = deque(maxlen=_MAX_ASKED)  # host time of TIMESYNC requests, microseconds
        self._other: int | None = None  # system id of another autopilot on the link
        self.checked = False  # whether PX4 has sent a report of its checks
        self._health: tuple[bool, tuple[str, ...], tuple[str, ...]] | None = None

    # -- telemetry --

    def subscribe(self, estimation: Estimation, motors: int, guarded: bool = True) -> None:
        """Subscribe to the streams of the table and to the slow state.

        Args:
            estimation: which sources of thrust it uses.
            motors: how many the vehicle has.
            guarded: also to what only the guard asks for.
        """
        self._motors = motors
        t = self._telemetry
        t.subscribe_imu(self._on_imu)
        t.subscribe_attitude_quaternion(self._on_attitude)
        t.subscribe_armed(lambda armed, _: self._on_status(armed=bool(armed)))
        t.subscribe_flight_mode(
            lambda mode, _: self._on_status(flight_mode=_MODES.get(mode, FlightMode.MANUAL))
        )
        t.subscribe_landed_state(
            lambda landed, _: self._on_status(landed=_LANDED.get(landed, LandedState.UNKNOWN))
        )
        t.subscribe_health(self._on_health)
        t.subscribe_battery(self._on_battery)
        t.subscribe_status_text(self._on_status_text)
        if guarded:
            self._subscribe_events()
        # What the telemetry plugin leaves out: the stamp of the motors' outputs, the estimator's count of
        # resets, and all of the others. Both ways for one message cost more than what the plugin spares.
        d = self._direct
        d.subscribe_message("ACTUATOR_OUTPUT_STATUS", self._on_actuator)
        d.subscribe_message("ODOMETRY", self._on_odometry)
        if estimation.uses_esc:
            self._extra.append(ESC)
            d.subscribe_message(ESC.message, self._on_esc)
        if guarded:
            self._extra.append(ESTIMATOR)
            d.subscribe_message(ESTIMATOR.message, self._on_estimator_status)
            d.subscribe_message("HEARTBEAT", self._on_heartbeat)

    async def set_rates(self, names: Collection[str] | None = None, watching: bool = False) -> list[str]:
        """Ask for the rates of the table; returns the names of the streams that were refused.

        Args:
            names: only of these of the table; None: all. Further ones subscribed to are always asked for.
            watching: no faster than is needed to watch.
        """
        t = self._telemetry
        calls = {
            "imu": t.set_rate_imu,
            "attitude": t.set_rate_attitude_quaternion,
            "odometry": t.set_rate_odometry,
            "actuator": t.set_rate_actuator_output_status,
            "landed": t.set_rate_landed_state,
        }
        refused = []
        for stream in STREAMS:
            if names is not None and stream.name not in names:
                continue
            try:
                rate_hz = stream.watched_hz if watching else stream.rate_hz
                await asyncio.to_thread(calls[stream.name], rate_hz)
            except Exception:
                refused.append(stream.name)
        for stream in self._extra:
            interval_us = round(1e6 / stream.rate_hz)
            if not await asyncio.to_thread(self._ask_interval, MESSAGE_ID[stream.message], interval_us):
                refused.append(stream.name)
        return refused

    async def stop_messages(self, numbers: Iterable[int]) -> None:
        """Ask not to be sent these messages on this link; refused, they go on coming."""
        for number in numbers:
            await asyncio.to_thread(self._ask_interval, number, -1)

    async def measure_link(self, timeout_s: float) -> list[str]:
        """Wait for the first round trip; returns the requests that were not answered, none where one was.

        By TIMESYNC, and by another request's answer where the vehicle does not know that.
        """
        loop, heard = asyncio.get_running_loop(), asyncio.Event()

        def take(message: Any, _: Any) -> None:
            if self._take_answer(message):
                loop.call_soon_threadsafe(heard.set)

        self._direct.subscribe_message("TIMESYNC", take)
        asking = asyncio.create_task(self.keep_measuring())
        try:
            await asyncio.wait_for(heard.wait(), timeout_s)
            return []
        except TimeoutError:
            pass
        finally:
            asking.cancel()
        sent, stream = host_us(), STREAMS[0]
        try:
            await asyncio.to_thread(self._telemetry.set_rate_imu, stream.rate_hz)
        except Exception as error:
            if getattr(getattr(error, "result", None), "name", "") == "TIMEOUT":
                return ["TIMESYNC", f"rate of {stream.message}"]
        self._deliver(self.clock.round_trip(sent, host_us(), None))
        return []

    async def keep_measuring(self) -> None:
        """Ask for the round trip again and again; what `measure_link` has subscribed to takes the answers."""
        while True:
            now = host_us()  # names the request, also in lockstep, where time stands still
            self._asked.append(now)
            with contextlib.suppress(Exception):  # a link that takes nothing shows by its silence
                self._direct.send_message(request(now))
            await asyncio.sleep(_ASK_PERIOD_S)

    def _take_answer(self, message: Any) -> bool:
        """TIMESYNC: an answer to one of ours, or what another asks."""
        received = host_us()
        answer = answer_of(message)
        if (
            answer is None
            or answer.sent_us not in self._asked
            or message.system_id != self._raw.get_system_id()
        ):
            return False
        self._deliver(self.clock.round_trip(answer.sent_us, received, answer.autopilot_us))
        return True

    def _ask_interval(self, number: int, interval_us: int) -> bool:
        """SET_MESSAGE_INTERVAL for a message without a rate in the telemetry plugin; blocking."""
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
        except Exception:
            return False
        found = _RESULT.search(answer.fields_json)
        return found is not None and int(found[1]) == 0

    def _stamp(self, t_us: int, received_us: int) -> int:
        """Relate the clocks by a stamped message; returns the time of its receipt."""
        received_us = self.clock.receive(t_us, received_us)
        offset = self.clock.update(t_us, received_us)
        if offset is not None:
            self._deliver(ClockOffset(received_us, offset))
        return received_us

    def _on_imu(self, imu: Any, _: Any) -> None:
        received = self._host_us()
        t_us = int(imu.timestamp_us)
        a, w = imu.acceleration_frd, imu.angular_velocity_frd
        received = self._stamp(t_us, received)
        self._deliver(
            ImuSample(
                t_us,
                received,
                (a.forward_m_s2, a.right_m_s2, a.down_m_s2),
                (w.forward_rad_s, w.right_rad_s, w.down_rad_s),
            )
        )

    def _on_attitude(self, q: Any, _: Any) -> None:
        received = self._host_us()
        if math.isfinite(q.w):
            t_us = int(q.timestamp_us)
            received = self.clock.receive(t_us, received)
            self._deliver(AttitudeSample(t_us, received, (q.w, q.x, q.y, q.z)))

    def _on_odometry(self, message: Any, _: Any) -> None:
        received = self._host_us()
        o = _decode_odometry(message.fields_json)
        if o.reset_counter != self._reset_counter:
            self._reset_counter = o.reset_counter
            self._deliver_estimator(reset_counter=self._reset_counter)
        x, y, z, vx, vy, vz = o.x, o.y, o.z, o.vx, o.vy, o.vz
        if x is None or y is None or z is None or vx is None or vy is None or vz is None:
            return
        received = self.clock.receive(o.time_usec, received)
        self._deliver(OdometrySample(o.time_usec, received, (x, y, z), (vx, vy, vz)))

    def _on_estimator_status(self, message: Any, _: Any) -> None:
        healthy = is_healthy(message.fields_json)
        if healthy is not None:
            self._place.healthy = healthy
            self._deliver_estimator(healthy=healthy, position_sd_m=position_sd_m(message.fields_json))
            if self._status.local_position_ok is not self._place.ok:
                self._on_status(local_position_ok=self._place.ok)

    def _on_health(self, health: Any, _: Any) -> None:
        self._place.sent = bool(health.is_local_position_ok)
        self._on_status(local_position_ok=self._place.ok)

    def _deliver_estimator(self, **what: Any) -> None:
        received = self._host_us()
        self._deliver(EstimatorSample(self.clock.to_autopilot(received), received, **what))

    def _on_actuator(self, message: Any, _: Any) -> None:
        received = self._host_us()
        status = _decode_actuator(message.fields_json)
        outputs = status.actuator[: self._motors]
        if len(outputs) < self._motors:
            return
        received = self.clock.receive(status.time_usec, received)
        self._deliver(ActuatorSample(status.time_usec, received, tuple([_throttle(pwm) for pwm in outputs])))

    def _on_esc(self, message: Any, _: Any) -> None:
        received = self._host_us()
        status = _decode_esc(message.fields_json)
        if status.index == 0:
            self._rpm, self._rpm_us = [], status.time_usec
        if status.time_usec != self._rpm_us or status.index != len(self._rpm):
            return  # a part of it was lost
        self._rpm += [float(rpm) for rpm in status.rpm]
        if len(self._rpm) >= self._motors:
            self._deliver(EscSample(status.time_usec, received, tuple(self._rpm[: self._motors])))
            self._rpm_us = None

    def _on_status(self, **changes: Any) -> None:
        received = self._host_us()
        pin_thread_state()  # here, where it is seldom asked: all callbacks come on one thread
        self._status = msgspec.structs.replace(
            self._status, t_us=self.clock.to_autopilot(received), received_us=received, **changes
        )
        self._deliver(self._status)

    def _on_heartbeat(self, message: Any, _: Any) -> None:
        """Take the state of the autopilot's own heartbeat: a gimbal's or a camera's says nothing of PX4."""
        sender = (message.system_id, message.component_id)
        found = _SYSTEM_STATUS.search(message.fields_json)
        if found is None or sender != (self._raw.get_system_id(), _AUTOPILOT_COMPONENT):
            return
        number = int(found[1])
        status = _STATUSES[number] if number < len(_STATUSES) else SystemStatus.UNKNOWN
        if status is not self._status.system_status:
            self._on_status(system_status=status)

    def _on_battery(self, battery: Any, _: Any) -> None:
        volts, percent = float(battery.voltage_v), float(battery.remaining_percent)
        self._on_status(
            battery_v=volts if math.isfinite(volts) else None,
            battery_remaining=percent / 100.0 if math.isfinite(percent) else None,
        )

    def _on_status_text(self, text: Any, _: Any) -> None:
        received = self._host_us()
        severity = text.type.name.lower() if hasattr(text.type, "name") else str(text.type)
        self._deliver(StatusText(self.clock.to_autopilot(received), received, severity, text.text))

    async def look_for_others(self) -> None:
        """Deliver another autopilot on the link, once; its messages are told apart by its system id."""
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
        """PX4's reasons: what it says as events and not as texts, and its health and arming checks.

        MAVSDK fetches the words from the vehicle, or from its cache; a vehicle without them has only texts
        and the sensors of SYS_STATUS.
        """
        self._direct.subscribe_message("SYS_STATUS", self._on_sys_status)
        with contextlib.suppress(Exception):  # of no use to a flight that has the rest
            self._events.subscribe_events(self._on_event)
            self._events.subscribe_health_and_arming_checks(self._on_checks)

    def _on_event(self, event: Any, _: Any) -> None:
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
        self._deliver_health(*reasons.of_checks(report))

    def _on_sys_status(self, message: Any, _: Any) -> None:
        found = None if self.checked else reasons.of_sys_status(message.fields_json)
        if found is not None:
            self._deliver_health(*found)

    def _deliver_health(self, can_arm: bool, blocking: tuple[str, ...], others: tuple[str, ...]) -> None:
        now = (can_arm, blocking, others)
        if now != self._health:
            self._health = now
            received = self._host_us()
            self._deliver(HealthReport(self.clock.to_autopilot(received), received, *now))

    # -- commands --

    def send(self, setpoint: Setpoint) -> None:
        """Send a setpoint at once; any thread. MAVSDK repeats it at 20 Hz until the next.

        One that it is repeating already is left to that, for a tenth of a second at most and in offboard mode
        only: seeing another mode MAVSDK stops, and then refuses to start offboard for want of a setpoint.
        That of an impact always leaves.
        """
        if self._silent:
            return
        said, now_us = _without_stamps(setpoint), self._host_us()
        repeats = self._status.flight_mode is FlightMode.OFFBOARD and now_us - self._sent_us < _REPEATED_US
        if repeats and said == self._sent and not setpoint.recovery:
            return
        self._sent, self._sent_us = said, now_us
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
        """Carry out an action; returns "" or what PX4 said against it."""
        if self._silent:
            return "silent"
        calls: dict[VehicleAction, Callable[..., Any]] = {
            VehicleAction.OFFBOARD: self._offboard.start_async,
            VehicleAction.ARM: self._action.arm_async,
            VehicleAction.LAND: self._action.land_async,
            VehicleAction.DISARM: self._action.disarm_async,
            VehicleAction.KILL: self._action.kill_async,
        }
        # Callbacks and not the blocking calls: those never return once the connection is closed under them.
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

    def silence(self) -> None:
        """Send nothing more. MAVSDK stops repeating by itself once it sees another mode than offboard."""
        self._silent = True

    def set_actuator(self, index: int, value: float) -> None:
        """Command a peripheral output of PX4, blocking; an acknowledgement says nothing about movement."""
        self._action.set_actuator(index, value)

    def tell_ground(self, text: str) -> None:
        """A STATUSTEXT for the ground station, where the link allows."""
        with contextlib.suppress(Exception):
            self._utility.send_status_text(OwnStatusTextType.INFO, text[:50])


class Connection:
    """Async context of a MAVSDK instance connected to one autopilot."""

    def __init__(
        self,
        url: str,
        timeout_s: float,
        deliver: Callable[[Input], None],
        ground: bool,
        clock: Clock | None,
        opened: Callable[[], None],
    ) -> None:
        self._opened = opened
        self._url, self._timeout_s, self._deliver, self._clock = url, timeout_s, deliver, clock
        self._component = ComponentType.GROUND_STATION if ground else ComponentType.COMPANION_COMPUTER
        self._mavsdk: Any = None

    async def __aenter__(self) -> VehicleSession:
        sdk_log.redirect()
        self._mavsdk = Mavsdk(Configuration.create_with_component_type(self._component))
        await self._mavsdk.__aenter__()
        try:
            await self._mavsdk.add_any_connection(self._url)
            system = await self._mavsdk.first_autopilot(timeout_s=self._timeout_s)
            if system is None:
                raise VehicleError(f"no autopilot on {self._url} within {self._timeout_s:g} s")
        except VehicleError:
            await self.__aexit__()
            raise
        except Exception as error:
            await self.__aexit__()
            raise VehicleError(f"cannot open {self._url}: {error}") from error
        self._opened()
        return VehicleSession(self._mavsdk, system, self._deliver, self._clock)

    async def __aexit__(self, *exception: object) -> None:
        with sdk_log.closing():
            await self._mavsdk.__aexit__(None, None, None)


def connect(
    url: str,
    timeout_s: float,
    deliver: Callable[[Input], None],
    *,
    ground: bool = False,
    clock: Clock | None = None,
    opened: Callable[[], None] = lambda: None,
) -> Connection:
    """Connect to the first autopilot on a URL: `async with connect(...) as session`.

    Args:
        url: MAVSDK connection URL.
        timeout_s: how long to wait for a heartbeat.
        deliver: takes every record, on MAVSDK's thread.
        ground: appear as a ground station instead of a companion computer. On the vehicle a companion: a
            ground station's heartbeat from the vehicle itself may hide the loss of the real one.
        clock: of an autopilot whose time is not real time (`LockstepClock`).
        opened: called once MAVSDK has the link open and an autopilot answers.

    Raises:
        VehicleError: on entering, when the URL cannot be opened or no autopilot answers.
    """
    return Connection(url, timeout_s, deliver, ground, clock, opened)
