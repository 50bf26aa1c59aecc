"""The acceptance table: every row with a wrong sender, another instance, no values, a neighbouring scale."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.records import (
    ActuatorSample,
    EscSample,
    EstimatorSample,
    FlightMode,
    ImuSample,
    OdometrySample,
    StatusSample,
    StatusText,
)
from dart_flight.base.streams import STREAMS
from dart_flight.recording.events import EventFormatter, Level
from dart_flight.vehicle import messages
from dart_flight.vehicle.messages import ENTRIES, MessageEntry, Unusable
from tests.vehicle.test_session import Rig

Fields = dict[str, Any]


class Row(NamedTuple):
    """A good message of an entry and its neighbours; None: the message cannot have one."""

    good: Fields
    nothing: Fields  # marked as invalid
    other_scale: Fields | None = None
    other_instance: Fields | None = None


_NAN = None  # as it arrives
_IMU: Fields = {
    "time_usec": 5, "xacc": 0.1, "yacc": 0.2, "zacc": -9.8, "xgyro": 0.3, "ygyro": 0.1, "zgyro": 0.0,
    "fields_updated": 63, "id": 0,
}  # fmt: skip
_ODOMETRY: Fields = {
    "time_usec": 9, "frame_id": 1, "child_frame_id": 1, "x": 1.0, "y": 2.0, "z": -3.0, "vx": 0.1, "vy": 0.2,
    "vz": 0.3, "reset_counter": 4, "estimator_type": 8, "quality": 0,
}  # fmt: skip
_BATTERY: Fields = {
    "id": 0, "battery_function": 1, "battery_remaining": 80, "voltages": [4000] * 4 + [65535] * 6,
    "voltages_ext": [0] * 4,
}  # fmt: skip
_SENSORS = (
    "onboard_control_sensors_present",
    "onboard_control_sensors_enabled",
    "onboard_control_sensors_health",
)
ROWS: dict[str, Row] = {
    "HIGHRES_IMU": Row(_IMU, {"zacc": _NAN}, {"zacc": -1000.0}, {"id": 1}),  # milli-g
    "ATTITUDE_QUATERNION": Row(
        {"time_boot_ms": 3, "q1": 1.0, "q2": 0.0, "q3": 0.0, "q4": 0.0}, {"q1": _NAN}, {"q1": 57.3}
    ),
    "ODOMETRY": Row(_ODOMETRY, {"vx": _NAN}, {"vx": 1000.0}, {"estimator_type": 2}),  # mm/s; vision
    "HEARTBEAT": Row(
        {"autopilot": 12, "base_mode": 129, "custom_mode": 6 << 16, "system_status": 4},
        {"base_mode": 128},
        {"autopilot": 3},  # the same numbers mean other modes
    ),
    "EXTENDED_SYS_STATE": Row({"landed_state": 1}, {"landed_state": 0}, {"landed_state": 100}),
    "ACTUATOR_OUTPUT_STATUS": Row(
        {"time_usec": 7, "active": 4, "actuator": [1500.0] * 4 + [0.0] * 28},
        {"actuator": [_NAN] * 32},
        {"actuator": [65535.0] * 32},
    ),
    "ESC_STATUS": Row(
        {"time_usec": 5, "index": 0, "rpm": [9000] * 4},
        {"rpm": []},
        {"rpm": [9_000_000] * 4},  # 1/min times 1000
        {"index": 4},  # a group without the first one
    ),
    "BATTERY_STATUS": Row(
        _BATTERY,
        {"voltages": [65535] * 10, "battery_remaining": -1},
        {"voltages": [400] * 4 + [65535] * 6},  # hundredths of a volt
        {"battery_function": 3, "id": 1},
    ),
    "ESTIMATOR_STATUS": Row(
        {"flags": 831, "pos_horiz_accuracy": 0.05}, {"pos_horiz_accuracy": -1.0}, {"pos_horiz_accuracy": 5e4}
    ),
    "SYS_STATUS": Row(dict.fromkeys(_SENSORS, 7), {_SENSORS[0]: 0}),
    "STATUSTEXT": Row(
        {"severity": 4, "text": "low battery", "id": 0, "chunk_seq": 0}, {"text": ""}, {"severity": 40}
    ),
    "TIMESYNC": Row({"tc1": 7000, "ts1": 5000}, {"tc1": 0}),
    "GPS_RAW_INT": Row({"fix_type": 6}, {"fix_type": 200}),
    "RC_CHANNELS": Row({"chancount": 8, "rssi": 200}, {"chancount": 0}),
}


def message(fields: Fields, component: int = 1, system: int = 1) -> Any:
    return SimpleNamespace(system_id=system, component_id=component, fields_json=json.dumps(fields))


class Heard:
    """A session that is sent messages of one entry: what becomes of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, entry: MessageEntry) -> None:
        self.rig, self.name = Rig(monkeypatch, {}), entry.message
        estimation = SimpleNamespace(uses_esc=True, thrust_source=None)
        self.rig.session.subscribe(estimation, 4, lowest_battery_v=14.0)  # type: ignore[arg-type]
        if entry.message not in self.rig.plugins["MavlinkDirect"].callbacks:
            self.rig.session.listen(entry, lambda value, _: self.rig.seen.append(value))

    def send(self, fields: Fields, component: int = 1, system: int = 1) -> int:
        """Send a message; returns how many records or values it led to."""
        before = len(self.rig.seen)
        self.rig.say("MavlinkDirect", self.name, message(fields, component, system))
        return len(self.rig.seen) - before

    @property
    def usable(self) -> dict[tuple[int, int], int]:
        """Usable messages by system and component."""
        found: dict[tuple[int, int], int] = {}
        for (_, system, component, _), count in self.rig.session.senders.items():
            found[system, component] = found.get((system, component), 0) + count.usable
        return found


