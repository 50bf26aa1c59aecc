"""`check`: every defect of a mission or vehicle is a named no-go, which only its name overrules."""

import json
import math
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.motor_outputs import DSHOT, PWM, OutputScale
from dart_flight.base.records import Record, TruthContact, TruthSample
from dart_flight.check.findings import CheckFinding, decide
from dart_flight.check.px4_parameters import (
    PARAMETERS,
    evaluate_claim,
    evaluate_parameters,
    evaluate_position,
    parameter_names,
    position_source,
)
from dart_flight.check.telemetry_check import (
    evaluate_battery,
    evaluate_motor_outputs,
    evaluate_rates,
    evaluate_resting_force,
    evaluate_sources,
    evaluate_systems,
    motor_output_names,
)
from dart_flight.check.vehicle_check import evaluate_lock, evaluate_mode, evaluate_observation
from dart_flight.check.wanted_parameters import IMU_POSITION
from dart_flight.cli import main
from dart_flight.cli.check_command import show
from dart_flight.cli.terminal import messages
from dart_flight.config.document import Document, InputError
from dart_flight.config.mission import Mission, parse_mission
from dart_flight.config.mission_file import BoundsSpec, CollisionPrediction
from dart_flight.config.parameter_file import PositionSource, vehicle_parameters
from dart_flight.config.vehicle import LockDriver
from dart_flight.lock.drivers.px4_output import required_parameters
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import as_rehearsal, load_flyable, with_driver
from dart_flight.vehicle.ground_link import HeartbeatMode, Observation, Source
from dart_flight.vehicle.messages import BatteryReading
from dart_flight.vehicle.vehicle_session import Sender
from tests.flights.test_embedded_flights import simulated_vehicle
from tests.mission_findings import check_mission
from tests.real_time import TooSlow, run_within

ROOT = Path(__file__).parents[2]
DUAL = (ROOT / "missions/paper_dual_collision.yaml").read_text()


def mission(old: str = "", new: str = "") -> Mission:
    assert old in DUAL
    return parse_mission(Document(DUAL.replace(old, new, 1), str(ROOT / "missions/x.yaml")))


def mocap_mission(delay_ms: float | None = 10.0) -> Mission:
    """Return the mission of a vehicle with a measured pose delay."""
    plain = mission()
    return msgspec.structs.replace(plain, vehicle=plain.vehicle.replace({"mocap.delay_ms": delay_ms}))


def no_goes(findings: Iterable[CheckFinding]) -> list[str]:
    return [f.item for f in findings if not f.go]


def test_the_missions_in_the_repository_are_go() -> None:
    for path in sorted((ROOT / "missions").glob("*.yaml")):
        assert main(["check", str(path)]) == 0


@pytest.mark.parametrize(
    ("old", "new", "item"),
    [
        ("peak_force_n: 150.0", "peak_force_n: 12.0", "force_1"),
        ("normal_m_s: -0.6, tangential_m_s: 0.5", "normal_m_s: -0.15, tangential_m_s: 0.125", "force_1"),
        ("goal: {position_m: [1.0, -0.5]", "goal: {position_m: [1.0, -1.0]", "goal_clearance"),
        ("y: [-1.6, 2.0]", "y: [-1.05, 2.0]", "wall_bounds"),
        ("alpha_m_per_n: [0.12, 0.025]", "alpha_m_per_n: [0.01, 0.025]", "recovery_1"),
    ],
)
def test_a_mission_beyond_a_limit_is_a_no_go(old: str, new: str, item: str) -> None:
    assert item in no_goes(check_mission(mission(old, new)))


def test_a_run_up_without_room_is_a_no_go() -> None:
    tight = msgspec.structs.replace(
        mission(), start=(0.9, -0.9), bounds=BoundsSpec((0.85, 2.2), (-1.6, 2), (0.3, 2))
    )
    assert "approach_1" in no_goes(check_mission(tight))


