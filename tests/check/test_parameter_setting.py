"""The command `parameters`: desired values with types and reasons; writing, reading back, restoring."""

import json
import lzma
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.check import parameter_setting as setting
from dart_flight.check.px4_parameters import evaluate_parameters
from dart_flight.check.wanted_parameters import (
    METADATA,
    RESTART,
    MetadataError,
    ParameterRow,
    ParameterState,
    list_differences,
    restart_names,
    wanted_parameters,
    with_lock_output,
)
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.parameter_file import (
    Parameter,
    PositionSource,
    Value,
    differences,
    format_parameters,
    load_parameters,
    to_float32,
)
from dart_flight.config.vehicle import packaged
from dart_flight.vehicle.downloads import DownloadError
from dart_flight.vehicle.ground_link import GroundLink, HeartbeatMode
from dart_flight.vehicle.vehicle_session import NoAnswerError, VehicleError

MOCAP = PositionSource.MOCAP
PRESENT = ParameterState.PRESENT
NOW = datetime(2026, 11, 26, 5, 0, 0, tzinfo=UTC)


def mission(**changes: object) -> Mission:
    plain = load_mission(packaged("missions", "paper_single_wall.yaml"))
    keys = {key.replace("__", "."): value for key, value in changes.items()}
    return msgspec.structs.replace(plain, vehicle=plain.vehicle.replace(keys)) if keys else plain


class FakeLink(GroundLink):
    """A vehicle that ignores writes of `stubborn` parameters and rejects those of `refusing` ones."""

    def __init__(self, values: dict[str, Value], *, metadata: bytes = b"") -> None:
        self.values, self.metadata = values, metadata
        self._system_id = 1
        self.stubborn: set[str] = set()
        self.refusing: set[str] = set()
        self.mute: set[str] = set()
        self.limits: dict[str, Value] = {}  # values after a while
        self.lost_after: int | None = None  # number of writes
        self.writes = 0

    def heartbeat_mode(self) -> HeartbeatMode | None:
        return HeartbeatMode(armed=False, hil=False)

    def version(self) -> str:
        return "1.18.0"

    def newest(self, entry: object, seconds: float) -> str:
        return "rtk_fixed"

    def read_parameters(
        self, names: Iterable[str], progress: object = None, unanswered: set[str] | None = None
    ) -> dict[str, Value]:
        names = list(names)
        if unanswered is not None:
            unanswered |= self.mute.intersection(names)
        return {name: self.values[name] for name in names if name in self.values and name not in self.mute}

    def wait(self, seconds: float) -> None:
        self.values |= {name: value for name, value in self.limits.items() if name in self.values}

    def write_parameter(self, name: str, value: Value) -> None:
        if self.writes == self.lost_after:
            raise NoAnswerError("the vehicle stopped responding", source="udpin://test")
        self.writes += 1
        assert type(self.values[name]) is type(value), name
        if name in self.refusing:
            raise VehicleError(f"{name} was not set")
        if name not in self.stubborn:
            self.values[name] = value

    def read_file(self, path: str) -> bytes:
        assert path == METADATA
        if not self.metadata:
            raise DownloadError("no such file")
        return self.metadata


def default_vehicle() -> dict[str, Value]:
    """Return every wanted parameter with a different value of PX4's type."""
    return {
        name: p.value + (7 if isinstance(p.value, int) else 7.5)
        for name, p in wanted_parameters(mission(), MOCAP).items()
        if not p.is_absent_in((1, 18))
    }


def read_vehicle(
    link: GroundLink, configured: Mission | None = None, restored: setting.RestoredFile | None = None
) -> setting.ParameterReading:
    return setting.read_differences(link, configured or mission(), MOCAP, restored)


def test_measured_values_override_the_files() -> None:
    measured = mission(mocap__delay_ms=23.5, imu__position_m=[0.02, 0.0, -0.01])
    wanted = wanted_parameters(measured, MOCAP)
    assert wanted["EKF2_EV_DELAY"].value == 23.5
    assert "mocap.delay_ms" in wanted["EKF2_EV_DELAY"].reason
    assert [wanted[f"EKF2_IMU_POS_{axis}"].value for axis in "XYZ"] == [0.02, 0.0, -0.01]
    # Without motion capture there is no pose delay.
    assert "EKF2_EV_DELAY" not in wanted_parameters(measured, PositionSource.RTK)
    assert "measure yours" in wanted_parameters(mission(), MOCAP)["EKF2_EV_DELAY"].reason


def test_px4s_tilt_limit_is_never_below_the_guards() -> None:
    assert wanted_parameters(mission(guard__tilt_deg=70.0), None)["FD_FAIL_R"].value == 70
    assert wanted_parameters(mission(guard__tilt_deg=40.0), None)["FD_FAIL_R"].value == 60