def test_the_table_and_the_rows_here_are_the_same() -> None:
    assert [entry.message for entry in ENTRIES] == list(ROWS)
    assert {entry.stream for entry in ENTRIES} >= {stream.name for stream in STREAMS}


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.message)
def test_only_the_autopilots_component_is_heard(monkeypatch: pytest.MonkeyPatch, entry: MessageEntry) -> None:
    good, heard = ROWS[entry.message].good, Heard(monkeypatch, entry)
    for component, system in ((197, 1), (154, 1), (0, 1), (1, 7)):
        assert heard.send(good, component, system) == 0
        assert heard.usable[system, component] == 0, "counted all the same, for `check`"
    assert heard.send(good) > 0
    assert heard.usable[1, 1] == 1


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.message)
@pytest.mark.parametrize("what", ["nothing", "other_scale", "other_instance"])
def test_a_message_without_usable_values_is_no_sample(
    monkeypatch: pytest.MonkeyPatch, entry: MessageEntry, what: str
) -> None:
    row, heard = ROWS[entry.message], Heard(monkeypatch, entry)
    changes = getattr(row, what)
    if changes is None or (entry.message, what) == ("BATTERY_STATUS", "other_instance"):
        return  # judged among the others: see the tests of batteries
    assert heard.send({**row.good, **changes}) == 0
    assert heard.usable[1, 1] == 0
    (count,) = heard.rig.session.senders.values()
    assert count.reason
    if what != "other_instance" and entry.message != "ACTUATOR_OUTPUT_STATUS":
        assert entry.decode(json.dumps({**row.good, **changes})) is None
    assert heard.send(row.good) > 0, "the next good one counts"


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.message)
def test_whatever_json_comes_a_decoder_answers(entry: MessageEntry) -> None:
    for text in ("", "null", "[]", "{}", '{"x":', '{"id": "a"}'):
        assert entry.decode(text) is None


@given(
    st.dictionaries(st.sampled_from([*_ODOMETRY]), st.none() | st.floats(-1e9, 1e9) | st.integers(-9, 300))
)
def test_no_odometry_has_a_value_that_is_none(changes: Fields) -> None:
    found = messages.ODOMETRY.decode(json.dumps({**_ODOMETRY, **changes}))
    if found is not None:
        assert all(math.isfinite(v) and abs(v) <= 1e4 for v in (*found.position_ned, *found.velocity_ned))


# --- the senders of the issue ------------------------------------------------------------------------------


def heard(monkeypatch: pytest.MonkeyPatch) -> Rig:
    rig = Rig(monkeypatch, {})
    estimation = SimpleNamespace(uses_esc=True, thrust_source=None)
    rig.session.subscribe(estimation, 4, lowest_battery_v=14.0)  # type: ignore[arg-type]
    return rig