def test_a_lock_without_time_to_switch_is_a_no_go() -> None:
    plain = mission()
    first, second = plain.collisions
    predicted = {"normal_m_s": -0.6, "tangential_m_s": 0.5, "peak_force_n": 20.0, "contact_time_s": 0.12}
    first_prediction = {"t_s": 2.0, "position_m": (0.9, -1.1), **predicted}
    second_prediction = {"t_s": 2.3, "position_m": (1.65, -0.8), **predicted}
    with_times = [
        msgspec.structs.replace(c, predicted=msgspec.convert(p, CollisionPrediction))
        for c, p in ((first, first_prediction), (second, second_prediction))
    ]
    rushed = msgspec.structs.replace(plain, collisions=tuple(with_times))
    assert "servo_2" in no_goes(check_mission(rushed))


@pytest.mark.parametrize(
    ("finding", "points"),
    [
        (CheckFinding("NAV_RCL_ACT", False, ""), True),
        (CheckFinding("EKF2_EV_DELAY", True, "", remark=True), True),
        (CheckFinding("NAV_RCL_ACT", True, ""), False),
        (CheckFinding("battery", False, ""), False),
    ],
)
def test_a_wrong_parameter_prints_a_hint_to_the_command(
    finding: CheckFinding, points: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    show(decide(mission(), [finding]), messages())
    assert ("dart-flight parameters" in capsys.readouterr().err) is points


def test_only_a_no_go_can_be_overruled() -> None:
    weak = mission("peak_force_n: 150.0", "peak_force_n: 12.0")
    findings = check_mission(weak)
    assert not decide(weak, findings).go
    report = decide(weak, findings, ["force_1"])
    assert report.go
    assert [f.item for f in report.findings if f.overruled] == ["force_1"]
    with pytest.raises(InputError, match="force_1"):
        decide(weak, findings, ["places"])


def test_a_no_go_exits_with_status_1_unless_it_is_overruled(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "m.yaml"
    text = DUAL.replace("../configs", str(ROOT / "configs")).replace(
        "peak_force_n: 150.0", "peak_force_n: 12"
    )
    path.write_text(text)
    assert main(["check", str(path), "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["go"] is False
    assert "force_1" in [f["item"] for f in report["findings"] if not f["go"]]
    assert main(["check", str(path), "--overrule", "force_1"]) == 0
    assert main(["check", str(path), "--overrule", "force_9"]) == 2


V1_16, V1_18 = (1, 16), (1, 18)


def shipped(version: tuple[int, int]) -> dict[str, float]:
    """Return the values that the packaged files set on a vehicle of this PX4 version."""
    wanted = vehicle_parameters(PositionSource.MOCAP).values()
    return {p.name: float(p.value) for p in wanted if not p.is_absent_in(version)}


GOOD = {
    **shipped(V1_16),
    "COM_OF_LOSS_T": 1.0,
    "COM_LKDOWN_TKO": 3.0,
    "COM_DISARM_LAND": 2.0,
    "SYS_HITL": 0.0,
}


def test_the_heartbeat_of_a_vehicle_in_hitl_mode_is_a_no_go() -> None:
    assert evaluate_mode(HeartbeatMode(armed=False, hil=False)) == evaluate_mode(None) == []
    (found,) = evaluate_mode(HeartbeatMode(armed=False, hil=True))
    assert (found.go, found.item) == (False, "hil_mode")


def remarks(findings: list[CheckFinding]) -> list[str]:
    return [f.item for f in findings if f.remark]


def test_the_packaged_parameters_are_go_without_a_remark() -> None:
    findings = evaluate_parameters(mocap_mission(), GOOD, PositionSource.MOCAP)
    assert not no_goes(findings)
    assert not remarks(findings)
    assert (set(PARAMETERS) - {"MAN_OVERRIDE_SPD"}) | {"EKF2_EV_DELAY"} == {f.item for f in findings}
    assert all(len(f.message.split()) >= 3 for f in findings)


NEWER = GOOD | shipped(V1_18)
for dropped in ("COM_RC_OVERRIDE", "COM_IMB_PROP_ACT", "COM_LKDOWN_TKO"):
    NEWER.pop(dropped)


@pytest.mark.parametrize("version", [V1_18, None])
def test_a_version_with_renamed_and_dropped_parameters_is_go(version: tuple[int, int] | None) -> None:
    """v1.18 has MAN_OVERRIDE_SPD instead of COM_RC_OVERRIDE, no COM_IMB_PROP_ACT, no COM_LKDOWN_TKO."""
    findings = evaluate_parameters(mocap_mission(), NEWER, PositionSource.MOCAP, version)
    assert not no_goes(findings)
    assert not remarks(findings)
    assert {"MAN_OVERRIDE_SPD"} == {f.item for f in findings} - set(GOOD)
    assert not {"COM_RC_OVERRIDE", "COM_IMB_PROP_ACT"} & {f.item for f in findings}
    unable = evaluate_parameters(
        mission(), {**NEWER, "MAN_OVERRIDE_SPD": -1.0}, PositionSource.MOCAP, version
    )
    assert no_goes(unable) == ["MAN_OVERRIDE_SPD"]


@pytest.mark.parametrize("name", ["COM_RC_OVERRIDE", "COM_IMB_PROP_ACT"])
def test_an_unread_parameter_that_the_version_has_is_a_no_go(name: str) -> None:
    missing = {n: value for n, value in GOOD.items() if n != name}
    assert no_goes(evaluate_parameters(mission(), missing, PositionSource.MOCAP, V1_16)) == [name]
    without_both = {n: v for n, v in missing.items() if n not in ("COM_RC_OVERRIDE", "COM_IMB_PROP_ACT")}
    assert set(no_goes(evaluate_parameters(mission(), without_both, PositionSource.MOCAP))) == {
        "COM_RC_OVERRIDE",
        "COM_IMB_PROP_ACT",
        "MAN_OVERRIDE_SPD",
    }


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("COM_OF_LOSS_T", 10.0),
        ("COM_OBL_RC_ACT", 3.0),
        ("COM_OBL_RC_ACT", 7.0),
        ("COM_RC_OVERRIDE", 1.0),
        ("NAV_RCL_ACT", 2.0),
        ("COM_IMB_PROP_ACT", 1.0),
        ("FD_FAIL_R", 30.0),
        ("IMU_GYRO_RATEMAX", 100.0),
        ("MPC_XY_P", 1.5),
    ],
)
def test_a_dangerous_parameter_is_a_no_go(name: str, value: float) -> None:
    findings = evaluate_parameters(mocap_mission(), {**GOOD, name: value}, PositionSource.MOCAP)
    assert no_goes(findings) == [name]
    assert [f.item for f in findings].count(name) == 1


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("COM_FAIL_ACT_T", 5.0, "COM_FAIL_ACT_T is 5, wanted 0: Land at once"),
        ("EKF2_GPS_CTRL", 7.0, "wanted 0: No GPS in the room"),
        (
            "COM_OBL_RC_ACT",
            5.0,
            "on loss of offboard setpoints: hold; recommended 4, not 5: If the companion computer is lost",
        ),
        ("COM_RC_OVERRIDE", 2.0, "sticks override offboard; recommended 3, not 2"),
        ("IMU_GYRO_RATEMAX", 400.0, "at up to 400 Hz; recommended 800"),
    ],
)
def test_a_harmless_difference_is_a_remark_with_the_files_reason(
    name: str, value: float, message: str
) -> None:
    findings = evaluate_parameters(mocap_mission(), {**GOOD, name: value}, PositionSource.MOCAP)
    assert not no_goes(findings)
    assert remarks(findings) == [name]
    says = next(f.message for f in findings if f.item == name)
    assert message in says
    assert vehicle_parameters(PositionSource.MOCAP)[name].reason in says


