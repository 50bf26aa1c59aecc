"""A blocking connection for work on the ground: parameters, outputs, logs and a few seconds of telemetry.

Commands such as `check`, `parameters`, `bringup`, `lock` and `px4-log` open this connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import Any

import msgspec
from mavsdk.component_type import ComponentType
from mavsdk.exceptions import MavsdkError
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.info import Info
from mavsdk.plugins.param import Param

from dart_flight.base.geometry import Quaternion, Vec3, norm
from dart_flight.base.motor_outputs import OutputScale
from dart_flight.base.records import (
    AttitudeSample,
    HealthReport,
    ImuSample,
    Input,
    OdometrySample,
    PoseSample,
    RoundTrip,
    StatusSample,
    StatusText,
)
from dart_flight.base.streams import BY_MESSAGE, SAMPLED
from dart_flight.config.document import InputError
from dart_flight.config.link_url import mavsdk_url
from dart_flight.config.parameter_file import Value
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.config.vehicle.mocap import MotionCapture
from dart_flight.core.guard.second_vehicle import (
    POSITION_JUMP_M,
    SecondClockDetector,
    SecondPositionDetector,
)
from dart_flight.core.guard.stream_watch import STAMP_TOLERANCE_S
from dart_flight.vehicle import arming_problems as reasons
from dart_flight.vehicle import messages, sdk_log
from dart_flight.vehicle.command_server import Press, Result
from dart_flight.vehicle.downloads import Px4Logs, download_file
from dart_flight.vehicle.messages import AUTOPILOT, BatteryReading, MessageEntry
from dart_flight.vehicle.motion_capture.pose_bridge import MotionCaptureBridge, forwarding
from dart_flight.vehicle.motion_capture.pose_statistics import PoseFigures, PoseStatistics
from dart_flight.vehicle.motion_capture.source import AbsentSourceError
from dart_flight.vehicle.own_system import send_as
from dart_flight.vehicle.parameters import VehicleParameters
from dart_flight.vehicle.vehicle_session import NoAnswerError, Sender, VehicleError, VehicleSession


class Source(msgspec.Struct, frozen=True):
    """A sender of one kind of message, with its total rate and its rate of usable messages."""

    sender: Sender
    arriving_hz: float
    usable_hz: float
    is_vehicle: bool  # whether the sender is the connected vehicle's autopilot component
    reason: str  # reason why the sender's messages are unusable, or empty


def unusable_streams(sources: Iterable[Source]) -> dict[str, str]:
    """Return {stream: reason} for the vehicle's streams without a usable message."""
    found: dict[str, Source] = {}
    for source in sources:
        stream = BY_MESSAGE.get(source.sender.message)
        if stream is None or not source.is_vehicle or not source.reason:
            continue
        if stream.name not in found or source.arriving_hz > found[stream.name].arriving_hz:
            found[stream.name] = source
    return {
        name: f"{s.arriving_hz:.0f} Hz arrive, but no message is usable: {s.reason}"
        for name, s in found.items()
    }


class Observation(msgspec.Struct):
    """Telemetry from a vehicle on the ground over a few seconds; `rates_hz` counts usable samples only."""

    version: str = ""
    rates_hz: dict[str, float] = {}
    battery_v: float | None = None
    battery_remaining: float | None = None  # 0 to 1
    local_position_ok: bool = False
    gps_fix: str | None = None  # MAVLink's GPS fix type in lower case; None if no GPS receiver reports
    blocking: tuple[str, ...] = ()  # PX4's reasons for not arming in its current mode
    other_vehicle: str | None = None  # description of another vehicle on the same link
    texts: list[str] = []  # PX4's messages and events with severity warning or higher
    own_findings: list[str] = []  # this program's own findings about the link
    sources: tuple[Source, ...] = ()
    battery_id: int | None = None
    batteries: tuple[BatteryReading, ...] = ()  # flight batteries
    other_batteries: tuple[BatteryReading, ...] = ()
    motor_scale: OutputScale | None = None  # inferred from the values; None if all outputs were 0
    specific_force_m_s2: float | None = None  # mean magnitude
    position_ned: Vec3 | None = None  # newest local position, metres
    q_frd_to_ned: Quaternion | None = None  # newest attitude
    poses: PoseFigures | None = None  # statistics of the poses that this program forwards
    pose_problem: str | None = None  # reason why no usable poses arrive
    systems: tuple[int, int] | None = None  # MAVLink system ids of the vehicle and of this program


