"""The message table: every entry with a foreign sender, another instance, no values and a wrong scale."""

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
from dart_flight.base.streams import OPTIONAL, STREAMS
from dart_flight.recording.events import EventFormatter, Level
from dart_flight.vehicle import messages
from dart_flight.vehicle.messages import ENTRIES, MessageEntry, Unusable
from tests.vehicle.session_rig import MakeSession, SessionRig, message

Fields = dict[str, Any]


class Row(NamedTuple):
    """A good message of an entry and its bad variants; None if the message has no such variant."""

    good: Fields
    nothing: Fields  # marked as invalid
    other_scale: Fields | None = None
    other_instance: Fields | None = None


_NAN = None  # JSON has no NaN
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
        {"autopilot": 3},  # ArduPilot numbers other modes
    ),
    "CURRENT_MODE": Row(
        {"custom_mode": 6 << 16, "intended_custom_mode": 6 << 16, "standard_mode": 0}, {"custom_mode": 0}
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
        {"index": 4},  # a group without the first motor
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
    "PARAM_VALUE": Row(
        {"param_id": "MPC_XY_P", "param_index": 3, "param_count": 900, "param_value": 0.95, "param_type": 9},
        {"param_id": ""},
    ),
    "GPS_RAW_INT": Row({"fix_type": 6}, {"fix_type": 200}),
    "RC_CHANNELS": Row({"chancount": 8, "rssi": 200}, {"chancount": 0}),
}


class EntryRig:
    """A session that receives messages of one entry."""

    def __init__(self, rig: SessionRig, entry: MessageEntry) -> None:
        self.rig, self.name = rig, entry.message
        if entry.message not in rig.plugins["MavlinkDirect"].callbacks:
            rig.session.listen(entry, lambda value, _: rig.delivered.append(value))

    def send(self, fields: Fields, component: int = 1, system: int = 1) -> int:
        """Send a message; return the number of records or values it produces."""
        before = len(self.rig.delivered)
        self.rig.publish("MavlinkDirect", self.name, message(system, component, **fields))
        return len(self.rig.delivered) - before

    @property
    def usable(self) -> dict[tuple[int, int], int]:
        """Number of usable messages by system and component."""
        found: dict[tuple[int, int], int] = {}
        for (_, system, component, _), count in self.rig.session.senders.items():
            found[system, component] = found.get((system, component), 0) + count.usable
        return found


def decode(entry: MessageEntry, fields: Fields | str) -> Any:
    text = fields if isinstance(fields, str) else json.dumps(fields)
    return entry.reader()(text, lambda stamp_us: stamp_us)[1]


def test_every_table_entry_has_a_row() -> None:
    assert [entry.message for entry in ENTRIES] == list(ROWS)
    assert {entry.stream for entry in ENTRIES} >= {*STREAMS, *OPTIONAL}


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.message)
def test_only_messages_of_the_autopilots_component_are_used(rig: SessionRig, entry: MessageEntry) -> None:
    good, entry_rig = ROWS[entry.message].good, EntryRig(rig, entry)
    for component, system in ((197, 1), (154, 1), (0, 1), (1, 7)):
        assert entry_rig.send(good, component, system) == 0
        assert entry_rig.usable[system, component] == 0, "foreign messages are counted for `check`"
    assert entry_rig.send(good) > 0
    assert entry_rig.usable[1, 1] == 1


# The tests of batteries cover other batteries.
UNUSABLE = [
    (entry, variant)
    for entry in ENTRIES
    for variant in ("nothing", "other_scale", "other_instance")
    if getattr(ROWS[entry.message], variant) is not None
    and (entry.message, variant) != ("BATTERY_STATUS", "other_instance")
]


@pytest.mark.parametrize(
    ("entry", "variant"), UNUSABLE, ids=[f"{entry.message}-{variant}" for entry, variant in UNUSABLE]
)
def test_a_message_without_usable_values_produces_no_sample(
    rig: SessionRig, entry: MessageEntry, variant: str
) -> None:
    row, entry_rig = ROWS[entry.message], EntryRig(rig, entry)
    changes = getattr(row, variant)
    assert entry_rig.send({**row.good, **changes}) == 0
    assert entry_rig.usable[1, 1] == 0
    (count,) = entry_rig.rig.session.senders.values()
    assert count.reason
    if variant != "other_instance" and entry.message != "ACTUATOR_OUTPUT_STATUS":
        assert isinstance(decode(entry, {**row.good, **changes}), Unusable)
    assert entry_rig.send(row.good) > 0, "the next good message counts"


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.message)
def test_a_malformed_message_is_unusable(entry: MessageEntry) -> None:
    for text in ("", "null", "[]", "{}", '{"x":', '{"id": "a"}'):
        assert isinstance(decode(entry, text), Unusable)