def _delay_finding(actual_ms: float, measured_ms: float | None) -> CheckFinding:
    findings = evaluate_parameters(
        mocap_mission(measured_ms), {**GOOD, "EKF2_EV_DELAY": actual_ms}, PositionSource.MOCAP
    )
    (found,) = (f for f in findings if f.item == "EKF2_EV_DELAY")
    return found


@given(st.floats(0.0, 300.0), st.floats(0.0, 300.0))
def test_a_pose_delay_far_from_the_measured_one_is_a_no_go(actual_ms: float, measured_ms: float) -> None:
    found = _delay_finding(actual_ms, measured_ms)
    assert found.go is (abs(actual_ms - measured_ms) <= 30.0)
    assert not found.remark
    if not found.go:
        assert "limit 30 ms" in found.message
        assert f"set EKF2_EV_DELAY to {measured_ms:g}" in found.message


@pytest.mark.parametrize(
    ("actual_ms", "message"),
    [(10.0, "10 ms;"), (150.0, "wanted 10: Age of an arriving pose, milliseconds; measure yours")],
)
def test_an_unmeasured_pose_delay_is_a_remark(actual_ms: float, message: str) -> None:
    found = _delay_finding(actual_ms, None)
    assert found.go
    assert found.remark
    assert message in found.message
    assert "mocap.delay_ms is not set" in found.message


