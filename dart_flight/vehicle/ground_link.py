"""A blocking connection for work on the ground: move an output, read parameters."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterable
from functools import partial
from types import TracebackType
from typing import Any

import msgspec
from mavsdk.component_type import ComponentType
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.events import Events
from mavsdk.plugins.info import Info
from mavsdk.plugins.mavlink_direct import MavlinkDirect
from mavsdk.plugins.param import Param, ParamResult
from mavsdk.plugins.telemetry import Telemetry

from dart_flight.base.streams import BY_NAME
from dart_flight.core.guard.sources import TwoClocks
from dart_flight.vehicle import reasons, sdk_log
from dart_flight.vehicle.clock import host_us
from dart_flight.vehicle.local_position import LocalPosition, is_healthy
from dart_flight.vehicle.session import NoAnswerError, VehicleError
from dart_flight.vehicle.timesync import answer_of, request


class Observation(msgspec.Struct):
    """What a vehicle on the ground says in a few seconds."""

    version: str = ""
    rates_hz: dict[str, float] = {}
    battery_v: float | None = None
    battery_remaining: float | None = None  # 0 to 1
    local_position_ok: bool = False
    gps_fix: str | None = None  # MAVLink's type of fix in small letters; None: no receiver heard
    blocking: tuple[str, ...] = ()  # what keeps PX4 from arming in its present mode, in its words
    problems: tuple[str, ...] = ()  # what else its checks find
    other_vehicle: str | None = None  # another vehicle on the same link, in words
    said: list[str] = []  # its texts and events, warnings and worse


_STAMP_TOLERANCE_US = 500_000
_REPORT_S = 5.0  # on top, where something is amiss: until MAVSDK has fetched the words for it
_ROUND_TRIPS, _ASK_PERIOD_S, _ROUND_TRIP_MOST_S = 10, 0.1, 5.0
_MOST_UNANSWERED = 2  # requests, where none has been answered; MAVSDK asks for each of them for seconds
_PARAMETERS_S = 90.0  # for all parameters; a few that a build does not have take 3 s each


class GroundLink:
    """`with GroundLink(url, timeout_s) as link: link.set_actuator(1, 0.5)`.

    Raises:
        VehicleError: on entering, when the URL cannot be opened or no autopilot answers.
        NoAnswerError: on a request, when the vehicle has answered none, or has fallen silent.
    """

    def __init__(self, url: str, timeout_s: float) -> None:
        self._url, self._timeout_s = url, timeout_s
        self._mavsdk: Any = None
        self._answered = False  # whether any request was
        self._unanswered: list[str] = []  # requests, while none was

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
        self._action, self._param = Action(system), Param(system)
        self._telemetry, self._info = Telemetry(system), Info(system)
        self._events, self._direct = Events(system), MavlinkDirect(system)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def _close(self) -> None:
        with sdk_log.closing():
            self._mavsdk.destroy()

    def round_trip_s(self) -> float | None:
        """The shortest of some TIMESYNC requests with their answers, seconds; None: no answer within 5 s."""
        found: list[int] = []
        asked: set[int] = set()

        def take(message: Any, _: Any) -> None:
            received, answer = host_us(), answer_of(message)
            if answer is not None and answer.sent_us in asked and message.system_id == self._system_id:
                found.append(received - answer.sent_us)

        handle = self._direct.subscribe_message("TIMESYNC", take)
        end_s = time.monotonic() + _ROUND_TRIP_MOST_S
        while len(found) < _ROUND_TRIPS and time.monotonic() < end_s:
            now = host_us()
            asked.add(now)
            self._direct.send_message(request(now))
            time.sleep(_ASK_PERIOD_S)
        self._direct.unsubscribe_message(handle)
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
                says = f"the vehicle has fallen silent, {what} was not answered"
                raise NoAnswerError(says, source=self._url) from None
            self._unanswered.append(what)
            if not self._answered and len(self._unanswered) >= _MOST_UNANSWERED:
                says = f"the vehicle sends, but answers no request: {', '.join(self._unanswered)}"
                raise NoAnswerError(says, source=self._url) from None
            raise
        self._answered = True
        return answer

    def set_actuator(self, index: int, value: float) -> None:
        """Command a peripheral output, -1 to 1; an acknowledgement says nothing about movement."""
        self._action.set_actuator(index, value)

    def read_parameters(self, names: Iterable[str]) -> dict[str, float]:
        """Values of the parameters that the vehicle has, whole numbers or not; others are left out."""
        values = {}
        end_s = time.monotonic() + _PARAMETERS_S
        for name in names:
            if time.monotonic() > end_s:
                says = f"parameter {name} and others were not told within {_PARAMETERS_S:g} s"
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

    def observe(self, seconds: float) -> Observation:
        """Ask for the rates of the stream table, then listen; blocks for that long.

        Where PX4 has no position or would not arm, up to 5 s more until it has said why.
        """
        t, seen, place = self._telemetry, Observation(), LocalPosition()
        counts: dict[str, int] = {}

        def count(name: str) -> Callable[[Any, Any], None]:
            counts[name] = 0

            def one(_sample: Any, _: Any) -> None:
                counts[name] += 1

            return one

        def battery(b: Any, _: Any) -> None:
            seen.battery_v = float(b.voltage_v) if math.isfinite(b.voltage_v) else None
            share = 0.01 * float(b.remaining_percent)
            seen.battery_remaining = share if math.isfinite(share) else None

        def gps(info: Any, _: Any) -> None:
            seen.gps_fix = str(info.fix_type.name).lower()

        def health(h: Any, _: Any) -> None:
            place.sent = bool(h.is_local_position_ok)

        def estimator_status(message: Any, _: Any) -> None:
            place.healthy = is_healthy(message.fields_json)

        for set_rate, name in (
            (t.set_rate_imu, "imu"),
            (t.set_rate_attitude_quaternion, "attitude"),
            (t.set_rate_odometry, "odometry"),
            (t.set_rate_actuator_output_status, "actuator"),
        ):
            stream = BY_NAME[name]
            try:
                self._ask(f"rate of {stream.message}", partial(set_rate, stream.rate_hz))
            except NoAnswerError:
                raise
            except Exception:  # refused: the count shows what comes anyway
                continue
        count_imu, clocks = count("imu"), TwoClocks(_STAMP_TOLERANCE_US)

        def imu(sample: Any, _: Any) -> None:
            count_imu(sample, _)
            received = host_us()
            clocks.take(int(sample.timestamp_us), received)
            apart_s = clocks.apart_s(received)
            if apart_s is not None:
                seen.other_vehicle = f"two clocks in turn under one system id, {apart_s:.1f} s apart"

        t.subscribe_imu(imu)
        t.subscribe_attitude_quaternion(count("attitude"))
        t.subscribe_odometry(count("odometry"))
        t.subscribe_actuator_output_status(count("actuator"))
        t.subscribe_battery(battery)
        t.subscribe_health(health)
        t.subscribe_gps_info(gps)
        self._direct.subscribe_message("ESTIMATOR_STATUS", estimator_status)
        reported = self._listen_for_reasons(seen)
        began = time.monotonic()
        before = dict(counts)
        time.sleep(seconds)
        elapsed = time.monotonic() - began
        seen.rates_hz = {name: (counts[name] - before[name]) / elapsed for name in counts}
        for system in self._mavsdk.get_systems():
            if system.has_autopilot() and system.get_system_id() != self._system_id:
                seen.other_vehicle = f"system {system.get_system_id()} sends on the same link"
        seen.local_position_ok = place.ok
        amiss = not place.ok or seen.blocking
        while amiss and not reported.is_set() and time.monotonic() - began < seconds + _REPORT_S:
            reported.wait(0.1)
        with contextlib.suppress(Exception):
            v = self._info.get_version()
            seen.version = f"{v.flight_sw_major}.{v.flight_sw_minor}.{v.flight_sw_patch}"
        return seen

    def _listen_for_reasons(self, seen: Observation) -> threading.Event:
        """Collect why PX4 does not arm; the event is set once its own report has come."""
        reported = threading.Event()

        def say(severity: str, text: str) -> None:
            if severity in reasons.SEVERE and text not in seen.said:
                seen.said.append(text)

        def checks(report: Any, _: Any) -> None:
            reported.set()
            _, seen.blocking, seen.problems = reasons.of_checks(report)

        def sys_status(message: Any, _: Any) -> None:
            found = None if reported.is_set() else reasons.of_sys_status(message.fields_json)
            if found is not None:
                _, seen.blocking, seen.problems = found

        self._telemetry.subscribe_status_text(lambda t, _: say(t.type.name.lower(), t.text))
        self._direct.subscribe_message("SYS_STATUS", sys_status)
        with contextlib.suppress(Exception):
            self._events.subscribe_events(lambda e, _: say(reasons.severity(e.log_level), e.message))
            self._events.subscribe_health_and_arming_checks(checks)
        return reported