class HeartbeatMode(msgspec.Struct, frozen=True):
    """The autopilot's mode in a HEARTBEAT.

    Attributes:
        armed: whether the motors may turn.
        hil: whether the autopilot uses simulated sensors.
        not_px4: reason why the heartbeat is not from PX4, or an empty string.
    """

    armed: bool
    hil: bool
    not_px4: str = ""


_HEARTBEAT_S = 3.0
_REPORT_S = 5.0  # additional wait for PX4's reasons for not arming; MAVSDK must first fetch their texts
_ROUND_TRIPS_S, _ROUND_TRIP_MAX_S = 1.0, 5.0
_MAX_UNANSWERED = 2  # number of unanswered requests before an error; MAVSDK retries each for seconds
_WAIT_POLL_S = 0.1  # interval between requests for the vehicle's time during a wait
_FUSION_S = 10.0  # timeout until PX4 has a position from the forwarded poses


class _Listener:
    """A receiver of a session's records that collects the vehicle's `Observation`."""

    def __init__(self, mocap: MotionCapture) -> None:
        self.seen = Observation()
        self.poses = PoseStatistics(mocap.room_frame(), mocap.delay_ms)
        self.round_trips_us: list[int] = []
        self._clocks = SecondClockDetector(1e6 * STAMP_TOLERANCE_S)
        self._places = SecondPositionDetector(POSITION_JUMP_M)
        self._forces_m_s2, self._imu_samples = 0.0, 0

    def update(self, record: Input) -> None:
        """Process a record, on MAVSDK's thread or on the motion capture's thread."""
        seen = self.seen
        self.poses.update(record)
        if isinstance(record, PoseSample):
            return
        if isinstance(record, ImuSample):
            self._forces_m_s2 += norm(record.specific_force_frd)
            self._imu_samples += 1
            seen.specific_force_m_s2 = self._forces_m_s2 / self._imu_samples
            self._clocks.update(record.t_us, record.received_us)
            apart_s = self._clocks.clock_difference_s(record.received_us)
            if apart_s is not None:
                seen.other_vehicle = (
                    f"two clocks alternate in the samples of one system id, {apart_s:.1f} s apart"
                )
        elif isinstance(record, OdometrySample):
            seen.position_ned = record.position_ned
            self._places.update(record)
            apart_m = self._places.position_difference_m(record.received_us)
            if apart_m is not None:
                seen.other_vehicle = (
                    f"two positions alternate in the samples of one system id, {apart_m:.1f} m apart"
                )
        elif isinstance(record, AttitudeSample):
            seen.q_frd_to_ned = record.q_frd_to_ned
        elif isinstance(record, StatusSample):
            seen.battery_v, seen.battery_remaining = record.battery_v, record.battery_remaining
            seen.battery_id = record.battery_id
            seen.local_position_ok = record.local_position_ok
        elif isinstance(record, HealthReport):
            seen.blocking = record.blocking
        elif isinstance(record, StatusText):
            texts = seen.own_findings if record.found_here else seen.texts
            if record.severity in reasons.SEVERE and record.text not in texts:
                texts.append(record.text)
        elif isinstance(record, RoundTrip) and record.autopilot_us is not None:
            self.round_trips_us.append(record.received_us - record.sent_us)