@pytest.mark.parametrize("source", [PositionSource.RTK, PositionSource.PLAIN, None])
def test_the_pose_delay_is_ignored_without_motion_capture(source: PositionSource | None) -> None:
    findings = evaluate_parameters(mocap_mission(), {**GOOD, "EKF2_EV_DELAY": 300.0}, source)
    assert "EKF2_EV_DELAY" not in {f.item for f in findings}


def test_the_imu_position_is_compared_with_the_configuration() -> None:
    """A difference between PX4's parameters and `imu.position_m` is a remark that names both values."""
    names = dict.fromkeys(IMU_POSITION, 0.0)
    assert set(IMU_POSITION) <= set(parameter_names())
    as_configured = evaluate_parameters(mission(), {**GOOD, **names}, PositionSource.MOCAP)
    assert not [f for f in as_configured if f.item in IMU_POSITION]
    assert not no_goes(as_configured)
    moved = evaluate_parameters(mission(), {**GOOD, **names, "EKF2_IMU_POS_Y": 0.03}, PositionSource.MOCAP)
    (found,) = [f for f in moved if f.item in IMU_POSITION]
    assert (found.item, found.remark) == ("EKF2_IMU_POS_Y", True)
    assert "0.03 m on the vehicle, 0 m in imu.position_m" in found.message
    assert not no_goes(moved)


def test_an_unread_parameter_is_a_no_go_if_dangerous_and_a_remark_otherwise() -> None:
    silent = evaluate_parameters(mission(), {}, PositionSource.RTK)
    assert set(no_goes(silent)) == set(PARAMETERS)
    assert set(remarks(silent)) == set(vehicle_parameters(PositionSource.RTK)) - set(no_goes(silent))


def test_every_compared_parameter_is_read() -> None:
    names = parameter_names()
    assert len(names) == len(set(names))
    for source in PositionSource:
        assert set(vehicle_parameters(source)) <= set(names)


@pytest.mark.parametrize(
    ("values", "fix", "source"),
    [
        ({"EKF2_EV_CTRL": 11.0, "EKF2_GPS_CTRL": 0.0}, None, PositionSource.MOCAP),
        ({"EKF2_EV_CTRL": 11.0, "EKF2_GPS_CTRL": 7.0}, "fix_3d", PositionSource.MOCAP),
        ({"EKF2_EV_CTRL": 0.0, "EKF2_GPS_CTRL": 7.0}, "rtk_fixed", PositionSource.RTK),
        ({"EKF2_EV_CTRL": 0.0, "EKF2_GPS_CTRL": 7.0}, "rtk_float", PositionSource.PLAIN),
        ({"EKF2_EV_CTRL": 0.0, "EKF2_GPS_CTRL": 7.0}, None, PositionSource.PLAIN),
        ({"EKF2_EV_CTRL": 8.0, "EKF2_GPS_CTRL": 2.0}, "rtk_fixed", None),  # yaw and height only
        ({}, None, None),
    ],
)
def test_the_position_source_follows_from_parameters_and_fix(
    values: dict[str, float], fix: str | None, source: PositionSource | None
) -> None:
    assert position_source(values, fix) is source


@pytest.mark.parametrize(
    ("found", "fix", "claimed", "go", "message"),
    [
        (PositionSource.MOCAP, None, None, True, "motion capture"),
        (PositionSource.MOCAP, None, PositionSource.RTK, False, "--position-from is rtk, but"),
        (PositionSource.RTK, "rtk_fixed", None, True, "GPS, rtk fixed"),
        (PositionSource.RTK, "rtk_fixed", PositionSource.MOCAP, False, "comes from GPS (rtk fixed)"),
        (PositionSource.PLAIN, "fix_3d", None, False, "a mission with walls needs RTK, motion capture or"),
        (PositionSource.PLAIN, "rtk_float", PositionSource.RTK, False, "comes from GPS (rtk float)"),
        (None, None, None, False, "neither motion capture"),
    ],
)
def test_the_position_must_be_accurate_enough_for_a_wall(
    found: PositionSource | None, fix: str | None, claimed: PositionSource | None, go: bool, message: str
) -> None:
    (finding,) = evaluate_position(mission(), found, fix, claimed)
    assert (finding.item, finding.go) == ("position_source", go)
    assert message in finding.message


