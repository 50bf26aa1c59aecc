"""A VehicleSession on doubles of MAVSDK's plugins: its requests, commands and delivered records."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.events import (
    HealthAndArmingCheckMode,
    HealthAndArmingCheckProblem,
    HealthAndArmingCheckReport,
    LogLevel,
)

from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    ClockOffset,
    EscSample,
    EstimatorSample,
    FlightMode,
    HealthReport,
    ImuSample,
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
from dart_flight.base.streams import OPTIONAL, STREAMS
from dart_flight.config.vehicle import load_vehicle, packaged
from dart_flight.vehicle import vehicle_session as module
from dart_flight.vehicle.clock import LockstepClock, host_us
from dart_flight.vehicle.vehicle_session import VehicleError, connect
from tests.vehicle.session_rig import MakeSession, SessionRig, message

VEHICLE = load_vehicle(packaged("configs", "dart.yaml"))


def refuse(*_: Any) -> None:
    raise MavsdkError("refused")


@pytest.mark.parametrize(("result", "refused"), [(0, False), (4, True), (None, True)])
def test_every_stream_is_requested_and_a_refusal_is_reported(
    make_session: MakeSession, result: int | None, refused: bool
) -> None:
    sent: list[dict[str, Any]] = []

    def answer(command: Any) -> Any:
        sent.append(json.loads(command.fields_json))
        return message(command=511, result=0 if sent[-1]["param1"] == STREAMS[0].number else result)

    rig = make_session({"send_command": answer}).subscribe()
    others = [stream.name for stream in (*STREAMS[1:], *OPTIONAL)]
    assert asyncio.run(rig.session.set_rates()) == (others if refused else [])
    assert sent == [
        {
            "target_system": 1,
            "target_component": 1,
            "command": 511,
            "confirmation": 0,
            "param1": stream.number,
            "param2": round(1e6 / stream.rate_hz),
            **{f"param{i}": 0 for i in range(3, 8)},
        }
        for stream in (*STREAMS, *OPTIONAL)
    ]


def test_a_display_requests_few_streams_at_lower_rates(make_session: MakeSession) -> None:
    sent: list[tuple[int, int]] = []

    def answer(command: Any) -> Any:
        fields = json.loads(command.fields_json)
        sent.append((fields["param1"], fields["param2"]))
        return message(command=511, result=0)

    few = make_session({"send_command": answer})
    assert asyncio.run(few.session.set_rates(["imu", "attitude"], watching=True)) == []
    assert sent == [(105, 4000), (31, 16_000)]


def test_local_position_is_ok_only_with_odometry_and_a_healthy_estimator(rig: SessionRig) -> None:
    """PX4 also sends a position when it has neither motion capture nor GPS."""
    rig.receive("ESTIMATOR_STATUS", flags=0, pos_horiz_accuracy=None)
    rig.receive("ODOMETRY", **ODOMETRY)
    assert not any(status.local_position_ok for status in rig.records_of(StatusSample))
    rig.receive("ESTIMATOR_STATUS", flags=0xFFFF & ~0x0400, pos_horiz_accuracy=0.1)
    assert rig.records_of(StatusSample)[-1].local_position_ok
    rig.receive("ESTIMATOR_STATUS", flags=0, pos_horiz_accuracy=0.1)
    assert not rig.records_of(StatusSample)[-1].local_position_ok


def test_usable_odometry_suffices_if_no_estimator_status_arrives(rig: SessionRig) -> None:
    rig.receive("ODOMETRY", **{**ODOMETRY, "vx": None})
    assert rig.records_of(StatusSample) == []
    rig.receive("ODOMETRY", **ODOMETRY)
    assert rig.records_of(StatusSample)[-1].local_position_ok


def test_arming_problems_are_delivered_when_they_change(rig: SessionRig) -> None:
    every, prearm = 1 << 28 | 7, 1 << 28
    for health in (every, every, every & ~prearm, every & ~prearm):
        sensors = ("present", every), ("enabled", every), ("health", health)
        rig.receive("SYS_STATUS", **{f"onboard_control_sensors_{name}": bits for name, bits in sensors})
    found = [(), ("preflight checks failed",)]
    assert [report.blocking for report in rig.records_of(HealthReport)] == found
    text = HealthAndArmingCheckProblem("No valid position estimate", "", LogLevel.ERROR, "system")
    mode = HealthAndArmingCheckMode("Hold", False, [text])
    rig.publish("Events", "health_and_arming_checks", HealthAndArmingCheckReport(mode, [], [text]))
    # The checks now replace SYS_STATUS.
    rig.receive("SYS_STATUS", **{f"onboard_control_sensors_{name}": every for name, _ in sensors})
    found.append(("No valid position estimate",))
    assert [report.blocking for report in rig.records_of(HealthReport)] == found


@pytest.mark.parametrize(("name", "said"), [("SUCCESS", ""), ("COMMAND_DENIED", "COMMAND_DENIED")])
def test_an_action_returns_its_answer(make_session: MakeSession, name: str, said: str) -> None:
    def answer(done: Callable[[Any, Any], None]) -> None:
        for _ in range(2):  # MAVSDK may deliver the result twice
            done(SimpleNamespace(name=name), None)

    rig = make_session({"arm_async": answer})
    assert asyncio.run(rig.session.perform(VehicleAction.ARM)) == said


def test_an_unanswered_action_is_reported(make_session: MakeSession, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_ACTION_TIMEOUT_S", 0.01)
    rig = make_session({"land_async": lambda _: None})
    assert asyncio.run(rig.session.perform(VehicleAction.LAND)) == "no answer"


def test_another_autopilot_on_the_link_is_delivered_once(make_session: MakeSession) -> None:
    rig = make_session({}, (1, 7))
    for _ in range(2):
        asyncio.run(rig.session.detect_other_autopilot())
    assert [other.system for other in rig.records_of(OtherVehicle)] == [7]
    alone = make_session({}, (1,))
    asyncio.run(alone.session.detect_other_autopilot())
    assert alone.records_of(OtherVehicle) == []


def test_px4_modes_are_converted_and_other_modes_are_unknown(rig: SessionRig) -> None:
    for main, sub in ((6, 0), (3, 0), (4, 9), (10, 0)):
        rig.receive("HEARTBEAT", **{**HEARTBEAT, "custom_mode": main << 16 | sub << 24})
    modes = [status.flight_mode for status in rig.records_of(StatusSample)]
    assert modes == [FlightMode.OFFBOARD, FlightMode.MANUAL, FlightMode.LAND, FlightMode.UNKNOWN]


# --- incoming messages -----------------------------------------------------------------------------------

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


def test_every_subscribed_message_is_delivered_with_its_receive_time(make_session: MakeSession) -> None:
    began_us, rig = host_us(), make_session({}).subscribe()
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
        before = len(rig.records_of(kind))
        rig.publish(plugin, stream, value)
        found = rig.records_of(kind)[before:][-1]
        assert began_us <= found.received_us <= host_us()
        if isinstance(found, StatusSample | StatusText):  # unstamped: timed by the clock of the IMU's stamps
            (offset,) = rig.records_of(ClockOffset)
            assert found.t_us == found.received_us + offset.offset_us
            assert abs(found.t_us - UP_US) < 5_000_000
    status = rig.records_of(StatusSample)[-1]
    assert (status.armed, status.landed, status.battery_v) == (True, LandedState.IN_AIR, 15.0)
    assert (status.system_status, status.battery_id) == (SystemStatus.ACTIVE, 0)
    assert [(text.text, text.event) for text in rig.records_of(StatusText)] == [("low", ""), ("gone", "went")]
    assert rig.records_of(EscSample)[0].rpm == (1.0,) * 4  # one per motor


def test_an_unguarded_flight_does_not_subscribe_to_the_guards_messages(make_session: MakeSession) -> None:
    rig = make_session({})
    rig.session.subscribe(VEHICLE.estimation, 4, guarded=False)
    assert rig.plugins["Events"].calls == []
    assert not rig.plugins["MavlinkDirect"].callbacks.keys() & {"ESTIMATOR_STATUS", "SYS_STATUS"}


def test_the_estimators_health_and_accuracy_are_delivered(rig: SessionRig) -> None:
    rig.receive("ESTIMATOR_STATUS", flags=0, pos_horiz_accuracy=0.25)
    assert [(e.healthy, e.position_sd_m) for e in rig.records_of(EstimatorSample)] == [(False, 0.25)]


def test_the_failsafe_state_comes_only_from_the_autopilots_heartbeat(rig: SessionRig) -> None:
    statuses = ((1, 1, 4), (1, 154, 8), (2, 1, 8), (1, 1, 5), (1, 1, 5), (1, 1, 9))
    for system, component, number in statuses:
        heartbeat = message(system, component, **{**HEARTBEAT, "system_status": number})
        rig.publish("MavlinkDirect", "HEARTBEAT", heartbeat)
    found = [status.system_status for status in rig.records_of(StatusSample)]
    assert found == ["active", "critical", "critical", "unknown"]


# --- outgoing messages -----------------------------------------------------------------------------------


def test_a_setpoint_is_sent_with_the_fields_that_it_has(make_session: MakeSession) -> None:
    rig = make_session({})
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


def test_texts_are_sent_in_chunks_and_the_servo_is_commanded(make_session: MakeSession) -> None:
    rig = make_session({})
    rig.session.send_text("x" * 60)
    rig.session.send_text("short")
    rig.session.set_actuator(2, 0.5)
    sent = [json.loads(m.fields_json) for _, (m,) in rig.plugins["MavlinkDirect"].calls]
    assert [(s["text"], s["chunk_seq"]) for s in sent] == [("x" * 50, 0), ("x" * 10, 1), ("short", 0)]
    assert sent[0]["id"] == sent[1]["id"] != 0 == sent[2]["id"]
    assert rig.plugins["Action"].calls == [("set_actuator", (2, 0.5))]
    one_way = make_session({"send_message": refuse})
    one_way.session.send_text("where the link allows")


def test_only_mavsdk_errors_count_as_refusals(make_session: MakeSession) -> None:
    def fail(*_: Any) -> None:
        raise TypeError("no rate")

    with pytest.raises(TypeError, match="no rate"):
        asyncio.run(make_session({"send_command": fail}).session.set_rates())
    with pytest.raises(TypeError, match="no rate"):
        asyncio.run(make_session({"send_command": fail}).session.stop_messages((30,)))
    with pytest.raises(VehicleError, match="refused"):
        make_session({"set_actuator": refuse}).session.set_actuator(1, 0.5)


def test_messages_are_stopped_one_by_one_even_if_refused(make_session: MakeSession) -> None:
    rig = make_session({"send_command": refuse})
    asyncio.run(rig.session.stop_messages((30, 33)))
    sent = [json.loads(command.fields_json) for _, (command,) in rig.plugins["MavlinkDirect"].calls]
    assert [(s["command"], s["param1"], s["param2"]) for s in sent] == [(511, 30, -1), (511, 33, -1)]
    assert {s["target_system"] for s in sent} == {1}


# --- the round trip --------------------------------------------------------------------------------------


def answer_timesync(rig: SessionRig, *, ahead_us: int = 0, system: int = 1) -> None:
    """Make the vehicle answer each TIMESYNC request by its own clock."""

    def answer(requested: Any) -> None:
        ts1 = json.loads(requested.fields_json)["ts1"]
        rig.publish("MavlinkDirect", "TIMESYNC", message(system, tc1=ts1 + 1000 * ahead_us, ts1=ts1))

    rig.plugins["MavlinkDirect"].answers["send_message"] = answer


def test_an_answered_round_trip_is_delivered(make_session: MakeSession) -> None:
    rig = make_session({})
    answer_timesync(rig, ahead_us=500)
    assert asyncio.run(rig.session.measure_link(5.0)) == []
    (trip,) = rig.records_of(RoundTrip)  # the first one is enough
    assert 0 <= trip.received_us - trip.sent_us < 5_000_000
    assert trip.autopilot_us == trip.sent_us + 500
    rig.session.clock = LockstepClock()
    assert asyncio.run(rig.session.measure_link(5.0)) == []
    assert rig.records_of(RoundTrip)[-1].autopilot_us is None  # a lockstep clock runs at any pace


def test_timesync_of_other_systems_does_not_count_as_a_round_trip(make_session: MakeSession) -> None:
    rig = make_session({"send_command": lambda _: message(command=511, result=0)})
    answer_timesync(rig, ahead_us=500, system=7)
    assert asyncio.run(rig.session.measure_link(0.01)) == []  # the answer to the rate request suffices
    for tc1, ts1 in ((0, 1_000_000), (5_000_000, 1_000_000)):  # a request, and an answer to no request
        rig.receive("TIMESYNC", tc1=tc1, ts1=ts1)
    (trip,) = rig.records_of(RoundTrip)
    assert trip.autopilot_us is None
    assert trip.received_us >= trip.sent_us


def test_a_one_way_link_is_reported_with_its_unanswered_requests(make_session: MakeSession) -> None:
    rig = make_session({"send_command": refuse, "send_message": refuse})
    assert asyncio.run(rig.session.measure_link(0.01)) == ["TIMESYNC", f"rate of {STREAMS[0].message}"]
    assert rig.records_of(RoundTrip) == []
    denied = message(command=511, result=4)  # a refusal is an answer
    refused = make_session({"send_command": lambda _: denied})
    assert asyncio.run(refused.session.measure_link(0.01)) == []
    assert len(refused.records_of(RoundTrip)) == 1


def test_timesync_requests_continue_only_during_the_measurement(
    make_session: MakeSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The flight sends its own requests afterwards; continued ones would double the rate."""
    monkeypatch.setattr(module, "_REQUEST_PERIOD_S", 0.001)
    rig = make_session({})
    requested: list[Any] = []

    def answer_the_third(request: Any) -> None:
        requested.append(request)
        if len(requested) == 3:
            ts1 = json.loads(requested[0].fields_json)["ts1"]  # a late answer to the first request
            rig.receive("TIMESYNC", tc1=ts1 + 1, ts1=ts1)

    rig.plugins["MavlinkDirect"].answers["send_message"] = answer_the_third

    async def measure() -> set[asyncio.Task[Any]]:
        assert await rig.session.measure_link(5.0) == []
        await asyncio.sleep(0)
        return asyncio.all_tasks() - {asyncio.current_task()}

    assert asyncio.run(measure()) == set()