@given(
    st.dictionaries(st.sampled_from([*_ODOMETRY]), st.none() | st.floats(-1e9, 1e9) | st.integers(-9, 300))
)
def test_decoded_odometry_has_only_finite_values(changes: Fields) -> None:
    found = decode(messages.ODOMETRY, {**_ODOMETRY, **changes})
    if not isinstance(found, Unusable):
        found, _ = found
        assert all(math.isfinite(v) and abs(v) <= 1e4 for v in (*found.position_ned, *found.velocity_ned))


# --- foreign senders ---------------------------------------------------------------------------------------


def test_visual_odometry_of_another_component_is_ignored(rig: SessionRig) -> None:
    turned = {**_ODOMETRY, "x": -1.2, "y": 1.9, "frame_id": 20, "child_frame_id": 12, "estimator_type": 2}
    for fields, component in ((turned, 197), (_ODOMETRY, 1), ({**_ODOMETRY, "x": 1.25}, 197)):
        rig.publish("MavlinkDirect", "ODOMETRY", message(1, component, **fields))
    (sample,) = rig.records_of(OdometrySample)
    assert sample.position_ned == (1.0, 2.0, -3.0)
    assert len(rig.records_of(EstimatorSample)) == 1  # the foreign reset counter is ignored too


@pytest.mark.parametrize("velocity", [None, 0.1])
@pytest.mark.parametrize("frame", [1, 20])
def test_a_loopback_of_an_external_pose_is_refused_with_its_reason(
    velocity: float | None, frame: int
) -> None:
    """PX4 before 1.14 sends it with MAV_ODOM_LP 1."""
    echo = {**_ODOMETRY, "frame_id": frame, "child_frame_id": 12, "estimator_type": 2,
            **dict.fromkeys(("vx", "vy", "vz"), velocity)}  # fmt: skip
    refused = decode(messages.ODOMETRY, echo)
    assert isinstance(refused, Unusable)
    assert "external" in refused.reason
    assert ("without a velocity" in refused.reason) is (velocity is None)


def test_a_body_frame_velocity_is_refused_with_the_px4_version_that_sends_it() -> None:
    refused = decode(messages.ODOMETRY, {**_ODOMETRY, "child_frame_id": 12})
    assert "before PX4 1.14" in refused.reason


def test_a_stream_without_a_usable_message_is_reported_with_its_reason(rig: SessionRig) -> None:
    for _ in range(100):
        rig.receive("ODOMETRY", **{**_ODOMETRY, "vx": None})
    (text,) = rig.records_of(StatusText)
    assert text.text == "ODOMETRY arrives, but no message is usable: the velocity is NaN"
    assert text.found_here
    assert EventFormatter().format_event(text) == (Level.ERROR, "link", text.text, "")


def test_a_foreign_imu_and_a_second_imu_are_ignored(rig: SessionRig) -> None:
    rig.publish("MavlinkDirect", "HIGHRES_IMU", message(1, 197, **{**_IMU, "time_usec": 10**12}))
    assert rig.session.clock.offset_us is None  # the clock does not follow the foreign IMU
    rig.receive("HIGHRES_IMU", **{**_IMU, "id": 1})
    assert rig.records_of(ImuSample) == []
    rig.receive("HIGHRES_IMU", **_IMU)
    (sample,) = rig.records_of(ImuSample)
    assert (sample.specific_force_frd, sample.rate_frd) == ((0.1, 0.2, -9.8), (0.3, 0.1, 0.0))
    assert rig.session.clock.offset_us == 5 - sample.received_us


