"""Vehicles with six or eight motors, and with a measured thrust curve."""

from __future__ import annotations

import json
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.geometry import MissionFrame
from dart_flight.base.records import ActuatorSample, Record, TorqueEstimate, TruthContact
from dart_flight.check.vehicle_check import evaluate_airframe
from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.rotors import motors_from_parameters, rotor_parameters
from dart_flight.config.vehicle import Thrust, effectiveness
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.lab.calibrate.airframe_reader import motors_block
from dart_flight.run.fast import fly_fast
from dart_flight.sim.allocation import Allocation
from dart_flight.sim.plant import Plant
from tests.doubles.ulog_file import write_ulog
from tests.sim.plants import motor_load

ROOT = Path(__file__).parents[2]
HEXAROTOR = ROOT / "configs/hexarotor.yaml"
DART = load_vehicle(ROOT / "configs/dart.yaml")
TABLE = ((0.1, 0.3), (0.35, 1.6), (0.6, 3.4), (1.0, 6.0))
share = st.floats(-1.0, 1.0)


def octorotor(folder: Path) -> Path:
    """Write a configuration with eight motors on a circle, turning in pairs, and a measured thrust curve."""
    spins = (1, 1, -1, -1, 1, 1, -1, -1)
    lines = ["airframe:", "  arm_x_m: null", "  arm_y_m: null", "  mass_kg: 2.4"]
    lines += ["  inertia_kg_m2: [0.04, 0.04, 0.07]", "  motors:"]
    for i, spin in enumerate(spins):
        angle = math.radians(22.5 + 45.0 * i)
        x, y = 0.25 * math.cos(angle), 0.25 * math.sin(angle)
        lines.append(f"    - {{x_m: {x:.4f}, y_m: {y:.4f}, yaw_torque_per_thrust_m: {0.016 * spin}}}")
    lines += ["thrust:", "  full_n: null", "  model_factor: null", f"  table: {json.dumps(TABLE)}"]
    path = folder / "octorotor.yaml"
    path.write_text(f"extends: {ROOT / 'configs/dart.yaml'}\n" + "\n".join(lines) + "\n")
    return path


def refusal_of(folder: Path, text: str) -> str:
    """Return the one line with which this change of the hexarotor's configuration is refused."""
    path = folder / "wrong.yaml"
    path.write_text(f"extends: {HEXAROTOR}\n{text}\n")
    with pytest.raises(InputError) as caught:
        load_vehicle(path)
    return caught.value.one_line()


# --- the motors of a configuration ------------------------------------------------------------------------


def test_arm_lengths_define_the_motors_of_px4s_quadrotor_in_x() -> None:
    motors = DART.airframe.motors
    assert [(m.x_m, m.y_m) for m in motors] == [(0.13, 0.13), (-0.13, -0.13), (0.13, -0.13), (-0.13, 0.13)]
    assert [m.yaw_torque_per_thrust_m for m in motors] == [0.016, 0.016, -0.016, -0.016]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("airframe: {arm_x_m: 0.1}", "arm_x_m and motors both define the motor positions"),
        (
            "airframe: {motors: null}",
            "missing key arm_x_m; if the airframe is not an X-shaped quadrotor, give `motors`",
        ),
        ("airframe: {motors: null, arm_x_m: 0.1}", "missing key arm_y_m"),
        ("airframe: {motors: [{x_m: 0.1, y_m: 0.1, yaw_torque_per_thrust_m: 0.1}]}", "length >= 4"),
        (
            "airframe: {motors: [{x_m: 0.1, y_m: 0.1, yaw_torque_per_thrust_m: 0.01}, "
            "{x_m: -0.1, y_m: -0.1, yaw_torque_per_thrust_m: 0.01}, "
            "{x_m: 0.1, y_m: -0.1, yaw_torque_per_thrust_m: 0.01}, "
            "{x_m: -0.1, y_m: 0.1, yaw_torque_per_thrust_m: 0.01}]}",
            "cannot control roll, pitch, yaw and lift independently",
        ),
        ("thrust: {full_n: 2.0}", "to hover 1.6 kg (airframe.mass_kg), limit 80 %"),
        ("thrust: {table: [[0.5, 3.0], [1.0, 6.0]]}", "full_n and model_factor and table both define"),
        ("thrust: {full_n: null}", "missing key full_n; alternatively, give the measured thrust as `table`"),
        (
            "thrust: {full_n: null, model_factor: null, table: [[0.5, 3.0], [0.5, 4.0], [1.0, 6.0]]}",
            "command and thrust must both rise from [0.5, 3] to [0.5, 4]",
        ),
        (
            "thrust: {full_n: null, model_factor: null, table: [[0.5, 3.0], [0.9, 6.0]]}",
            "the last command is 0.9",
        ),
    ],
)
def test_a_missing_or_contradictory_key_is_refused_in_one_line(
    tmp_path: Path, text: str, message: str
) -> None:
    assert message in refusal_of(tmp_path, text)


