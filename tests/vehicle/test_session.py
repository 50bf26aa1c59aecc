"""A session between app and MAVSDK, with MAVSDK's plugins in its place: what is asked, what is delivered."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from mavsdk.exceptions import MavsdkError

from dart_flight.base.records import (
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
    RoundTrip,
    Setpoint,
    StatusSample,
    StatusText,
    SystemStatus,
    VehicleAction,
)
from dart_flight.base.streams import ESC, ESTIMATOR, MESSAGE_ID, STREAMS
from dart_flight.config.vehicle import load_vehicle, packaged
from dart_flight.vehicle import arming_problems as reasons
from dart_flight.vehicle import vehicle_session as module
from dart_flight.vehicle.clock import LockstepClock, host_us
from dart_flight.vehicle.vehicle_session import VehicleError, VehicleSession, connect

VEHICLE = load_vehicle(packaged("configs", "dart.yaml"))


class Plugin:
    """In the place of a plugin: notes every call; a subscription's callback is kept by its name."""

    def __init__(self, answers: dict[str, Callable[..., Any]]) -> None:
        self.calls: list[tuple[str, tuple[Any, ...]]] = []
        self.callbacks: dict[str, Callable[[Any, Any], None]] = {}
        self._answers = answers

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            self.calls.append((name, arguments))
            if name.startswith("subscribe_"):
                key = arguments[0] if len(arguments) > 1 else name.removeprefix("subscribe_")
                self.callbacks[key] = arguments[-1]
            return self._answers[name](*arguments) if name in self._answers else None

        return call


class Rig:
    """A session on such plugins.

    Args:
        answers: what calls return or raise, by name.
        systems: ids of the systems on the link; the first one is the vehicle's.
    """

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, answers: dict[str, Callable[..., Any]], *systems: int
    ) -> None:
        self.plugins: dict[str, Plugin] = {}
        for name in ("Telemetry", "Offboard", "Action", "MavlinkDirect", "Events"):
            plugin = self.plugins[name] = Plugin(answers)
            monkeypatch.setattr(module, name, lambda _, plugin=plugin: plugin)
        self.seen: list[Input] = []
        found = [
            SimpleNamespace(get_system_id=lambda number=number: number, has_autopilot=lambda: True)
            for number in systems or (1,)
        ]

        async def get_systems() -> list[Any]:
            return found

        self.session = VehicleSession(SimpleNamespace(get_systems=get_systems), found[0], self.seen.append)

    def of(self, kind: type[Any]) -> list[Any]:
        return [item for item in self.seen if isinstance(item, kind)]

    def say(self, plugin: str, stream: str, value: Any) -> None:
        self.plugins[plugin].callbacks[stream](value, None)

    def hear(self, stream: str, **fields: object) -> None:
        """The autopilot's component sends a message."""
        self.say("MavlinkDirect", stream, message(**fields))


def message(**fields: object) -> Any:
    """A message of the autopilot's component."""
    return SimpleNamespace(system_id=1, component_id=1, fields_json=json.dumps(fields))