class GroundLink:
    """A blocking connection: `with GroundLink(url, timeout_s) as link: link.set_actuator(1, 0.5)`.

    While the link is open, the poses of `mocap.url` are forwarded to PX4.

    Args:
        url: MAVSDK connection URL.
        timeout_s: timeout of the first heartbeat.
        viewer: receives every record on MAVSDK's thread; telemetry arrives only after `observe` is called.

    Raises:
        VehicleError: on entering, if the URL cannot be opened or no autopilot answers.
        InputError: on entering, if the motion capture cannot be opened.
        NoAnswerError: in a method that sends a request, if the vehicle answers no requests or has stopped
            sending.
    """

    def __init__(
        self,
        url: str,
        timeout_s: float,
        viewer: Callable[[Input], None] = lambda record: None,
        mocap: MotionCapture | None = None,
    ) -> None:
        self._url, self._timeout_s, self._viewer = url, timeout_s, viewer
        self._mocap = mocap or MotionCapture()
        self._forwarding = contextlib.ExitStack()
        self._bridge: MotionCaptureBridge | None = None
        self._absent: str | None = None  # reason why the source of the poses could not be opened
        self._mavsdk: Any = None
        self._answered = False  # whether the vehicle has answered any request
        self._unanswered: list[str] = []  # names of unanswered requests

    def __enter__(self) -> GroundLink:
        sdk_log.redirect()
        self._mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER))
        try:
            self._mavsdk.add_any_connection_with_handle(mavsdk_url(self._url))
            system = self._mavsdk.first_autopilot(self._timeout_s)
        except Exception as error:
            self._close()
            raise VehicleError(f"cannot open {self._url}: {error}") from error
        if system is None:
            self._close()
            raise VehicleError(f"no autopilot on {self._url} within {self._timeout_s:g} s")
        self._system, self._system_id = system, int(system.get_system_id())
        self._own_system = send_as(self._mavsdk, ComponentType.COMPANION_COMPUTER, self._system_id)
        self._info = Info(system)
        self._listener = _Listener(self._mocap)
        self._session = session = VehicleSession(self._mavsdk, system, self._handle_record)
        self._parameters = VehicleParameters(session, Param(system), self._system_id, self._perform)
        try:
            self._bridge = self._forwarding.enter_context(
                forwarding(self._mocap, session.send_message, session.clock, self._handle_record)
            )
        except AbsentSourceError as error:
            self._absent = str(error)
        except InputError:
            self._close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def _close(self) -> None:
        self._forwarding.close()
        with sdk_log.closing():
            self._mavsdk.destroy()

    def _handle_record(self, record: Input) -> None:
        self._listener.update(record)
        self._viewer(record)

    @property
    def system_id(self) -> int:
        """The vehicle's MAVLink system id."""
        return self._system_id

    @property
    def pose_problem(self) -> str | None:
        """The reason why no usable pose has arrived for 3 s, or None if poses arrive or are not needed."""
        return self._bridge.missing if self._bridge is not None else self._absent

    def newest(self, entry: MessageEntry, seconds: float) -> Any:
        """Block for `seconds` and return the newest usable value of a message."""
        return self._session.newest(entry, seconds)

    def round_trip_s(self) -> float | None:
        """Return the shortest TIMESYNC round trip, or None if no answer arrives within 5 s.

        Raise NoAnswerError if the vehicle has answered neither TIMESYNC nor another request.
        """
        return asyncio.run(self._round_trip_s())

    async def _round_trip_s(self) -> float | None:
        unanswered = await self._session.measure_link(_ROUND_TRIP_MAX_S)
        if unanswered:
            message = (
                "sends telemetry but does not answer requests"
                if self._system.is_connected()
                else "has stopped sending and has not answered these requests"
            )
            raise NoAnswerError(f"the vehicle {message}: {', '.join(unanswered)}", source=self._url)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._session.keep_measuring(), _ROUND_TRIPS_S)
        found = self._listener.round_trips_us
        return min(found) * 1e-6 if found else None

    def _perform(self, what: str, request: Callable[[], Any]) -> Any:
        """Return the answer to a request; `what` names the request in messages.

        Raises:
            NoAnswerError: the vehicle answers no requests, or has stopped sending.
            Exception: the vehicle refuses this request, or answers other requests but not this one.
        """
        try:
            answer = request()
        except Exception as error:
            if getattr(getattr(error, "result", None), "name", "") != "TIMEOUT":
                self._answered = True
                raise
            if not self._system.is_connected():
                message = f"the vehicle stopped responding; no answer to {what}"
                raise NoAnswerError(message, source=self._url) from None
            self._unanswered.append(what)
            if not self._answered and len(self._unanswered) >= _MAX_UNANSWERED:
                message = (
                    f"the vehicle sends telemetry but does not answer requests: {', '.join(self._unanswered)}"
                )
                raise NoAnswerError(message, source=self._url) from None
            raise
        self._answered = True
        return answer

    def heartbeat_mode(self) -> HeartbeatMode | None:
        """Return the mode in the autopilot's next HEARTBEAT, or None if no HEARTBEAT arrives within 3 s."""
        beat = self._session.next(messages.HEARTBEAT, _HEARTBEAT_S)
        if beat is not None:
            return HeartbeatMode(armed=beat.armed, hil=beat.hil)
        other = self._session.unusable_reason(messages.HEARTBEAT)
        return HeartbeatMode(armed=False, hil=False, not_px4=other) if other else None

    def require_disarmed(self) -> None:
        """Raise VehicleError if the vehicle is armed, or if its heartbeat is missing or not from PX4."""
        mode = self.heartbeat_mode()
        if mode is None:
            raise VehicleError("the vehicle sends no heartbeat")
        if mode.not_px4:
            raise VehicleError(f"it is unknown whether the vehicle is disarmed: {mode.not_px4}")
        if mode.armed:
            raise VehicleError("the vehicle is armed: disarm it first")

    def px4_logs(self) -> Px4Logs:
        """Return access to PX4's logs; the caller must close the returned object, then this link."""
        return Px4Logs(self._system)

    def kill(self) -> None:
        """Force PX4 to disarm immediately, even in the air; raise MAVSDK's exception if PX4 refuses."""
        Action(self._system).kill()

    def serve_operator(self, system_id: int, answer: Callable[[Press], tuple[Result, str]]) -> None:
        """Respond to a ground station's commands while the link is open (`VehicleSession.serve_operator`)."""
        self._session.serve_operator(system_id, answer)

    def set_actuator(self, index: int, value: float) -> None:
        """Command a peripheral output, -1 to 1; an acknowledgement does not prove movement."""
        self._session.set_actuator(index, value)

    def read_parameters(
        self,
        names: Iterable[str],
        progress: Callable[[int], None] = lambda done: None,
        unanswered: set[str] | None = None,
    ) -> dict[str, Value]:
        """Return the values of the parameters that the vehicle has; INT32 values are of type int.

        Args:
            names: the parameters that the vehicle lacks are missing from the result.
            progress: receives the number of parameters requested so far.
            unanswered: receives the names of parameters whose value and absence are both unknown. If
                `unanswered` is None, such a parameter raises VehicleError.
        """
        lost: set[str] = set()
        values = self._parameters.read(names, progress, lost)
        if unanswered is not None:
            unanswered |= lost
        elif lost:
            raise VehicleError(f"no answer for {', '.join(sorted(lost))}: try again, or improve the link")
        return values

    def write_parameter(self, name: str, value: Value) -> None:
        """Set a parameter (`VehicleParameters.write`)."""
        self._parameters.write(name, value)

    def wait(self, seconds: float) -> None:
        """Block for some seconds of the vehicle's time, or of host time if the vehicle's time is unknown."""
        times_us: list[int] = []
        handle = self._session.listen(
            messages.TIMESYNC, lambda answer, _: times_us.append(answer.autopilot_us)
        )
        began_s = moved_s = time.monotonic()
        try:
            while not times_us or times_us[-1] - times_us[0] < 1e6 * seconds:
                before = len(times_us)
                self._session.request_time()
                time.sleep(_WAIT_POLL_S)
                if len(times_us) > before:
                    moved_s = time.monotonic()
                if time.monotonic() - moved_s > seconds and time.monotonic() - began_s > seconds:
                    return
        finally:
            self._session.unlisten(handle)

    def read_file(self, path: str) -> bytes:
        return download_file(self._system, path)

    def version(self) -> str:
        """Return PX4's version, or an empty string if it is not reported."""
        with contextlib.suppress(MavsdkError):
            v = self._info.get_version()
            return f"{v.flight_sw_major}.{v.flight_sw_minor}.{v.flight_sw_patch}"
        return ""

    def observe(self, vehicle: VehicleConfig, seconds: float) -> Observation:
        """Request the rates in the stream table and listen for `seconds`.

        If PX4 has no position or refuses to arm, wait up to 5 s longer for PX4's reasons.
        """
        seen, session = self._listener.seen, self._session
        seen.systems = (self._system_id, self._own_system)

        def store_fix(fix: str, _: int) -> None:
            seen.gps_fix = fix

        asyncio.run(
            session.set_rates([stream.name for stream in SAMPLED])
        )  # a refused rate shows in the measured rates
        motors, lowest_v = len(vehicle.airframe.motors), vehicle.guard.battery_v
        session.subscribe(vehicle.estimation, motors, lowest_battery_v=lowest_v)
        session.listen(messages.GPS_RAW_INT, store_fix)
        if self._bridge is not None:
            self._wait_for_position()
        began = time.monotonic()
        before = {sender: (n.messages, n.usable) for sender, n in list(session.senders.items())}
        time.sleep(seconds)
        seen.sources = self._sources(before, time.monotonic() - began)
        seen.pose_problem = self._absent
        if self._bridge is not None:
            seen.poses = self._listener.poses.figures(session.clock.host_us())
            none = seen.poses.rate_hz == 0.0
            seen.pose_problem = self._bridge.problem if none else self._bridge.missing
        seen.rates_hz = {
            stream.name: sum(
                s.usable_hz for s in seen.sources if s.is_vehicle and s.sender.message == stream.message
            )
            for stream in SAMPLED
        }
        batteries = session.batteries
        seen.batteries, seen.other_batteries = (
            tuple(batteries.flight_batteries()),
            tuple(batteries.other_batteries()),
        )
        seen.motor_scale = None if session.motor_outputs is None else session.motor_outputs.scale
        for system in self._mavsdk.get_systems():
            if system.has_autopilot() and system.get_system_id() != self._system.get_system_id():
                seen.other_vehicle = f"system {system.get_system_id()} sends on the same link"
        amiss = not seen.local_position_ok or seen.blocking
        while amiss and not self._session.checked and time.monotonic() - began < seconds + _REPORT_S:
            time.sleep(0.1)
        seen.version = self.version()
        return seen

    def _wait_for_position(self) -> None:
        """Block until PX4 has a position from the forwarded poses, for at most 10 s."""
        end_s = time.monotonic() + _FUSION_S
        while self._listener.seen.position_ned is None and time.monotonic() < end_s:
            time.sleep(0.05)

    def _sources(self, before: dict[Any, tuple[int, int]], elapsed_s: float) -> tuple[Source, ...]:
        """Return the observed senders with their rates, sorted by message."""
        found = []
        for key, count in sorted(self._session.senders.items()):
            sender, (messages_then, usable_then) = Sender(*key), before.get(key, (0, 0))
            is_vehicle = sender.system == self._system_id and sender.component == AUTOPILOT
            came, usable = count.messages - messages_then, count.usable - usable_then
            reason = count.reason if came and not usable else ""
            found.append(Source(sender, came / elapsed_s, usable / elapsed_s, is_vehicle, reason))
        return tuple(found)