def test_a_surveyed_frame_is_a_no_go_with_gps() -> None:
    moved = msgspec.structs.replace(mission(), start=(0.5, 0.0))
    assert no_goes(evaluate_claim(moved, PositionSource.RTK)) == ["frame"]
    assert no_goes(evaluate_claim(moved, PositionSource.MOCAP)) == []


def test_plain_gps_is_a_no_go_without_a_vehicle(capsys: pytest.CaptureFixture[str]) -> None:
    path = str(ROOT / "missions/paper_single_wall.yaml")
    assert main(["check", path, "--position-from", "plain"]) == 1
    assert "needs RTK, motion capture or" in capsys.readouterr().err
    assert main(["check", path, "--position-from", "plain", "--overrule", "position_source"]) == 0
    assert main(["check", path, "--position-from", "rtk"]) == 0


RATES = {"imu": 240.0, "attitude": 120.0, "odometry": 120.0, "actuator": 120.0}
OBSERVED = Observation("1.16.0", RATES, 15.6, 0.9, True)


def telemetry_findings(observed: Observation, **values: float) -> dict[str, CheckFinding]:
    findings = [
        *evaluate_observation(observed),
        *evaluate_rates(observed, values),
        *evaluate_sources(observed),
        evaluate_battery(mission(), observed),
        *evaluate_resting_force(observed),
        *evaluate_motor_outputs(mission(), observed, values),
    ]
    return {finding.item: finding for finding in findings}


@pytest.mark.parametrize(
    ("systems", "station", "says"),
    [
        (None, 255, None),
        ((1, 1), 255, None),
        ((7, 7), 255, None),
        ((2, 1), 255, "sends as system 1, the vehicle is system 2"),
        ((7, 7), 7, "both system 7"),
    ],
)
def test_the_system_ids_must_let_the_buttons_through(
    systems: tuple[int, int] | None, station: int, says: str | None
) -> None:
    plain = load_flyable(ROOT / "missions/square.yaml")
    vehicle = plain.vehicle.replace({"ground_station.system_id": station})
    found = evaluate_systems(msgspec.structs.replace(plain, vehicle=vehicle), Observation(systems=systems))
    assert [(f.item, f.go) for f in found] == ([] if says is None else [("system_id", False)])
    assert says is None or says in found[0].message


def test_the_programs_own_findings_are_not_attributed_to_px4() -> None:
    own_finding = "ODOMETRY arrives, but no message is usable: the velocity is NaN"
    observed = msgspec.structs.replace(OBSERVED, local_position_ok=False, own_findings=[own_finding])
    assert telemetry_findings(observed)["estimator"].message == f"no valid local position; {own_finding}"
    assert "px4_checks" not in telemetry_findings(observed)
    both = msgspec.structs.replace(observed, texts=["no heading"])
    assert (
        telemetry_findings(both)["estimator"].message
        == f"no valid local position; {own_finding}; PX4 reports: no heading"
    )


def test_an_observation_beyond_a_limit_is_a_no_go() -> None:
    assert not no_goes(telemetry_findings(OBSERVED).values())
    for changes, item in (
        ({"rates_hz": {**RATES, "imu": 49.0}}, "rate_imu"),
        ({"battery_v": 12.5}, "battery"),
        ({"battery_remaining": 0.2}, "battery"),
        ({"local_position_ok": False}, "estimator"),
        ({"specific_force_m_s2": 1.0}, "imu_scale"),  # in g
    ):
        assert no_goes(telemetry_findings(msgspec.structs.replace(OBSERVED, **changes)).values()) == [item]


def source(
    message: str, component: int, instance: int, rate_hz: float, usable: bool = True, reason: str = ""
) -> Source:
    sender = Sender(message, 1, component, instance)
    return Source(sender, rate_hz, rate_hz if usable else 0.0, component == 1, reason)