def test_a_visual_odometry_turned_or_shifted_moves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = heard(monkeypatch)
    turned = {**_ODOMETRY, "x": -1.2, "y": 1.9, "frame_id": 20, "child_frame_id": 12, "estimator_type": 2}
    for fields, component in ((turned, 197), (_ODOMETRY, 1), ({**_ODOMETRY, "x": 1.25}, 197)):
        rig.say("MavlinkDirect", "ODOMETRY", message(fields, component))
    (sample,) = rig.of(OdometrySample)
    assert sample.position_ned == (1.0, 2.0, -3.0)
    assert len(rig.of(EstimatorSample)) == 1  # a foreign reset counter is none either


@pytest.mark.parametrize("velocity", [None, 0.1])
@pytest.mark.parametrize("frame", [1, 20])
def test_a_loopback_of_an_external_pose_is_refused_by_name(velocity: float | None, frame: int) -> None:
    """PX4 before 1.14 with MAV_ODOM_LP 1."""
    echo = {**_ODOMETRY, "frame_id": frame, "child_frame_id": 12, "estimator_type": 2,
            **dict.fromkeys(("vx", "vy", "vz"), velocity)}  # fmt: skip
    _, refused = messages.ODOMETRY.reader()(json.dumps(echo))
    assert isinstance(refused, Unusable)
    assert "external" in refused.reason
    assert ("without a velocity" in refused.reason) is (velocity is None)


def test_a_velocity_in_the_body_frame_is_refused_with_the_version_that_sends_it() -> None:
    _, refused = messages.ODOMETRY.reader()(json.dumps({**_ODOMETRY, "child_frame_id": 12}))
    assert "before PX4 1.14" in refused.reason


def test_a_stream_without_a_usable_message_is_reported_with_its_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = heard(monkeypatch)
    for _ in range(100):
        rig.hear("ODOMETRY", **{**_ODOMETRY, "vx": None})
    (text,) = rig.of(StatusText)
    assert text.text == "ODOMETRY arrives, none has a velocity"
    assert text.found_here
    assert EventFormatter().format_event(text) == (Level.ERROR, "link", text.text, "")