@pytest.mark.parametrize("source", list(PositionSource))
def test_a_vehicle_with_the_wanted_values_is_go(source: PositionSource) -> None:
    configured = mission(mocap__delay_ms=20.0)
    values = {
        p.renamed or p.name: p.value
        for p in wanted_parameters(configured, source).values()
        if p.renamed is not None or not p.is_absent_in((1, 18))
    }
    values |= {"COM_LKDOWN_TKO": 5.0, "COM_DISARM_LAND": 2.0}
    found = evaluate_parameters(configured, values, source, (1, 18))
    assert [f for f in found if not f.go or f.remark] == []
    assert list_differences(wanted_parameters(configured, source), values, ()) == []


def test_the_locks_output_keeps_the_bits_of_other_pins() -> None:
    configured = mission(lock__driver="px4")
    bank, pin = configured.vehicle.lock.px4.bank, configured.vehicle.lock.px4.pin  # type: ignore[union-attr]
    name, bit = f"PWM_{bank}_REV", 1 << (pin - 1)
    wanted = with_lock_output(configured, {}, {name: 0b11111})
    assert wanted[name].value == 0b11111 & ~bit
    assert with_lock_output(mission(), {}, {}) == {}  # the lock has another driver


def test_rows_have_the_vehicles_type_and_the_files_reason() -> None:
    wanted = {
        "A": Parameter("A", 4, "why a"),
        "B": Parameter("B", 2.0, "why b"),
        "C": Parameter("C", 1, "why c"),
        "D": Parameter("D", 1.0, "", tolerance=0.1),
    }
    rows = list_differences(wanted, {"A": 0.0, "B": 3, "D": 1.05}, {"B"})
    assert rows == [
        ParameterRow("A", PRESENT, 0.0, 4.0, "why a", False),
        ParameterRow("B", PRESENT, 3, 2, "why b", True),
        ParameterRow("C", ParameterState.ABSENT, None, 1, "why c", False),
    ]
    assert [type(row.wanted) for row in rows] == [float, int, int]


def test_restarts_follow_px4s_metadata_or_the_packaged_list() -> None:
    tree = {"parameters": [{"name": "NAV_RCL_ACT", "rebootRequired": True}, {"name": "SYS_HAS_GPS"}]}
    metadata = lzma.compress(json.dumps(tree).encode())
    assert restart_names(metadata) == {"NAV_RCL_ACT"}
    own = read_vehicle(FakeLink(default_vehicle(), metadata=metadata))
    assert {row.name for row in own.rows if row.restart} == {"NAV_RCL_ACT"}
    assert own.restart_source == "the parameter metadata of this PX4"
    for broken in (b"", b"xyz", lzma.compress(b"[]"), lzma.compress(b'{"parameters": [{}, 1]}')):
        listed = read_vehicle(FakeLink(default_vehicle(), metadata=broken))
        assert {row.name for row in listed.rows if row.restart} == RESTART & set(default_vehicle())
        assert str(listed.restart_source).startswith("@reboot_required")
    with pytest.raises(MetadataError):
        restart_names(b"xyz")


def test_written_parameters_are_read_back_and_can_be_restored(tmp_path: Path) -> None:
    before = default_vehicle()
    link = FakeLink(dict(before))
    found = read_vehicle(link)
    assert {row.name for row in found.writable} == set(before)
    saved = setting.save_previous(found.writable, tmp_path, "a vehicle", 1, NOW)
    assert saved.name == "px4_before_2026-11-26_050000.params"
    assert setting.write_rows(link, found.writable).refused == {}
    assert read_vehicle(link).writable == []
    restoring = read_vehicle(link, restored=setting.load_restored(saved))
    assert {row.why for row in restoring.rows} == {f"as in {saved.name}"}
    assert setting.write_rows(link, restoring.writable).written == [row.name for row in restoring.rows]
    assert link.values == pytest.approx(before, rel=1e-7)
    with pytest.raises(InputError, match="exists"):
        setting.save_previous(
            found.writable, tmp_path, "a vehicle", 1, NOW
        )  # a saved file is never overwritten


def test_a_parameter_that_the_vehicle_rejects_is_named() -> None:
    link = FakeLink(default_vehicle())
    link.stubborn, link.refusing = {"NAV_RCL_ACT"}, {"FD_FAIL_P"}
    refused = setting.write_rows(link, read_vehicle(link).writable)
    assert refused.refused == {
        "FD_FAIL_P": "FD_FAIL_P was not set",
        "NAV_RCL_ACT": "NAV_RCL_ACT is 10 after writing 3",
    }


def test_a_missing_answer_is_neither_a_value_nor_an_absence() -> None:
    link = FakeLink(default_vehicle())
    link.mute = {"FD_FAIL_P", "MAN_OVERRIDE_SPD"}  # older builds lack the second
    found = read_vehicle(link)
    assert set(found.names(ParameterState.NOT_ANSWERED)) == link.mute
    assert link.mute.isdisjoint(row.name for row in found.writable)
    link.mute = {"EKF2_EV_CTRL"}
    unknown = setting.read_differences(link, mission(), None, None)
    assert unknown.position_from is None
    assert unknown.states["EKF2_EV_CTRL"] is ParameterState.NOT_ANSWERED
    assert "the position source is unknown" in unknown.remarks[0]