def test_a_stream_without_usable_values_is_a_no_go_with_its_cause() -> None:
    echo = source("ODOMETRY", 1, 2, 125.0, False, "the velocity is NaN")
    observed = msgspec.structs.replace(OBSERVED, rates_hz={**RATES, "odometry": 0.0}, sources=(echo,))
    cause = "125 Hz arrive, but no message is usable: the velocity is NaN"
    assert telemetry_findings(observed)["rate_odometry"].message == cause
    says = telemetry_findings(observed, MAV_ODOM_LP=1.0)["rate_odometry"].message
    assert says == f"{cause}; MAV_ODOM_LP is 1, set it to 0"


def test_another_sender_of_a_stream_is_a_remark() -> None:
    own = (source("ODOMETRY", 1, 8, 125.0), source("HIGHRES_IMU", 1, 0, 250.0))
    alone = telemetry_findings(msgspec.structs.replace(OBSERVED, sources=own))["sources"]
    assert (alone.go, alone.remark) == (True, False)
    assert alone.message == "system 1 component 1: ODOMETRY, HIGHRES_IMU"
    vio = source("ODOMETRY", 197, 2, 30.0, False)
    found = telemetry_findings(msgspec.structs.replace(OBSERVED, sources=(*own, vio)))["sources"]
    assert (found.go, found.remark) == (True, True)
    assert found.message.endswith("not used: ODOMETRY of system 1 component 197, instance 2, 30 Hz")


def test_every_battery_is_named() -> None:
    low, full = BatteryReading(0, 9.0, 0.04, True), BatteryReading(1, 16.2, 0.95, True)
    rail = BatteryReading(2, 5.0, 0.4, True)
    observed = msgspec.structs.replace(
        OBSERVED, battery_id=0, battery_v=9.0, battery_remaining=0.04, batteries=(low, full),
        other_batteries=(rail,),
    )  # fmt: skip
    found = telemetry_findings(observed)["battery"]
    assert not found.go
    assert (
        found.message
        == "id 0: 4 %, 9.0 V; better: id 1: 16.2 V, 95 %; not a flight battery: id 2: 5.0 V, 40 %"
    )


MAIN = {f"PWM_MAIN_FUNC{k}": 100.0 + k for k in range(1, 5)} | {"PWM_MAIN_TIM0": 400.0}
AUX = {name.replace("MAIN", "AUX"): value for name, value in MAIN.items()}
CAN = {f"UAVCAN_EC_FUNC{k}": 100.0 + k for k in range(1, 5)}
NO_MAIN = dict.fromkeys((f"PWM_MAIN_FUNC{k}" for k in range(1, 5)), 0.0)


@pytest.mark.parametrize(
    ("values", "observed", "go", "says"),
    [
        (MAIN, PWM, True, "PWM 1000 to 2000 us, on PWM_MAIN"),
        ({**MAIN, "PWM_MAIN_TIM0": -4.0}, None, True, "DShot 0 to 1999, on PWM_MAIN"),
        ({**NO_MAIN, **CAN}, None, True, "UAVCAN 0 to 8191, on UAVCAN_EC"),
        ({}, DSHOT, True, "DShot 0 to 1999, inferred from the values"),
        (MAIN, DSHOT, False, "sends DShot"),
        (
            {**MAIN, "PWM_MAIN_FUNC2": 103.0},
            PWM,
            False,
            "output 2 of PWM_MAIN has function 103, not 102 (motor 2)",
        ),
        ({**MAIN, "PWM_MAIN_MIN3": 1075.0}, PWM, False, "set 1000 and 2000"),
        ({**NO_MAIN, "PWM_MAIN_FUNC1": 201.0, **AUX}, PWM, False, "the motors are on PWM_AUX"),
        (NO_MAIN, PWM, False, "thrust is unknown"),
    ],
)
def test_motor_outputs_of_unknown_or_wrong_type_are_a_no_go(
    values: dict[str, float], observed: OutputScale | None, go: bool, says: str
) -> None:
    found = telemetry_findings(msgspec.structs.replace(OBSERVED, motor_scale=observed), **values)[
        "motor_outputs"
    ]
    assert found.go is go
    assert says in found.message


