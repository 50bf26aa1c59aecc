"""A blocking connection for work on the ground: move an output, read parameters."""

from __future__ import annotations

import asyncio
import contextlib
import json
import queue
import time
from collections.abc import Callable, Iterable
from functools import partial
from types import TracebackType
from typing import Any

import msgspec
from mavsdk.component_type import ComponentType
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.info import Info
from mavsdk.plugins.mavlink_direct import MavlinkDirect
from mavsdk.plugins.param import Param, ParamResult
from mavsdk.plugins.telemetry import Telemetry

from dart_flight.base.geometry import Quaternion, Vec3
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    HealthReport,
    ImuSample,
    Input,
    OdometrySample,
    Record,
    RoundTrip,
    StatusSample,
    StatusText,
)
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.guard.second_vehicle import SecondClockDetector
from dart_flight.vehicle import arming_problems as reasons
from dart_flight.vehicle import sdk_log
from dart_flight.vehicle.vehicle_session import NoAnswerError, VehicleError, VehicleSession


class Observation(msgspec.Struct):
    """What a vehicle on the ground says in a few seconds."""

    version: str = ""
    rates_hz: dict[str, float] = {}
    battery_v: float | None = None
    battery_remaining: float | None = None  # 0 to 1
    local_position_ok: bool = False
    gps_fix: str | None = None  # MAVLink's type of fix in small letters; None: no receiver heard
    blocking: tuple[str, ...] = ()  # what keeps PX4 from arming in its present mode, in its words
    other_vehicle: str | None = None  # another vehicle on the same link, in words
    texts: list[str] = []  # its texts and events, warnings and worse
    position_ned: Vec3 | None = None  # local, metres, the newest
    q_frd_to_ned: Quaternion | None = None  # attitude, the newest


PX4 = 12  # MAV_AUTOPILOT


class HeartbeatMode(msgspec.Struct, frozen=True):
    """What a HEARTBEAT says; `hil`: it flies from simulated sensors; `autopilot`: of MAV_AUTOPILOT."""

    armed: bool
    hil: bool
    autopilot: int = PX4


_HEARTBEAT_S = 3.0
_AUTOPILOT = 1  # component id
_ARMED, _HIL = 128, 32  # bits of MAV_MODE_FLAG
_STAMP_TOLERANCE_US = 500_000
_REPORT_S = 5.0  # on top, where something is amiss: until MAVSDK has fetched the words for it
_ROUND_TRIPS_S, _ROUND_TRIP_MAX_S = 1.0, 5.0
_MAX_UNANSWERED = 2  # requests, where none has been answered; MAVSDK asks for each of them for seconds
_PARAMETERS_S = 90.0  # for all parameters; a few that a build does not have take 3 s each
_COUNTED: dict[type[Record], str] = {ImuSample: "imu", AttitudeSample: "attitude", ActuatorSample: "actuator"}


class _Listener:
    """Takes the records of a session, as the core does in flight, and keeps what tells about the vehicle."""

    def __init__(self) -> None:
        self.seen = Observation()
        self.counts = dict.fromkeys(("imu", "attitude", "odometry", "actuator"), 0)
        self.round_trips_us: list[int] = []
        self._clocks = SecondClockDetector(_STAMP_TOLERANCE_US)

    def take(self, record: Input) -> None:
        """Take a record; on MAVSDK's thread."""
        seen, counted = self.seen, _COUNTED.get(type(record))
        if counted is not None:
            self.counts[counted] += 1
        if isinstance(record, ImuSample):
            self._clocks.update(record.t_us, record.received_us)
            apart_s = self._clocks.apart_s(record.received_us)
            if apart_s is not None:
                seen.other_vehicle = f"two clocks alternate under one system id, {apart_s:.1f} s apart"
        elif isinstance(record, OdometrySample):
            seen.position_ned = record.position_ned
        elif isinstance(record, AttitudeSample):
            seen.q_frd_to_ned = record.q_frd_to_ned
        elif isinstance(record, StatusSample):
            seen.battery_v, seen.battery_remaining = record.battery_v, record.battery_remaining
            seen.local_position_ok = record.local_position_ok
        elif isinstance(record, HealthReport):
            seen.blocking = record.blocking
        elif isinstance(record, StatusText):
            if record.severity in reasons.SEVERE and record.text not in seen.texts:
                seen.texts.append(record.text)
        elif isinstance(record, RoundTrip) and record.autopilot_us is not None:
            self.round_trips_us.append(record.received_us - record.sent_us)