def test_a_value_that_px4_limits_later_is_not_written() -> None:
    link = FakeLink(default_vehicle())
    link.limits = {"MPC_XY_P": 2.0}
    report = setting.write_rows(link, read_vehicle(link).writable)
    assert report.refused == {"MPC_XY_P": "MPC_XY_P is 2 after writing 0.95"}
    assert "MPC_XY_P" not in report.written


@pytest.mark.parametrize("writes", [0, 6])
def test_a_lost_link_reports_what_was_written(writes: int) -> None:
    link = FakeLink(default_vehicle())
    link.lost_after = writes
    rows = read_vehicle(link).writable
    report = setting.write_rows(link, rows)
    assert report.written == [row.name for row in rows[:writes]]
    assert "stopped responding" in str(report.problem)


def test_values_of_one_flight_controller_are_restored_only_on_request(tmp_path: Path) -> None:
    path = tmp_path / "of_seven.params"
    own: dict[str, Value] = {
        "MAV_SYS_ID": 7,
        "CAL_ACC0_ID": 2490378,
        "CAL_MAG1_XOFF": 0.75,
        "TC_A0_X3_0": 1.0e-10,
        "SENS_BOARD_X_OFF": 1.5,
        "SENS_GPS0_ID": 2490379,
        "LND_FLIGHT_T_LO": 77,
    }
    path.write_text(format_parameters({**own, "CAL": 1, "SENS_BOARD_ROT": 8, "MPC_XY_P": 0.95}, [], 7))
    part = setting.load_restored(path)
    assert list(part.parameters) == ["CAL", "SENS_BOARD_ROT", "MPC_XY_P"]
    assert all(name in part.remarks[0] for name in own)
    assert set(setting.load_restored(path, everything=True).parameters) == {*own, *part.parameters}
    remarks = read_vehicle(FakeLink({"CAL": 1}), restored=part).remarks
    assert remarks[-1] == "the file is from vehicle 7; this vehicle has system id 1"
    path.write_text(format_parameters(own, []))
    with pytest.raises(InputError, match="--all"):
        setting.load_restored(path)


@pytest.mark.parametrize(
    ("mode", "problem"),
    [
        (HeartbeatMode(armed=True, hil=False), "the vehicle is armed: disarm it first"),
        (
            HeartbeatMode(armed=False, hil=False, not_px4="the autopilot is 3"),
            "it is unknown whether the vehicle is disarmed: the autopilot is 3",
        ),
        (None, "the vehicle sends no heartbeat"),
    ],
)
def test_writing_requires_a_vehicle_that_is_known_to_be_disarmed(
    mode: HeartbeatMode | None, problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = FakeLink({})
    link.require_disarmed()
    monkeypatch.setattr(link, "heartbeat_mode", lambda: mode)
    with pytest.raises(VehicleError, match=problem):
        link.require_disarmed()


def test_a_parameter_of_another_version_is_skipped_or_read_by_its_new_name() -> None:
    values: dict[str, Value] = {"EKF2_EV_CTRL": 0, "EKF2_GPS_CTRL": 7, "SENS_GPS0_DELAY": 80.0}
    found = setting.read_differences(FakeLink(values), mission(), None, None)
    assert found.position_from is PositionSource.RTK  # reported by its receiver
    names = {row.name for row in found.rows}
    assert "SENS_GPS0_DELAY" in names
    assert not {"EKF2_GPS_DELAY", "COM_RC_OVERRIDE", "COM_IMB_PROP_ACT"} & names


def test_configured_motion_capture_determines_the_position_source() -> None:
    configured = mission(mocap__url="optitrack://127.0.0.1/dart")
    values: dict[str, Value] = {"EKF2_EV_CTRL": 0, "EKF2_GPS_CTRL": 7}
    assert setting.read_differences(FakeLink(values), configured, None, None).position_from is MOCAP


NAMES = st.from_regex(r"[A-Z][A-Z0-9_]{0,15}", fullmatch=True)
FLOATS = st.floats(width=32, allow_nan=False, allow_infinity=False)
INTS = st.integers(-(2**31), 2**31 - 1)


@given(st.dictionaries(NAMES, st.one_of(INTS, FLOATS), min_size=1))
def test_a_written_parameter_file_is_read_back_unchanged(
    tmp_path_factory: pytest.TempPathFactory, values: dict[str, Value]
) -> None:
    path = tmp_path_factory.mktemp("params") / "some.params"
    path.write_text(format_parameters(values, ["a vehicle"]))
    found = load_parameters(path)
    assert {name: type(p.value) for name, p in found.items()} == {n: type(v) for n, v in values.items()}
    assert differences(found, values) == []
    assert all(to_float32(p.value) == values[name] or p.value == values[name] for name, p in found.items())