def test_a_new_session_sends(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    rig.session.send(Setpoint(1, 1, (1.0, 2.0, -3.0), 0.0))
    assert [name for name, _ in rig.plugins["Offboard"].calls] == ["set_position_ned"]


def refuse(*_: Any) -> None:
    raise MavsdkError("refused")


def test_every_stream_is_asked_for_and_a_refusal_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Rig(monkeypatch, {"set_rate_odometry": refuse})
    assert asyncio.run(rig.session.set_rates()) == ["odometry"]
    asked = {name.removeprefix("set_rate_"): rate for name, (rate,) in rig.plugins["Telemetry"].calls}
    assert len(asked) == len(STREAMS)
    assert asked["imu"] == next(s.rate_hz for s in STREAMS if s.name == "imu")
    few = Rig(monkeypatch, {})
    assert asyncio.run(few.session.set_rates(["imu", "attitude"], watching=True)) == []
    assert {name for name, _ in few.plugins["Telemetry"].calls} == {
        "set_rate_imu",
        "set_rate_attitude_quaternion",
    }


@pytest.mark.parametrize(("result", "refused"), [(0, False), (4, True), (None, True)])
def test_a_further_stream_is_asked_for_by_its_message(
    monkeypatch: pytest.MonkeyPatch, result: int | None, refused: bool
) -> None:
    sent: list[dict[str, Any]] = []

    def answer(command: Any) -> Any:
        sent.append(json.loads(command.fields_json))
        return message(command=511, result=result)

    rig = Rig(monkeypatch, {"send_command": answer})
    estimation = SimpleNamespace(uses_esc=True, thrust_source=None)
    rig.session.subscribe(estimation, 4)  # type: ignore[arg-type]
    assert ("esc" in asyncio.run(rig.session.set_rates([]))) is refused
    assert sent == [
        {
            "target_system": 1,
            "target_component": 1,
            "command": 511,
            "confirmation": 0,
            "param1": MESSAGE_ID[stream.message],
            "param2": round(1e6 / stream.rate_hz),
            **{f"param{i}": 0 for i in range(3, 8)},
        }
        for stream in (ESC, ESTIMATOR)
    ]


def test_a_local_position_is_one_that_is_sent_and_is_well(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """PX4 sends a position without motion capture and GPS, too."""
    rig = Rig(monkeypatch, {})
    rig.session.subscribe(VEHICLE.estimation, 4)
    rig.hear("ESTIMATOR_STATUS", flags=0, pos_horiz_accuracy=None)
    rig.hear("ODOMETRY", **ODOMETRY)
    assert not any(status.local_position_ok for status in rig.of(StatusSample))
    rig.hear("ESTIMATOR_STATUS", flags=0xFFFF & ~0x0400, pos_horiz_accuracy=0.1)
    assert rig.of(StatusSample)[-1].local_position_ok
    rig.hear("ESTIMATOR_STATUS", flags=0, pos_horiz_accuracy=0.1)
    assert not rig.of(StatusSample)[-1].local_position_ok


def test_without_word_of_the_estimator_a_usable_odometry_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    rig.session.subscribe(VEHICLE.estimation, 4)
    rig.hear("ODOMETRY", **{**ODOMETRY, "vx": None})
    assert rig.of(StatusSample) == []
    rig.hear("ODOMETRY", **ODOMETRY)
    assert rig.of(StatusSample)[-1].local_position_ok


def test_what_keeps_px4_from_arming_is_delivered_when_it_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    monkeypatch.setattr(
        reasons, "report_from_sys_status", lambda sensors: (False, (str(sensors.enabled),), ())
    )
    rig.session.subscribe(VEHICLE.estimation, 4)
    sensors = {"onboard_control_sensors_present": 7, "onboard_control_sensors_health": 7}
    for number in (1, 1, 2):
        rig.hear("SYS_STATUS", **sensors, onboard_control_sensors_enabled=number)
    assert [report.blocking for report in rig.of(HealthReport)] == [("1",), ("2",)]
    monkeypatch.setattr(reasons, "report_from_checks", lambda report: (True, (), (report,)))
    rig.say("Events", "health_and_arming_checks", "its own words")
    rig.hear("SYS_STATUS", **sensors, onboard_control_sensors_enabled=1)  # the checks count from then on
    assert [report.blocking for report in rig.of(HealthReport)] == [("1",), ("2",), ()]


@pytest.mark.parametrize(("name", "said"), [("SUCCESS", ""), ("COMMAND_DENIED", "COMMAND_DENIED")])
def test_an_action_ends_with_its_answer(monkeypatch: pytest.MonkeyPatch, name: str, said: str) -> None:
    def answer(done: Callable[[Any, Any], None]) -> None:
        for _ in range(2):  # MAVSDK may say it twice
            done(SimpleNamespace(name=name), None)

    rig = Rig(monkeypatch, {"arm_async": answer})
    assert asyncio.run(rig.session.perform(VehicleAction.ARM)) == said


def test_an_action_without_an_answer_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_ACTION_TIMEOUT_S", 0.01)
    rig = Rig(monkeypatch, {"land_async": lambda _: None})
    assert asyncio.run(rig.session.perform(VehicleAction.LAND)) == "no answer"


def test_another_autopilot_on_the_link_is_delivered_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {}, 1, 7)
    for _ in range(2):
        asyncio.run(rig.session.detect_other_autopilot())
    assert [other.system for other in rig.of(OtherVehicle)] == [7]
    alone = Rig(monkeypatch, {}, 1)
    asyncio.run(alone.session.detect_other_autopilot())
    assert alone.of(OtherVehicle) == []


def test_modes_that_no_word_of_ours_has_are_the_pilots(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    rig.session.subscribe(VEHICLE.estimation, 4)
    for main, sub, expected in (
        (6, 0, FlightMode.OFFBOARD),
        (3, 0, FlightMode.MANUAL),
        (4, 9, FlightMode.LAND),
        (10, 0, FlightMode.UNKNOWN),
    ):
        rig.hear("HEARTBEAT", **{**HEARTBEAT, "custom_mode": main << 16 | sub << 24})
        assert rig.of(StatusSample)[-1].flight_mode is expected


# --- what comes ------------------------------------------------------------------------------------------

UP_US = 7_000_000_000  # the autopilot's time at the first sample
IMU = {
    "time_usec": UP_US, "xacc": 0.0, "yacc": 0.0, "zacc": -9.8, "xgyro": 0.0, "ygyro": 0.0, "zgyro": 0.0,
    "fields_updated": 0x1FFF, "id": 0,
}  # fmt: skip
ATTITUDE = {"time_boot_ms": UP_US // 1000, "q1": 1.0, "q2": 0.0, "q3": 0.0, "q4": 0.0}
ODOMETRY: dict[str, Any] = {
    "time_usec": UP_US, "x": 0.0, "y": 0.0, "z": 0.0, "vx": 0.0, "vy": 0.0, "vz": 0.0,
    "frame_id": 1, "child_frame_id": 1, "estimator_type": 8, "reset_counter": 0,
}  # fmt: skip
HEARTBEAT = {"autopilot": 12, "base_mode": 129, "custom_mode": 6 << 16, "system_status": 4}
BATTERY = {"id": 0, "battery_function": 1, "battery_remaining": 50, "voltages": [15000] + [65535] * 9}


def test_whatever_is_subscribed_to_is_delivered_with_its_receipt(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, estimation = Rig(monkeypatch, {}), SimpleNamespace(uses_esc=True, thrust_source=None)
    began_us = host_us()
    rig.session.subscribe(estimation, 4)  # type: ignore[arg-type]
    event = SimpleNamespace(compid=1, log_level=4, message="gone", event_name="went")
    streams: tuple[tuple[str, dict[str, Any], type[Any]], ...] = (
        ("HIGHRES_IMU", IMU, ImuSample),
        ("ATTITUDE_QUATERNION", ATTITUDE, AttitudeSample),
        ("ODOMETRY", ODOMETRY, OdometrySample),
        ("ACTUATOR_OUTPUT_STATUS", {"time_usec": 1, "active": 4, "actuator": [1500] * 4}, ActuatorSample),
        ("ESC_STATUS", {"time_usec": 1, "index": 0, "rpm": [1] * 4}, EscSample),
        ("HEARTBEAT", HEARTBEAT, StatusSample),
        ("EXTENDED_SYS_STATE", {"landed_state": 2}, StatusSample),
        ("BATTERY_STATUS", BATTERY, StatusSample),
        ("STATUSTEXT", {"severity": 4, "text": "low\t", "id": 0}, StatusText),
    )
    said: list[tuple[str, str, Any, type[Any]]] = [
        *(("MavlinkDirect", name, message(**fields), kind) for name, fields, kind in streams),
        ("Events", "events", event, StatusText),
    ]
    for plugin, stream, value, kind in said:
        before = len(rig.of(kind))
        rig.say(plugin, stream, value)
        found = rig.of(kind)[before:][-1]
        assert began_us <= found.received_us <= host_us()
        if isinstance(found, StatusSample | StatusText):  # unstamped: by the clock that the IMU has told
            (offset,) = rig.of(ClockOffset)
            assert found.t_us == found.received_us + offset.offset_us
            assert abs(found.t_us - UP_US) < 5_000_000
    status = rig.of(StatusSample)[-1]
    assert (status.armed, status.landed, status.battery_v) == (True, LandedState.IN_AIR, 15.0)
    assert (status.system_status, status.battery_id) == (SystemStatus.ACTIVE, 0)
    assert [(text.text, text.event) for text in rig.of(StatusText)] == [("low", ""), ("gone", "went")]
    assert rig.of(EscSample)[0].rpm == (1.0,) * 4  # of so many motors


def test_only_a_guarded_flight_asks_for_what_the_guard_wants(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    rig.session.subscribe(VEHICLE.estimation, 4, guarded=False)
    assert rig.plugins["Events"].calls == []
    assert not rig.plugins["MavlinkDirect"].callbacks.keys() & {"ESTIMATOR_STATUS", "SYS_STATUS"}


def test_the_estimators_word_is_delivered_beside_the_position(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    rig.session.subscribe(VEHICLE.estimation, 4)
    rig.hear("ESTIMATOR_STATUS", flags=0, pos_horiz_accuracy=0.25)
    assert [(e.healthy, e.position_sd_m) for e in rig.of(EstimatorSample)] == [(False, 0.25)]


def test_only_the_autopilots_heartbeat_says_whether_it_is_in_a_failsafe(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Rig(monkeypatch, {})
    rig.session.subscribe(VEHICLE.estimation, 4)
    own = rig.session._raw.get_system_id()
    for system, component, number in (
        (own, 1, 4),
        (own, 154, 8),
        (own + 1, 1, 8),
        (own, 1, 5),
        (own, 1, 5),
        (own, 1, 9),
    ):
        beat = message(**{**HEARTBEAT, "system_status": number})
        beat.system_id, beat.component_id = system, component
        rig.say("MavlinkDirect", "HEARTBEAT", beat)
    statuses = [status.system_status for status in rig.of(StatusSample)]
    assert statuses == ["active", "critical", "critical", "unknown"]


# --- what is sent ----------------------------------------------------------------------------------------


def test_a_setpoint_carries_what_it_has(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    place, velocity, acceleration = (1.0, 2.0, -3.0), (0.1, 0.2, 0.3), (0.4, 0.5, 0.6)
    for v, a in ((None, None), (velocity, None), (velocity, acceleration)):
        rig.session.send(Setpoint(1, 1, place, 0.5, velocity_ned=v, acceleration_ned=a))
    names, sent = zip(*rig.plugins["Offboard"].calls, strict=True)
    assert names == (
        "set_position_ned",
        "set_position_velocity_ned",
        "set_position_velocity_acceleration_ned",
    )
    for position, *others in sent:
        assert (position.north_m, position.east_m, position.down_m) == place
        for turned in (position, *others[:1]):
            assert turned.yaw_deg == pytest.approx(math.degrees(0.5))
    for _, moving, *_ in sent[1:]:
        assert (moving.north_m_s, moving.east_m_s, moving.down_m_s) == velocity
    pushed = sent[2][2]
    assert (pushed.north_m_s2, pushed.east_m_s2, pushed.down_m_s2) == acceleration


def test_the_ground_and_the_servo_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    rig.session.send_text("x" * 60)
    rig.session.send_text("short")
    rig.session.set_actuator(2, 0.5)
    sent = [json.loads(m.fields_json) for _, (m,) in rig.plugins["MavlinkDirect"].calls]
    assert [(s["text"], s["chunk_seq"]) for s in sent] == [("x" * 50, 0), ("x" * 10, 1), ("short", 0)]
    assert sent[0]["id"] == sent[1]["id"] != 0 == sent[2]["id"]
    assert rig.plugins["Action"].calls == [("set_actuator", (2, 0.5))]
    deaf = Rig(monkeypatch, {"send_message": refuse})
    deaf.session.send_text("where the link allows")


def test_only_mavsdks_errors_are_refusals(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise TypeError("no rate")

    with pytest.raises(TypeError, match="no rate"):
        asyncio.run(Rig(monkeypatch, {"set_rate_odometry": fail}).session.set_rates())
    with pytest.raises(TypeError, match="no rate"):
        asyncio.run(Rig(monkeypatch, {"send_command": fail}).session.stop_messages((30,)))
    with pytest.raises(VehicleError, match="refused"):
        Rig(monkeypatch, {"set_actuator": refuse}).session.set_actuator(1, 0.5)


def test_messages_are_stopped_one_by_one_whatever_is_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {"send_command": refuse})
    asyncio.run(rig.session.stop_messages((30, 33)))
    sent = [json.loads(command.fields_json) for _, (command,) in rig.plugins["MavlinkDirect"].calls]
    assert [(s["command"], s["param1"], s["param2"]) for s in sent] == [(511, 30, -1), (511, 33, -1)]
    assert {s["target_system"] for s in sent} == {1}


# --- the round trip --------------------------------------------------------------------------------------


def answering(rig: Rig, *, ahead_us: int = 0, system: int = 1, other_first: bool = False) -> None:
    """The vehicle answers each request, by its own clock."""

    def answer(asked: Any) -> None:
        ts1 = json.loads(asked.fields_json)["ts1"]
        reply = message(tc1=ts1 + 1000 * ahead_us, ts1=ts1)
        reply.system_id = system
        rig.say("MavlinkDirect", "TIMESYNC", reply)

    rig.plugins["MavlinkDirect"]._answers["send_message"] = answer


def test_a_round_trip_that_comes_back_is_delivered(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    answering(rig, ahead_us=500)
    assert asyncio.run(rig.session.measure_link(5.0)) == []
    (trip,) = rig.of(RoundTrip)  # the first one is enough
    assert 0 <= trip.received_us - trip.sent_us < 5_000_000
    assert trip.autopilot_us == trip.sent_us + 500
    rig.session.clock = LockstepClock()
    assert asyncio.run(rig.session.measure_link(5.0)) == []
    assert rig.of(RoundTrip)[-1].autopilot_us is None  # it goes at any pace


def test_what_another_asks_or_answers_is_no_round_trip(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    answering(rig, ahead_us=500, system=7)
    assert asyncio.run(rig.session.measure_link(0.01)) == []  # the rate's answer counts
    for tc1, ts1 in ((0, 1_000_000), (5_000_000, 1_000_000)):  # a request, and an answer to no request
        strange = message(tc1=tc1, ts1=ts1)
        strange.system_id = 1
        rig.say("MavlinkDirect", "TIMESYNC", strange)
    (trip,) = rig.of(RoundTrip)
    assert trip.autopilot_us is None
    assert trip.received_us >= trip.sent_us


def test_a_link_that_only_sends_is_named_by_what_it_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    class TimedOutError(MavsdkError):  # type: ignore[misc]  # mavsdk has no types
        result = SimpleNamespace(name="TIMEOUT")

    def time_out(_: float) -> None:
        raise TimedOutError

    rig = Rig(monkeypatch, {"set_rate_imu": time_out, "send_message": refuse})
    assert asyncio.run(rig.session.measure_link(0.01)) == ["TIMESYNC", f"rate of {STREAMS[0].message}"]
    assert rig.of(RoundTrip) == []
    refused = Rig(monkeypatch, {"set_rate_imu": refuse})  # it says no: that is an answer
    assert asyncio.run(refused.session.measure_link(0.01)) == []
    assert len(refused.of(RoundTrip)) == 1


def test_while_it_is_measured_requests_go_on_and_then_they_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """The flight asks by itself afterwards: not twice as often."""
    monkeypatch.setattr(module, "_REQUEST_PERIOD_S", 0.001)
    rig = Rig(monkeypatch, {})
    asked: list[Any] = []

    def answer_the_third(request: Any) -> None:
        asked.append(request)
        if len(asked) == 3:
            ts1 = json.loads(asked[0].fields_json)["ts1"]  # seconds late, to the first of them
            reply = message(tc1=ts1 + 1, ts1=ts1)
            reply.system_id = 1
            rig.say("MavlinkDirect", "TIMESYNC", reply)

    rig.plugins["MavlinkDirect"]._answers["send_message"] = answer_the_third

    async def measure() -> set[asyncio.Task[Any]]:
        assert await rig.session.measure_link(5.0) == []
        await asyncio.sleep(0)
        return asyncio.all_tasks() - {asyncio.current_task()}

    assert asyncio.run(measure()) == set()


# --- the connection --------------------------------------------------------------------------------------


class Sdk:
    """In the place of MAVSDK: a link on which an autopilot answers, or none, or that cannot be opened."""

    def __init__(self, system: object, problem: Exception | None) -> None:
        self._system, self._problem = system, problem
        self.left = 0

    async def __aenter__(self) -> Sdk:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.left += 1

    async def add_any_connection(self, url: str) -> None:
        if self._problem is not None:
            raise self._problem

    async def first_autopilot(self, timeout_s: float) -> object:
        return self._system


@pytest.mark.parametrize(
    ("answers", "problem", "says"),
    [
        (True, None, ""),
        (False, None, "no autopilot on udpin://here within 3 s"),
        (True, OSError("in use"), "cannot open udpin://here: in use"),
    ],
)
def test_a_connection_is_opened_and_closed_and_says_what_is_wrong(
    monkeypatch: pytest.MonkeyPatch, answers: bool, problem: Exception | None, says: str
) -> None:
    Rig(monkeypatch, {})
    sdk, opened = Sdk(object() if answers else None, problem), list[bool]()
    monkeypatch.setattr(module, "Mavsdk", lambda _: sdk)
    redirected = list[bool]()  # what MAVSDK itself writes is not for the terminal
    monkeypatch.setattr("dart_flight.vehicle.sdk_log.redirect", lambda: redirected.append(True))

    async def use() -> None:
        async with connect("udpin://here", 3.0, lambda _: None, opened=lambda: opened.append(True)):
            assert opened == [True]
            assert sdk.left == 0

    if says:
        with pytest.raises(VehicleError, match=says):
            asyncio.run(use())
    else:
        asyncio.run(use())
    assert opened == [True] * (not says)
    assert redirected == [True]
    assert sdk.left == 1