def test_status_messages_of_another_component_are_ignored(rig: SessionRig) -> None:
    for name, fields in (
        ("STATUSTEXT", {"severity": 2, "text": "failsafe", "id": 0}),
        ("EXTENDED_SYS_STATE", {"landed_state": 1}),
        ("HEARTBEAT", {"autopilot": 12, "base_mode": 1, "custom_mode": 4 << 16, "system_status": 5}),
        ("ESTIMATOR_STATUS", {"flags": 0, "pos_horiz_accuracy": 9.0}),
        ("SYS_STATUS", dict.fromkeys(_SENSORS, 1)),
    ):
        rig.publish("MavlinkDirect", name, message(1, 197, **fields))
    rig.publish("Events", "events", SimpleNamespace(compid=197, log_level=2, message="failsafe"))
    assert rig.delivered == []


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
        ((FLIGHT_FULL, battery(1, 16.0, 30, function=4)), (0, 16.2, 0.95), [1]),  # of a payload
        ((battery(0, 15.0, 60), battery(1, 15.5, 20)), (1, 15.5, 0.2), []),
        ((battery(0, 12.0, 90), battery(1, 15.5, 50)), (0, 12.0, 0.9), []),  # low by its voltage
        ((RAIL, battery(0, 6.0, 90)), (1, 5.0, 0.4), []),  # no flight battery: the worst of all
    ],
)
def test_the_worst_flight_battery_is_reported_in_any_message_order(
    rig: SessionRig,
    both: tuple[Fields, Fields],
    judged: tuple[int, float, float],
    others: list[int],
    order: int,
) -> None:
    for _ in range(2):
        for fields in both[::order]:
            rig.receive("BATTERY_STATUS", **fields)
    for status in rig.records_of(StatusSample)[1:]:  # the other battery never appears in between
        assert (status.battery_id, status.battery_v, status.battery_remaining) == judged
    assert [reading.id for reading in rig.session.batteries.other_batteries()] == others


def test_a_collapsing_flight_battery_remains_a_flight_battery(rig: SessionRig) -> None:
    """It once had the voltage of a flight battery; a power rail never had."""
    for fields in (FLIGHT_FULL, OTHER_FULL, battery(0, 5.0, 40)):
        rig.receive("BATTERY_STATUS", **fields)
    assert rig.records_of(StatusSample)[-1].battery_id == 0


def test_a_removed_battery_is_forgotten(rig: SessionRig) -> None:
    gone = {**battery(0, 9.0, -1), "voltages": [65535] * 10}
    for fields in (FLIGHT_LOW, OTHER_FULL, gone):
        rig.receive("BATTERY_STATUS", **fields)
    assert rig.records_of(StatusSample)[-1].battery_id == 1


@pytest.mark.parametrize(
    ("voltages", "more", "expected"),
    [
        ([4000, 4010, 4020, 4030], [], 16.06),  # cells
        ([16000], [], 16.0),  # all in the first field
        ([65534, 4466], [], 70.0),  # more than one field can hold
        ([4000] * 10, [4000, 4000, 0, 0], 48.0),
        ([], [], None),
    ],
)
def test_a_battery_voltage_is_the_sum_of_the_known_fields(
    voltages: list[int], more: list[int], expected: float | None
) -> None:
    fields = {**_BATTERY, "voltages": voltages + [65535] * (10 - len(voltages)), "voltages_ext": more}
    found = decode(messages.BATTERY_STATUS, fields)
    assert found.voltage_v == (None if expected is None else pytest.approx(expected))
    assert found.remaining == 0.8


# --- messages in parts -------------------------------------------------------------------------------------


LONG = "Critical battery level: switching to Land because "  # 50 bytes
LATER = [("HEARTBEAT", ROWS["HEARTBEAT"].good)] * 2  # seconds later


def part(number: int, chunk: int, text: str) -> tuple[str, Fields]:
    return "STATUSTEXT", {"severity": 4, "id": number, "chunk_seq": chunk, "text": text}


@pytest.mark.parametrize(
    ("parts", "texts"),
    [
        ([part(7, 0, LONG), part(7, 1, LONG), part(7, 2, "of it")], [LONG + LONG + "of it"]),
        ([part(7, 0, LONG), part(7, 1, "")], [LONG.strip()]),  # ends exactly with a part
        ([part(7, 0, LONG), part(7, 2, "end")], [LONG + "...end"]),
        ([part(7, 0, LONG), part(8, 0, "another")], [LONG + "...", "another"]),
        ([part(7, 0, LONG), *LATER], [LONG + "..."]),
    ],
)
def test_the_parts_of_a_long_text_are_joined_with_an_ellipsis_for_a_lost_part(
    rig: SessionRig, parts: list[tuple[str, Fields]], texts: list[str]
) -> None:
    assert len(LONG) == 50
    for stream, fields in parts:
        rig.receive(stream, **fields)
    assert [text.text for text in rig.records_of(StatusText)] == texts