def test_motors_that_all_lie_behind_the_centre_of_mass_are_refused(tmp_path: Path) -> None:
    motors = [msgspec.structs.replace(m, x_m=m.x_m - 0.3) for m in load_vehicle(HEXAROTOR).airframe.motors]
    line = refusal_of(tmp_path, "airframe:\n" + motors_block(motors))
    assert "the centre of mass is not between the motors" in line


# --- thrust -----------------------------------------------------------------------------------------------


@given(st.floats(0.0, 1.0), st.sampled_from([DART.thrust, Thrust(0.025, table=TABLE)]))
def test_thrust_command_is_the_inverse_of_thrust_force(command: float, thrust: Thrust) -> None:
    assert thrust.command_for(thrust.force_n(command)) == pytest.approx(command, abs=1e-9)


def test_a_thrust_table_is_interpolated_linearly() -> None:
    thrust = Thrust(0.025, table=TABLE)
    assert thrust.forces_n([0.0, *(u for u, _ in TABLE), 2.0]) == pytest.approx(
        [0.0, *(n for _, n in TABLE), 6.0]
    )
    assert thrust.force_n(0.225) == pytest.approx(0.95)
    assert thrust.scaled(0.5).force_n(0.225) == pytest.approx(0.475)


def test_the_model_factor_of_a_thrust_table_matches_its_curve() -> None:
    table = tuple((u, DART.thrust.force_n(u)) for u in (0.1, 0.3, 0.5, 0.7, 0.9, 1.0))
    assert Thrust(0.025, table=table).square_share == pytest.approx(0.4)


# --- allocation and plant ---------------------------------------------------------------------------------


@given(share, share, share, st.floats(0.0, 1.0))
def test_the_allocation_of_a_quadrotor_equals_its_explicit_formula(
    roll: float, pitch: float, yaw: float, up: float
) -> None:
    """Flights recorded with the formula for four motors must still replay bit for bit."""
    signs = ((1, 1, 1), (-1, -1, 1), (1, -1, -1), (-1, 1, -1))
    wanted = [up + 0.7071 * (-sy * roll + sx * pitch) + spin * yaw for sx, sy, spin in signs]
    shift = min(0.0, 1.0 - max(wanted)) + max(0.0, -min(wanted))
    found = Allocation(DART.airframe.motors).shares(roll, pitch, yaw, up)
    assert found == [w + shift for w in wanted]


@pytest.mark.parametrize("eight", [False, True])
def test_each_axis_is_controlled_alone_and_saturation_reduces_only_the_lift(
    tmp_path: Path, eight: bool
) -> None:
    motors = load_vehicle(octorotor(tmp_path) if eight else HEXAROTOR).airframe.motors
    allocation, turning = Allocation(motors), np.array(effectiveness(motors))
    level = turning @ np.array(allocation.shares(0.0, 0.0, 0.0, 0.5))
    assert level == pytest.approx([0.0, 0.0, 0.0, 0.5 * len(motors)], abs=1e-3)
    for axis in range(3):
        roll, pitch, yaw = (0.3 if i == axis else 0.0 for i in range(3))
        gentle = turning @ np.array(allocation.shares(roll, pitch, yaw, 0.5))
        assert [abs(t) > 1e-3 for t in gentle[:3]] == [i == axis for i in range(3)]
        assert gentle[axis] > 0.0
        shares = np.array(allocation.shares(roll, pitch, yaw, 0.98))
        assert max(shares) == pytest.approx(1.0)
        assert (turning @ shares)[:3] == pytest.approx(gentle[:3], abs=1e-6)


def test_each_motor_of_the_plant_acts_at_its_position() -> None:
    vehicle = load_vehicle(HEXAROTOR)
    for number, motor in enumerate(vehicle.airframe.motors):
        plant = Plant(vehicle, (), MissionFrame())
        commands = [0.0] * 6
        commands[number] = 0.5
        thrust, torque = motor_load(plant, commands)
        force = vehicle.thrust.force_n(0.5)
        assert thrust == pytest.approx(force)
        expected = np.cross((motor.x_m, motor.y_m, 0.0), (0.0, 0.0, -force))
        expected[2] += motor.yaw_torque_per_thrust_m * force
        assert torque == pytest.approx(tuple(expected))