def test_a_foreign_imu_and_a_second_one_are_none(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = heard(monkeypatch)
    rig.say("MavlinkDirect", "HIGHRES_IMU", message({**_IMU, "time_usec": 10**12}, 197))
    assert rig.session.clock.offset_us is None  # and the clock does not follow it
    rig.hear("HIGHRES_IMU", **{**_IMU, "id": 1})
    assert rig.of(ImuSample) == []
    rig.hear("HIGHRES_IMU", **_IMU)
    (sample,) = rig.of(ImuSample)
    assert (sample.specific_force_frd, sample.rate_frd) == ((0.1, 0.2, -9.8), (0.3, 0.1, 0.0))
    assert rig.session.clock.offset_us == 5 - sample.received_us


def test_a_failsafe_and_a_landing_of_another_component_are_not_the_vehicles(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = heard(monkeypatch)
    for name, fields in (
        ("STATUSTEXT", {"severity": 2, "text": "failsafe", "id": 0}),
        ("EXTENDED_SYS_STATE", {"landed_state": 1}),
        ("HEARTBEAT", {"autopilot": 12, "base_mode": 1, "custom_mode": 4 << 16, "system_status": 5}),
        ("ESTIMATOR_STATUS", {"flags": 0, "pos_horiz_accuracy": 9.0}),
        ("SYS_STATUS", dict.fromkeys(_SENSORS, 1)),
    ):
        rig.say("MavlinkDirect", name, message(fields, 197))
    rig.say("Events", "events", SimpleNamespace(compid=197, log_level=2, message="failsafe"))
    assert rig.seen == []


# --- batteries ---------------------------------------------------------------------------------------------


def battery(number: int, volts: float, percent: int, function: int = 0) -> Fields:
    cells = [round(1000 * volts)] + [65535] * 9
    return {"id": number, "battery_function": function, "battery_remaining": percent, "voltages": cells}


FLIGHT_LOW, OTHER_FULL = battery(0, 9.0, 4), battery(1, 16.2, 95)
FLIGHT_FULL, RAIL = battery(0, 16.2, 95), battery(1, 5.0, 40)


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize(
    ("both", "judged", "others"),
    [
        ((FLIGHT_LOW, OTHER_FULL), (0, 9.0, 0.04), []),
        ((FLIGHT_FULL, RAIL), (0, 16.2, 0.95), [1]),
        ((FLIGHT_FULL, battery(1, 16.0, 30, function=4)), (0, 16.2, 0.95), [1]),  # a payload's
        ((battery(0, 15.0, 60), battery(1, 15.5, 20)), (1, 15.5, 0.2), []),
        ((battery(0, 12.0, 90), battery(1, 15.5, 50)), (0, 12.0, 0.9), []),  # the voltage says it first
        ((RAIL, battery(0, 6.0, 90)), (1, 5.0, 0.4), []),  # nothing that can fly: the worst of all
    ],
)
def test_the_worst_battery_that_flies_is_judged_in_any_order(
    monkeypatch: pytest.MonkeyPatch,
    both: tuple[Fields, Fields],
    judged: tuple[int, float, float],
    others: list[int],
    order: int,
) -> None:
    rig = heard(monkeypatch)
    for _ in range(2):
        for fields in both[::order]:
            rig.hear("BATTERY_STATUS", **fields)
    for status in rig.of(StatusSample)[1:]:  # no reading of the other one in between
        assert (status.battery_id, status.battery_v, status.battery_remaining) == judged
    assert [reading.id for reading in rig.session.batteries.other_batteries()] == others


def test_a_flight_battery_that_collapses_stays_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its voltage has been a flight battery's; a rail's never was."""
    rig = heard(monkeypatch)
    for fields in (FLIGHT_FULL, OTHER_FULL, battery(0, 5.0, 40)):
        rig.hear("BATTERY_STATUS", **fields)
    assert rig.of(StatusSample)[-1].battery_id == 0


def test_a_battery_that_is_taken_off_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = heard(monkeypatch)
    gone = {**battery(0, 9.0, -1), "voltages": [65535] * 10}
    for fields in (FLIGHT_LOW, OTHER_FULL, gone):
        rig.hear("BATTERY_STATUS", **fields)
    assert rig.of(StatusSample)[-1].battery_id == 1


@pytest.mark.parametrize(
    ("voltages", "more", "expected"),
    [
        ([4000, 4010, 4020, 4030], [], 16.06),  # cells
        ([16000], [], 16.0),  # all in the first
        ([65534, 4466], [], 70.0),  # more than fits into one
        ([4000] * 10, [4000, 4000, 0, 0], 48.0),
        ([], [], None),
    ],
)
def test_a_voltage_is_the_sum_of_what_is_known(
    voltages: list[int], more: list[int], expected: float | None
) -> None:
    fields = {**_BATTERY, "voltages": voltages + [65535] * (10 - len(voltages)), "voltages_ext": more}
    found = messages.BATTERY_STATUS.decode(json.dumps(fields))
    assert found.voltage_v == (None if expected is None else pytest.approx(expected))
    assert found.remaining == 0.8


# --- parts -------------------------------------------------------------------------------------------------


def say(rig: Rig, *parts: tuple[int, int, str]) -> list[str]:
    for number, chunk, text in parts:
        rig.hear("STATUSTEXT", severity=4, id=number, chunk_seq=chunk, text=text)
    return [text.text for text in rig.of(StatusText)]


LONG = "Critical battery level: switching to Land because "  # 50 bytes


def test_a_long_text_comes_in_parts_and_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(LONG) == 50
    parts = ((7, 0, LONG), (7, 1, LONG), (7, 2, "of it"))
    assert say(heard(monkeypatch), *parts) == [LONG + LONG + "of it"]
    assert say(heard(monkeypatch), (7, 0, LONG), (7, 1, "")) == [LONG.strip()]  # it ends where a part does


def test_a_text_that_lost_a_part_is_delivered_with_a_mark(monkeypatch: pytest.MonkeyPatch) -> None:
    assert say(heard(monkeypatch), (7, 0, LONG), (7, 2, "end")) == [LONG + "...end"]
    rig = heard(monkeypatch)
    assert say(rig, (7, 0, LONG), (8, 0, "another")) == [LONG + "...", "another"]
    rig = heard(monkeypatch)
    say(rig, (7, 0, LONG))
    for _ in range(2):  # seconds later
        rig.hear("HEARTBEAT", **ROWS["HEARTBEAT"].good)
    assert [text.text for text in rig.of(StatusText)] == [LONG + "..."]


def test_speeds_of_six_motors_come_in_two_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    rig.session.subscribe(SimpleNamespace(uses_esc=True), 6)  # type: ignore[arg-type]
    for time_us, index, rpm in (
        (5, 4, [9] * 4),  # its first part is lost
        (6, 0, [1, 2, 3, 4]),
        (7, 4, [9] * 4),  # of another moment
        (8, 0, [1, 2, 3, 4]),
        (8, 4, [5, 6, 0, 0]),
        (9, 3, [1, 2, 3, 4]),
    ):
        rig.hear("ESC_STATUS", time_usec=time_us, index=index, rpm=rpm)
    (found,) = rig.of(EscSample)
    assert (found.t_us, found.rpm) == (8, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0))


def test_a_group_about_motors_that_are_none_is_no_second_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight channels of a controller, four of them in use."""
    rig = heard(monkeypatch)
    for index in (0, 4):
        rig.hear("ESC_STATUS", time_usec=8, index=index, rpm=[1, 2, 3, 4])
    assert len(rig.of(EscSample)) == 1


# --- motor outputs -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stopped", "idle", "full", "name"),
    [(900.0, 1000.0, 2000.0, "PWM"), (0.0, 110.0, 1999.0, "DShot"), (0.0, 1.0, 8191.0, "UAVCAN")],
)
def test_the_same_throttle_comes_out_of_any_output_type(
    monkeypatch: pytest.MonkeyPatch, stopped: float, idle: float, full: float, name: str
) -> None:
    rig = heard(monkeypatch)
    zero = 1000.0 if name == "PWM" else 0.0
    for share in (-1.0, 0.0, 0.2, 0.5, 0.6, 0.95, 0.4):
        raw = stopped if share < 0.0 else max(idle, zero + share * (full - zero))
        rig.hear("ACTUATOR_OUTPUT_STATUS", time_usec=1, active=5, actuator=[raw] * 4 + [1500.0] + [0.0] * 27)
    found = rig.of(ActuatorSample)
    assert found[0].motors == (0.0,) * 4
    for sample, share in zip(found[3:], (0.5, 0.6, 0.95, 0.4), strict=True):
        assert sample.motors == (pytest.approx(share, abs=1e-6),) * 4
    assert rig.session.motor_outputs is not None
    assert rig.session.motor_outputs.scale is not None
    assert rig.session.motor_outputs.scale.name == name


@pytest.mark.parametrize("raw", [900.0, 1000.0, 0.0])
def test_an_idle_bank_in_flight_is_not_the_motors(monkeypatch: pytest.MonkeyPatch, raw: float) -> None:
    rig = heard(monkeypatch)
    outputs = {"time_usec": 1, "active": 8, "actuator": [raw] * 8 + [0.0] * 24}
    rig.hear("ACTUATOR_OUTPUT_STATUS", **outputs)
    assert rig.of(ActuatorSample)[-1].motors == (0.0,) * 4  # on the ground that is what motors do
    rig.hear("EXTENDED_SYS_STATE", landed_state=2)
    before = len(rig.of(ActuatorSample))
    for _ in range(30):
        rig.hear("ACTUATOR_OUTPUT_STATUS", **outputs)
    assert len(rig.of(ActuatorSample)) == before
    assert "another output bank" in rig.of(StatusText)[-1].text


def test_motors_that_have_turned_may_stop_in_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kill in the air: throttle 0 is a value then."""
    rig = heard(monkeypatch)
    rig.hear("EXTENDED_SYS_STATE", landed_state=2)
    for raw in (1500.0, 900.0):
        rig.hear("ACTUATOR_OUTPUT_STATUS", time_usec=1, active=4, actuator=[raw] * 4)
    assert rig.of(ActuatorSample)[-1].motors == (0.0,) * 4


def test_too_few_outputs_are_no_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch, {})
    rig.session.subscribe(SimpleNamespace(uses_esc=False), 6)  # type: ignore[arg-type]
    rig.hear("ACTUATOR_OUTPUT_STATUS", time_usec=7, active=4, actuator=[1500.0] * 4 + [0.0] * 28)
    assert rig.of(ActuatorSample) == []


def test_a_mode_of_another_autopilot_is_no_mode_of_px4() -> None:
    """ArduPilot's custom mode 4 is guided."""
    beat = {"autopilot": 3, "base_mode": 217, "custom_mode": 4, "system_status": 4}
    _, refused = messages.HEARTBEAT.reader()(json.dumps(beat))
    assert "ArduPilot" in refused.reason
    known = messages.HEARTBEAT.decode(json.dumps({**beat, "autopilot": 12, "custom_mode": 4 << 16 | 3 << 24}))
    assert (known.armed, known.hil, known.flight_mode) == (True, False, FlightMode.HOLD)