# --- the connection --------------------------------------------------------------------------------------


class Sdk:
    """A double of MAVSDK whose link finds an autopilot, finds none, or cannot be opened."""

    def __init__(self, system: object, problem: Exception | None) -> None:
        self._system, self._problem = system, problem
        self.exits = 0

    async def __aenter__(self) -> Sdk:
        return self

    def destroy(self) -> None:
        self.exits += 1

    async def add_any_connection(self, url: str) -> None:
        if self._problem is not None:
            raise self._problem

    async def first_autopilot(self, timeout_s: float) -> object:
        return self._system


@pytest.mark.parametrize(
    ("answers", "problem", "message_part"),
    [
        (True, None, ""),
        (False, None, "no autopilot on udpin://here within 3 s"),
        (True, OSError("in use"), "cannot open udpin://here: in use"),
    ],
)
def test_a_connection_is_opened_and_closed_and_its_problem_is_reported(
    make_session: MakeSession,
    monkeypatch: pytest.MonkeyPatch,
    answers: bool,
    problem: Exception | None,
    message_part: str,
) -> None:
    make_session({})
    system = SimpleNamespace(get_system_id=lambda: 1)
    sdk, opened = Sdk(system if answers else None, problem), list[bool]()
    monkeypatch.setattr(module, "Mavsdk", lambda _: sdk)
    redirected = list[bool]()  # MAVSDK's own output must not reach the terminal
    monkeypatch.setattr("dart_flight.vehicle.sdk_log.redirect", lambda: redirected.append(True))

    async def use() -> None:
        async with connect("udpin://here", 3.0, lambda _: None, opened=lambda: opened.append(True)):
            assert opened == [True]
            assert sdk.exits == 0

    if message_part:
        with pytest.raises(VehicleError, match=message_part):
            asyncio.run(use())
    else:
        asyncio.run(use())
    assert opened == [True] * (not message_part)
    assert redirected == [True]
    assert sdk.exits == 1