@pytest.mark.parametrize(
    ("available", "reads"), [(MAIN, 13), ({**NO_MAIN, **AUX}, 17), ({**NO_MAIN, **CAN}, 9), ({}, 3)]
)
def test_motor_output_parameters_are_read_bank_by_bank(available: dict[str, float], reads: int) -> None:
    """Reading an absent parameter takes seconds, so only the first one of a bank may be absent."""
    values: dict[str, float] = {}
    while names := motor_output_names(values, 4):
        assert not values.keys() & set(names)
        values |= {name: available.get(name, math.nan) for name in names}
    assert len(values) == reads
    absent = [name for name in values if name not in available and not name[:-1].endswith(("MIN", "MAX"))]
    assert all(name.endswith("FUNC1") for name in absent)


def test_a_lock_that_would_not_move_is_a_no_go() -> None:
    plain = mission()
    assert no_goes(evaluate_lock(plain, {})) == ["lock_driver"]  # the mock moves no servo
    by_px4 = with_driver(plain, LockDriver.PX4)
    assert no_goes(evaluate_lock(by_px4, {})) == ["lock_driver"]
    assert by_px4.vehicle.lock is not None
    values = {required.name: float(required.value) for required in required_parameters(by_px4.vehicle.lock)}
    assert not no_goes(evaluate_lock(by_px4, values))


# Findings that the load of the computer may cause.
LATE_ITEMS = (
    "rate_imu",
    "rate_attitude",
    "rate_odometry",
    "rate_actuator",
    "round_trip",
    "link",
    "core_speed",
)


@pytest.mark.realtime
@pytest.mark.mavlink
def test_check_reads_a_vehicle_and_fly_refuses_its_no_go(tmp_path: Path) -> None:
    with simulated_vehicle("missions/single_wall.yaml") as url:

        def command(*arguments: str) -> subprocess.CompletedProcess[str]:
            words = [sys.executable, "-m", "dart_flight", *arguments, "missions/single_wall.yaml"]
            return run_within(60.0, words, cwd=ROOT)

        good = command("check", "--connection", url, "--driver", "px4", "--json")
        findings = json.loads(good.stdout)["findings"]
        items = {f["item"]: f["message"] for f in findings}
        late = [f["item"] for f in findings if not f["go"] and f["item"] in LATE_ITEMS]
        if late:
            raise TooSlow(f"no-go: {late}")
        assert good.returncode == 0, good.stdout + good.stderr
        assert items["position_source"] == "motion capture"
        # The embedded autopilot holds before it lands and has no sticks; both are remarks.
        assert {f["item"] for f in findings if f["remark"]} == {
            "COM_OBL_RC_ACT",
            "COM_FAIL_ACT_T",
            "COM_RCL_EXCEPT",
            "EKF2_EV_DELAY",  # no delay of the motion capture is configured
            "flown",
        }
        assert items["version"] == "PX4 1.16.0"
        wrong_source = command("check", "--connection", url, "--driver", "px4", "--position-from", "rtk")
        assert wrong_source.returncode == 1
        assert "position_source: --position-from is rtk, but" in wrong_source.stderr
        refused = command("fly", "--yes", "--connection", url, "--log-dir", str(tmp_path / "none"))
        assert refused.returncode == 1
        assert "lock_driver" in refused.stderr
        assert not (tmp_path / "none").exists()  # no flight began


# --- the rehearsal ---


@pytest.mark.parametrize(("name", "standoff"), [("paper_dual_collision", 0.3), ("paper_single_wall", 0.6)])
def test_a_rehearsal_stops_before_every_wall(name: str, standoff: float) -> None:
    plain = load_flyable(ROOT / f"missions/{name}.yaml")
    records: list[Record] = []
    verdict = fly_fast(as_rehearsal(plain, standoff), 1, None, records.append)
    assert (verdict.outcome, verdict.reason) == ("completed", None)
    assert not [r for r in records if isinstance(r, TruthContact)]
    for collision in plain.collisions:
        nearest = min(
            collision.wall.signed_distance(r.position_mission) for r in records if isinstance(r, TruthSample)
        )
        assert standoff - 0.1 < nearest < standoff + 0.1


def test_a_standoff_of_zero_is_refused() -> None:
    assert main(["dry-run", str(ROOT / "missions/paper_single_wall.yaml"), "--fast", "--standoff", "0"]) == 2