class GroundLink:
    """`with GroundLink(url, timeout_s) as link: link.set_actuator(1, 0.5)`.

    `viewer` sees every record once `observe` has asked for them, on MAVSDK's thread.

    Raises:
        VehicleError: on entering, when the URL cannot be opened or no autopilot answers.
        NoAnswerError: on a request, when the vehicle has answered none, or has fallen silent.
    """

    def __init__(
        self, url: str, timeout_s: float, viewer: Callable[[Input], None] = lambda record: None
    ) -> None:
        self._url, self._timeout_s, self._viewer = url, timeout_s, viewer
        self._mavsdk: Any = None
        self._answered = False  # whether any request was
        self._unanswered: list[str] = []  # requests, while none was
        self._kept: list[Any] = []  # plugins with subscriptions

    def __enter__(self) -> GroundLink:
        sdk_log.redirect()
        self._mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER))
        try:
            self._mavsdk.add_any_connection_with_handle(self._url)
            system = self._mavsdk.first_autopilot(self._timeout_s)
        except Exception as error:
            self._close()
            raise VehicleError(f"cannot open {self._url}: {error}") from error
        if system is None:
            self._close()
            raise VehicleError(f"no autopilot on {self._url} within {self._timeout_s:g} s")
        self._system, self._system_id = system, system.get_system_id()
        self._param, self._info = Param(system), Info(system)
        self._heard = _Listener()
        self._session = VehicleSession(self._mavsdk, system, self._take)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def _close(self) -> None:
        with sdk_log.closing():
            self._mavsdk.destroy()

    def _take(self, record: Input) -> None:
        self._heard.take(record)
        self._viewer(record)

    def newest_message(self, name: str, seconds: float) -> dict[str, Any] | None:
        """The last message of a kind that comes within so long, which it blocks for; None: none came."""
        fields: list[str] = []

        def take(message: Any, _: Any) -> None:
            if message.system_id == self._system_id:
                fields[:] = [message.fields_json]

        direct = MavlinkDirect(self._system)
        handle = direct.subscribe_message(name, take)
        time.sleep(seconds)
        direct.unsubscribe_message(handle)
        return json.loads(fields[-1]) if fields else None

    def round_trip_s(self) -> float | None:
        """The shortest of some TIMESYNC requests with their answers, seconds; None: no answer within 5 s.

        Raises:
            NoAnswerError: no other request was answered either.
        """
        return asyncio.run(self._round_trip_s())

    async def _round_trip_s(self) -> float | None:
        unanswered = await self._session.measure_link(_ROUND_TRIP_MAX_S)
        if unanswered:
            says = (
                "sends, but answers no request" if self._system.is_connected() else "has fallen silent after"
            )
            raise NoAnswerError(f"the vehicle {says}: {', '.join(unanswered)}", source=self._url)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._session.keep_measuring(), _ROUND_TRIPS_S)
        found = self._heard.round_trips_us
        return min(found) * 1e-6 if found else None

    def _ask(self, what: str, request: Callable[[], Any]) -> Any:
        """Make a request; `what` names it.

        Raises:
            NoAnswerError: no use in asking on.
            Exception: MAVSDK's own, for a refusal, or for no answer from a vehicle that answers others.
        """
        try:
            answer = request()
        except Exception as error:
            if getattr(getattr(error, "result", None), "name", "") != "TIMEOUT":
                self._answered = True
                raise
            if not self._system.is_connected():
                says = f"vehicle stopped responding; no answer to {what}"
                raise NoAnswerError(says, source=self._url) from None
            self._unanswered.append(what)
            if not self._answered and len(self._unanswered) >= _MAX_UNANSWERED:
                says = f"vehicle sends telemetry but does not answer requests: {', '.join(self._unanswered)}"
                raise NoAnswerError(says, source=self._url) from None
            raise
        self._answered = True
        return answer

    def heartbeat_mode(self) -> HeartbeatMode | None:
        """What the next HEARTBEAT of the autopilot says; None: none within 3 s."""
        came: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()

        def take(message: Any, _: Any) -> None:
            if message.system_id == self._system_id and message.component_id == _AUTOPILOT:
                came.put(json.loads(message.fields_json))

        direct = MavlinkDirect(self._system)
        handle = direct.subscribe_message("HEARTBEAT", take)
        try:
            heartbeat = came.get(timeout=_HEARTBEAT_S)
        except queue.Empty:
            return None
        finally:
            direct.unsubscribe_message(handle)
        mode = int(heartbeat["base_mode"])
        autopilot = int(heartbeat.get("autopilot", PX4))
        return HeartbeatMode(armed=bool(mode & _ARMED), hil=bool(mode & _HIL), autopilot=autopilot)

    def kill(self) -> None:
        """Disarm at once, in the air, too; raises what MAVSDK raises where that is refused."""
        Action(self._system).kill()

    def set_actuator(self, index: int, value: float) -> None:
        """Command a peripheral output, -1 to 1; an acknowledgement says nothing about movement."""
        self._session.set_actuator(index, value)

    def read_parameters(self, names: Iterable[str]) -> dict[str, float]:
        """Values of the parameters that the vehicle has, whole numbers or not; others are left out."""
        values = {}
        end_s = time.monotonic() + _PARAMETERS_S
        for name in names:
            if time.monotonic() > end_s:
                says = f"parameter {name} and others not received within {_PARAMETERS_S:g} s"
                raise NoAnswerError(says, source=self._url)
            for read in (self._param.get_param_int, self._param.get_param_float):
                try:
                    values[name] = float(self._ask(f"parameter {name}", partial(read, name)))
                except NoAnswerError:
                    raise
                except Exception as error:
                    if getattr(error, "result", None) in (ParamResult.WRONG_TYPE, ParamResult.TYPE_MISMATCH):
                        continue
                    break  # not there: MAVSDK has asked for it for seconds
                break
        return values

    def observe(self, vehicle: VehicleConfig, seconds: float) -> Observation:
        """Ask for the rates of the stream table and listen, as in a flight; blocks for that long.

        Where PX4 has no position or would not arm, up to 5 s more until it has said why.
        """
        seen, counts = self._heard.seen, self._heard.counts

        def count_odometry(_message: Any, _: Any) -> None:
            counts["odometry"] += 1  # those without a position, which are no samples, too

        def gps(info: Any, _: Any) -> None:
            seen.gps_fix = str(info.fix_type.name).lower()

        asyncio.run(self._session.set_rates(counts))  # refused: the count shows what comes anyway
        self._session.subscribe(vehicle.estimation, len(vehicle.airframe.motors))
        # Kept: a plugin that is collected takes its subscriptions with it.
        self._kept = [Telemetry(self._system), MavlinkDirect(self._system)]
        self._kept[0].subscribe_gps_info(gps)
        self._kept[1].subscribe_message("ODOMETRY", count_odometry)
        began = time.monotonic()
        before = dict(counts)
        time.sleep(seconds)
        elapsed = time.monotonic() - began
        seen.rates_hz = {name: (counts[name] - before[name]) / elapsed for name in counts}
        for system in self._mavsdk.get_systems():
            if system.has_autopilot() and system.get_system_id() != self._system.get_system_id():
                seen.other_vehicle = f"system {system.get_system_id()} sends on the same link"
        amiss = not seen.local_position_ok or seen.blocking
        while amiss and not self._session.checked and time.monotonic() - began < seconds + _REPORT_S:
            time.sleep(0.1)
        with contextlib.suppress(Exception):
            v = self._info.get_version()
            seen.version = f"{v.flight_sw_major}.{v.flight_sw_minor}.{v.flight_sw_patch}"
        return seen
