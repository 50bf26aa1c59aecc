"""The parameter files: their format, the reason of every line, and the differences to a vehicle."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from dart_flight.check.hitl_check import hitl_parameters
from dart_flight.config.document import InputError
from dart_flight.config.parameter_file import (
    PositionSource,
    differences,
    is_same_value,
    load_parameters,
    parse_listing,
    read_parameter_file,
    show_value,
    vehicle_files,
)
from dart_flight.config.vehicle import Px4Parameters, load_vehicle, packaged
from dart_flight.sim.px4.launch import (
    airframe_parameters,
    flight_parameters,
    motors_from,
    parameter_files,
    values_of,
)

WriteFile = Callable[[str], Path]
FILES = sorted(packaged("configs", "px4").glob("*.params"))


@pytest.fixture
def write_file(tmp_path: Path) -> WriteFile:
    """Write a parameter file with a text."""

    def write_file(text: str) -> Path:
        path = tmp_path / "some.params"
        path.write_text(text)
        return path

    return write_file


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
def test_every_packaged_parameter_has_its_reason(path: Path) -> None:
    parameters = load_parameters(path)
    assert parameters
    for parameter in parameters.values():
        assert len(parameter.reason) > 15, parameter.name


def test_all_packaged_files_are_used() -> None:
    used = {path.name for source in PositionSource for path in parameter_files(source)}
    assert hitl_parameters() == load_parameters(packaged("configs", "px4", "hitl.params"))
    # The command `parameters` uses these two files, which no simulation loads.
    assert used | {"hitl.params", "link.params"} == {path.name for path in FILES}


def test_a_vehicle_gets_no_parameters_of_the_simulation() -> None:
    for position_from in PositionSource:
        assert "simulation.params" not in {path.name for path in vehicle_files(position_from)}


def test_parameter_files_do_not_override_the_vehicle_configuration() -> None:
    # The flight model reads these from dart.yaml; a file with other values would fly a different vehicle.
    configured = {field.encode_name for field in msgspec.structs.fields(Px4Parameters)}
    for path in FILES:
        assert not configured & set(load_parameters(path)), path.name


def test_values_types_and_reasons_are_read_from_a_file(write_file: WriteFile) -> None:
    path = write_file(
        "# a head line\n\n# first\n# and second\n1\t1\tCOM_OBL_RC_ACT\t4\t6\n"
        "1\t1\tEKF2_EV_DELAY\t12.5\t9\n# negative\n1 1 CA_ROTOR1_PX -0.13 9\n"
    )
    parameters = load_parameters(path)
    assert [(p.name, p.value, p.reason) for p in parameters.values()] == [
        ("COM_OBL_RC_ACT", 4, "first and second"),
        ("EKF2_EV_DELAY", 12.5, ""),
        ("CA_ROTOR1_PX", -0.13, "negative"),
    ]
    assert isinstance(parameters["COM_OBL_RC_ACT"].value, int)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1\t1\tCOM_OBL_RC_ACT\t4", "4 fields"),
        ("1\t1\tcom_obl\t4\t6", "not a PX4 parameter name"),
        ("1\t1\tA_NAME_LONGER_THAN_16\t4\t6", "not a PX4 parameter name"),
        ("1\t1\tCOM_OBL_RC_ACT\t4\t7", "type '7'"),
        ("1\t1\tCOM_OBL_RC_ACT\t4.5\t6", "not a number of type 6"),
        ("1\t1\tCOM_OBL_RC_ACT\t4294967296\t6", "out of range"),
        ("1\t1\tEKF2_EV_DELAY\tnan\t9", "out of range"),
        ("1\t1\tMPC_XY_P\t1e39\t9", "1e39 is out of range for REAL32"),
        ("1\t1\tMPC_XY_P\t-3.4028236e38\t9", "out of range for REAL32"),
    ],
)
def test_a_wrong_line_is_reported_with_its_number(write_file: WriteFile, line: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        load_parameters(write_file(f"# head\n{line}\n"))
    assert message in str(caught.value)
    assert caught.value.line == 2


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("", "no parameter of the autopilot"),
        ("# Vehicle-Id Component-Id Name Value Type\n", "no parameter of the autopilot"),
        ("1\t154\tGMB_YAW\t1\t6\n1\t100\tCAM_X\t1\t6\n", "belong to component 154, 100"),
        ("1\t1\tA\t4\t6\n1\t1\tA\t5\t6\n", "appears twice"),
        ("#? gone\n1\t1\tA\t4\t6\n", "absent before"),
    ],
)
def test_a_file_with_no_or_contradictory_parameters_is_refused(
    write_file: WriteFile, rows: str, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        load_parameters(write_file(rows))


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read"):
        load_parameters(tmp_path / "none.params")


def test_rows_of_other_components_and_the_head_are_no_parameters(write_file: WriteFile) -> None:
    head = "# Onboard parameters for Vehicle 7\n#\n# Vehicle-Id Component-Id Name Value Type\n"
    rows = "7\t1\tA\t4\t6\n7\t154\tA\t9\t6\n7\t154\tGMB_YAW\tnan\t9\n"
    found = read_parameter_file(write_file(head + rows))
    assert [(p.name, p.value, p.reason) for p in found.parameters.values()] == [("A", 4, "")]
    assert found.skipped == {"154": 2}
    assert found.vehicles == {"7"}


@pytest.mark.parametrize(
    ("vehicle", "wanted", "same"),
    [
        (2490378, 2490379, False),  # one part in a million of an INT32 is another device
        (-(2**31), -(2**31), True),
        (16777217, 16777216, False),
        (0.30000001192092896, 0.3, True),
        (1.00000011920929, 1.0, False),  # the next REAL32
        (1.0e-10, 0.0, False),
        (3.4028234663852886e38, 3.4028234e38, True),
        (5.0, 5, True),
        (5.1, 5, False),
    ],
)
def test_values_are_compared_in_the_parameters_type(vehicle: float, wanted: float, same: bool) -> None:
    assert is_same_value(vehicle, wanted) is same
    assert is_same_value(wanted, vehicle) is same


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1310988, "1310988"),
        (-(2**31), "-2147483648"),
        (0.09120000153779984, "0.0912"),
        (16777216.0, "16777216"),
        (1.00000011920929, "1.0000001"),
        (3.4028234663852886e38, "3.4028235e+38"),
        (30.0, "30"),
    ],
)
def test_a_value_is_shown_with_the_digits_that_identify_it(value: float, text: str) -> None:
    assert show_value(value) == text
    assert is_same_value(type(value)(text), value)


def test_differences_list_changed_and_missing_parameters(write_file: WriteFile) -> None:
    rows = "# why\n1\t1\tA\t4\t6\n# so\n1\t1\tB\t0.3\t9\n# it\n1\t1\tC\t1\t6\n"
    wanted = load_parameters(write_file(rows))
    found = differences(wanted, {"A": 3.0, "B": 0.30000001192092896, "D": 1.0})
    assert [d.name for d in found] == ["A", "C"]
    assert found[0].line() == "A is 3, wanted 4: why"
    assert "not on this vehicle" in found[1].line()


def test_a_parameter_that_the_version_lacks_or_renames_is_no_difference(write_file: WriteFile) -> None:
    path = write_file(
        "# why\n#? absent before v1.16\n1\t1\tA\t4\t6\n# so\n#? renamed NEW_B after v1.17\n1\t1\tB\t2\t9\n"
        "# it\n1\t1\tC\t1\t6\n"
    )
    wanted = load_parameters(path)
    assert (wanted["A"].reason, wanted["A"].absent, wanted["B"].renamed) == ("why", "before v1.16", "NEW_B")
    assert wanted["C"].absent == ""
    assert differences(wanted, {"NEW_B": 2.0, "C": 1.0}) == []
    assert [d.name for d in differences(wanted, {"A": 3.0, "NEW_B": 1.0})] == ["A", "NEW_B", "C"]
    assert [d.name for d in differences(wanted, {"A": 4.0, "C": 1.0})] == ["B"]  # B exists under neither name


def test_flight_parameters_follow_the_position_source_and_the_users_file(write_file: WriteFile) -> None:
    vehicle = load_vehicle()
    indoors = values_of(flight_parameters(vehicle, PositionSource.MOCAP))
    outdoors = values_of(flight_parameters(vehicle, PositionSource.RTK))
    assert (indoors["EKF2_GPS_CTRL"], indoors["SYS_HAS_GPS"]) == (0, 0)
    assert (outdoors["EKF2_EV_CTRL"], outdoors["EKF2_GPS_CTRL"]) == (0, 7)
    assert indoors["MPC_XY_P"] == vehicle.px4.mpc_xy_p
    assert indoors["MPC_THR_HOVER"] == pytest.approx(vehicle.hover_thrust_fraction())
    own = write_file("1\t1\tEKF2_EV_DELAY\t30\t9\n")
    assert flight_parameters(vehicle, PositionSource.MOCAP, [own])["EKF2_EV_DELAY"].value == 30.0


def test_the_imu_position_is_among_px4s_parameters() -> None:
    vehicle = load_vehicle()
    imu = msgspec.structs.replace(vehicle.imu, position_m=(0.02, -0.01, 0.005))
    parameters = airframe_parameters(msgspec.structs.replace(vehicle, imu=imu))
    assert [parameters[f"EKF2_IMU_POS_{axis}"] for axis in "XYZ"] == [0.02, -0.01, 0.005]


@pytest.mark.parametrize(("name", "cells"), [("dart", 4), ("rigid_cage", 4), ("ring_guard_250g", 3)])
def test_px4s_simulated_battery_has_the_vehicles_cells(name: str, cells: int) -> None:
    assert airframe_parameters(load_vehicle(packaged("configs", f"{name}.yaml")))["BAT1_N_CELLS"] == cells


def test_the_plants_motors_match_px4s_parameters(write_file: WriteFile) -> None:
    vehicle = load_vehicle()
    parameters = airframe_parameters(vehicle)
    assert [(m.x_m, m.y_m) for m in motors_from(parameters, vehicle)] == [
        (0.13, 0.13),
        (-0.13, -0.13),
        (0.13, -0.13),
        (-0.13, 0.13),
    ]
    # The plant must follow PX4's iris, which is wider than long.
    own = write_file(
        "1\t1\tCA_ROTOR0_PX\t0.1515\t9\n1\t1\tCA_ROTOR0_PY\t0.245\t9\n1\t1\tCA_ROTOR0_KM\t0.05\t9\n"
    )
    first = motors_from(values_of(flight_parameters(vehicle, PositionSource.MOCAP, [own])), vehicle)[0]
    assert (first.x_m, first.y_m, first.yaw_torque_per_thrust_m) == (0.1515, 0.245, 0.05)


def test_a_listing_is_parsed_with_and_without_the_lock_column() -> None:
    """PX4 v1.18 marks locked parameters in an extra column."""
    older = "x   CA_ROTOR_COUNT [24,355] : 4\n    ADSB_EMERGC [-1,2] : 0\nx * SYS_AUTOSTART [1,2] : 10016\n"
    newer = (
        "x     CA_ROTOR_COUNT [24,355] : 4\n      ADSB_EMERGC [-1,2] : 0\nx *   SYS_AUTOSTART [1,2] : 10016\n"
    )
    locked = newer.replace("x *   SYS", "x + l SYS")
    expected = {"CA_ROTOR_COUNT": 4.0, "ADSB_EMERGC": 0.0, "SYS_AUTOSTART": 10016.0}
    assert [parse_listing(text) for text in (older, newer, locked)] == [expected] * 3