def test_speeds_of_six_motors_are_joined_from_two_messages(make_session: MakeSession) -> None:
    rig = make_session({}).subscribe(motors=6)
    for time_us, index, rpm in (
        (5, 4, [9] * 4),  # its first part is lost
        (6, 0, [1, 2, 3, 4]),
        (7, 4, [9] * 4),  # of another time
        (8, 0, [1, 2, 3, 4]),
        (8, 4, [5, 6, 0, 0]),
        (9, 3, [1, 2, 3, 4]),
    ):
        rig.receive("ESC_STATUS", time_usec=time_us, index=index, rpm=rpm)
    (found,) = rig.records_of(EscSample)
    assert (found.t_us, found.rpm) == (8, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0))


def test_speeds_of_unused_channels_produce_no_second_sample(rig: SessionRig) -> None:
    """The controller has eight channels, four of which are in use."""
    for index in (0, 4):
        rig.receive("ESC_STATUS", time_usec=8, index=index, rpm=[1, 2, 3, 4])
    assert len(rig.records_of(EscSample)) == 1


# --- motor outputs -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stopped", "idle", "full", "name"),
    [(900.0, 1000.0, 2000.0, "PWM"), (0.0, 110.0, 1999.0, "DShot"), (0.0, 1.0, 8191.0, "UAVCAN")],
)
def test_every_output_type_yields_the_same_throttle(
    rig: SessionRig, stopped: float, idle: float, full: float, name: str
) -> None:
    zero = 1000.0 if name == "PWM" else 0.0
    for share in (-1.0, 0.0, 0.2, 0.5, 0.6, 0.95, 0.4):
        raw = stopped if share < 0.0 else max(idle, zero + share * (full - zero))
        rig.receive(
            "ACTUATOR_OUTPUT_STATUS", time_usec=1, active=5, actuator=[raw] * 4 + [1500.0] + [0.0] * 27
        )
    found = rig.records_of(ActuatorSample)
    assert found[0].motors == (0.0,) * 4
    for sample, share in zip(found[3:], (0.5, 0.6, 0.95, 0.4), strict=True):
        assert sample.motors == (pytest.approx(share, abs=1e-6),) * 4
    assert rig.session.motor_outputs is not None
    assert rig.session.motor_outputs.scale is not None
    assert rig.session.motor_outputs.scale.name == name


@pytest.mark.parametrize("raw", [900.0, 1000.0, 0.0])
def test_an_idle_output_bank_in_flight_is_not_used_for_the_motors(rig: SessionRig, raw: float) -> None:
    outputs = {"time_usec": 1, "active": 8, "actuator": [raw] * 8 + [0.0] * 24}
    rig.receive("ACTUATOR_OUTPUT_STATUS", **outputs)
    assert rig.records_of(ActuatorSample)[-1].motors == (0.0,) * 4  # normal for motors on the ground
    rig.receive("EXTENDED_SYS_STATE", landed_state=2)
    before = len(rig.records_of(ActuatorSample))
    for _ in range(30):
        rig.receive("ACTUATOR_OUTPUT_STATUS", **outputs)
    assert len(rig.records_of(ActuatorSample)) == before
    assert "another output bank" in rig.records_of(StatusText)[-1].text


def test_motors_that_stop_in_flight_are_reported_at_throttle_zero(rig: SessionRig) -> None:
    """After a kill in the air, throttle 0 is valid."""
    rig.receive("EXTENDED_SYS_STATE", landed_state=2)
    for raw in (1500.0, 900.0):
        rig.receive("ACTUATOR_OUTPUT_STATUS", time_usec=1, active=4, actuator=[raw] * 4)
    assert rig.records_of(ActuatorSample)[-1].motors == (0.0,) * 4


def test_too_few_outputs_produce_no_sample(make_session: MakeSession) -> None:
    rig = make_session({}).subscribe(motors=6, uses_esc=False)
    rig.receive("ACTUATOR_OUTPUT_STATUS", time_usec=7, active=4, actuator=[1500.0] * 4 + [0.0] * 28)
    assert rig.records_of(ActuatorSample) == []


def test_a_mode_of_another_autopilot_is_refused() -> None:
    """ArduPilot's custom mode 4 is guided."""
    heartbeat = {"autopilot": 3, "base_mode": 217, "custom_mode": 4, "system_status": 4}
    refused = decode(messages.HEARTBEAT, heartbeat)
    assert "ArduPilot" in refused.reason
    known = decode(messages.HEARTBEAT, {**heartbeat, "autopilot": 12, "custom_mode": 4 << 16 | 3 << 24})
    assert (known.armed, known.hil, known.flight_mode) == (True, False, FlightMode.HOLD)