# --- flights ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("eight", [False, pytest.param(True, marks=pytest.mark.rest)])
def test_another_airframe_flies_the_single_wall(tmp_path: Path, eight: bool) -> None:
    config = octorotor(tmp_path) if eight else HEXAROTOR
    mission = load_mission(ROOT / "missions/paper_single_wall.yaml", config)
    records: list[Record] = []
    verdict = fly_fast(mission, 1, None, records.append)
    assert verdict.outcome == "completed", verdict.reason
    (hit,) = verdict.collisions
    assert hit.truth is not None
    assert hit.measured.peak_force_n == pytest.approx(hit.truth.peak_force_n, rel=0.1)
    assert {len(r.motors) for r in records if isinstance(r, ActuatorSample)} == {8 if eight else 6}
    # The torque model covers every motor, so that no torque remains away from the wall.
    contact = next(r for r in records if isinstance(r, TruthContact))
    before = [r for r in records if isinstance(r, TorqueEstimate) and -2e6 < r.t_us - contact.t_us < -0.1e6]
    assert np.abs(np.mean([r.torque_frd for r in before], axis=0)).max() < 0.05


# --- comparison with PX4 ----------------------------------------------------------------------------------


def hexarotor_mission() -> Mission:
    return load_mission(ROOT / "missions/paper_single_wall.yaml", HEXAROTOR)


def test_motors_convert_to_px4_parameters_and_back() -> None:
    motors = load_vehicle(HEXAROTOR).airframe.motors
    assert motors_from_parameters(rotor_parameters(motors), "here") == motors


@pytest.mark.parametrize(
    ("change", "go", "message"),
    [
        ({}, True, "6 motors, as in PX4"),
        ({"CA_ROTOR_COUNT": 4}, False, "PX4 has 4 motors, but the configuration has 6"),
        ({"CA_ROTOR2_KM": 0.016}, False, "motor 3 turns in the opposite direction"),
        ({"CA_ROTOR4_PX": -0.173}, False, "motor 5: x_m 0.173, PX4 -0.173"),
        ({"CA_ROTOR4_PX": 0.43, "CA_ROTOR2_KM": -0.05}, True, "motor 5: x_m 0.173, PX4 0.43"),
    ],
)
def test_check_names_the_motor_that_differs(change: dict[str, float], go: bool, message: str) -> None:
    mission = hexarotor_mission()
    (finding,) = evaluate_airframe(mission, rotor_parameters(mission.vehicle.airframe.motors) | change)
    assert finding.go is go
    assert message in finding.message


def test_check_reports_that_px4_has_no_airframe_to_compare() -> None:
    (finding,) = evaluate_airframe(hexarotor_mission(), {})
    assert (finding.go, finding.remark) == (True, True)
    assert "has no CA_ROTOR_COUNT" in finding.message


def test_the_airframe_is_read_from_every_kind_of_px4_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parameters = rotor_parameters(load_vehicle(HEXAROTOR).airframe.motors)
    saved, listed = tmp_path / "mine.params", tmp_path / "listed.txt"
    kinds = {name: 6 if isinstance(value, int) else 9 for name, value in parameters.items()}
    saved.write_text("".join(f"1\t1\t{name}\t{value}\t{kinds[name]}\n" for name, value in parameters.items()))
    listed.write_text("".join(f"x + {name} [1,2] : {value:.4f}\n" for name, value in parameters.items()))
    landed = {("vehicle_land_detected", 0): ("bool landed;", [(1e6, [0.0])])}
    log = write_ulog(tmp_path / "flown.ulg", landed, parameters)
    for path in (saved, listed, log):
        assert main(["calibrate", "airframe", str(path)]) == 0
        block = capsys.readouterr().out
        config = tmp_path / "mine.yaml"
        config.write_text(
            f"extends: {ROOT / 'configs/dart.yaml'}\nairframe:\n  arm_x_m: null\n  arm_y_m: null\n{block}"
        )
        assert [
            [getattr(m, name) for name in m.__struct_fields__] for m in load_vehicle(config).airframe.motors
        ] == [
            [pytest.approx(getattr(m, name), abs=1e-4) for name in m.__struct_fields__]
            for m in load_vehicle(HEXAROTOR).airframe.motors
        ]


@pytest.mark.parametrize(
    "words",
    [
        ["airframe"],
        ["airframe", "a.params", "b.params"],
        ["airframe", "a.params", "--write"],
        ["airframe", "not_there.params"],
        ["thrust"],
        ["thrust", "a.ulg", "--connection", "udpin://127.0.0.1:14540"],
    ],
)
def test_wrong_arguments_of_calibrate_are_refused_in_one_line(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", *words]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_a_thrust_table_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = octorotor(tmp_path)
    assert main(["calibrate", "thrust", "a.ulg", "--config", str(config), "--write"]) == 2
    assert "remove thrust.table" in capsys.readouterr().err
