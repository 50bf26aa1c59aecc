"""Requirements on a flight controller before it receives simulated sensors; every refusal is named."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from dart_flight.check.checks import FlightContext, Stage, run_checks
from dart_flight.check.findings import CheckFinding
from dart_flight.check.hitl_check import hitl_parameters
from dart_flight.check.vehicle_reading import VehicleReading
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.rotors import rotor_parameters
from dart_flight.config.vehicle import LockDriver
from dart_flight.run.prepare import load_flyable, with_driver
from dart_flight.vehicle.ground_link import HeartbeatMode
from tests.check.test_check import GOOD, ROOT

READY = HeartbeatMode(armed=False, hil=True)


@pytest.fixture(scope="module")
def mission() -> Mission:
    return with_driver(load_flyable(ROOT / "missions" / "single_wall.yaml"), LockDriver.MAESTRO)


@pytest.fixture(scope="module")
def board(mission: Mission) -> dict[str, float]:
    """Return the parameters of a correctly configured board with a PX4IO."""
    motors = rotor_parameters(mission.vehicle.airframe.motors)
    io = {"SYS_USB_AUTO": 2.0, "PWM_AUX_FUNC1": 101.0, "PWM_MAIN_FUNC1": 0.0}
    return {**GOOD, **motors, **{p.name: float(p.value) for p in hitl_parameters().values()}, **io}


def hitl_findings(
    mission: Mission, values: Mapping[str, float], mode: HeartbeatMode | None = READY
) -> list[CheckFinding]:
    reading = VehicleReading(mode, values)
    context = FlightContext(mission, position_from=PositionSource.MOCAP, reading=reading)
    return run_checks(context, Stage.HITL)


def refusals(
    mission: Mission, values: Mapping[str, float], mode: HeartbeatMode | None = READY
) -> dict[str, str]:
    return {f.item: f.message for f in hitl_findings(mission, values, mode) if not f.go}


def test_a_configured_board_and_a_posix_build_are_go(mission: Mission, board: dict[str, float]) -> None:
    ready = hitl_findings(mission, board)
    assert [f.item for f in ready if not f.go] == []
    motors = VehicleReading(READY, board).motors
    assert motors is not None
    assert len(motors) == 4
    assert "COM_OF_LOSS_T" in {f.item for f in ready}  # the usual checks are included
    posix = {n: v for n, v in board.items() if not n.startswith(("HIL_", "SYS_USB_AUTO", "PWM_AUX"))}
    assert refusals(mission, {**posix, "PWM_MAIN_FUNC1": 101.0}) == {}


def test_every_missing_parameter_is_named_with_its_value(mission: Mission, board: dict[str, float]) -> None:
    found = refusals(mission, {**board, "SYS_HITL": 0.0, "MAV_0_FORWARD": 1.0, "HIL_ACT_FUNC3": 0.0})
    assert set(found) == {"SYS_HITL", "MAV_0_FORWARD", "HIL_ACT_FUNC3"}
    assert "param set SYS_HITL 1, restart" in found["SYS_HITL"]
    assert "param set HIL_ACT_FUNC3 103, restart" in found["HIL_ACT_FUNC3"]


def test_a_board_without_simulated_outputs_needs_another_firmware(
    mission: Mission, board: dict[str, float]
) -> None:
    lacking = {n: v for n, v in board.items() if not n.startswith("HIL_")}
    assert "CONFIG_MODULES_SIMULATION_PWM_OUT_SIM=y" in refusals(mission, lacking)["HIL_ACT_FUNC1"]


@pytest.mark.parametrize(
    ("mode", "item", "message"),
    [
        (HeartbeatMode(armed=True, hil=True), "disarmed", "is armed"),
        (HeartbeatMode(armed=False, hil=False), "hil_mode", "restart it"),
        (None, "heartbeat", "no heartbeat"),
    ],
)
def test_an_armed_unrestarted_or_silent_vehicle_is_refused(
    mission: Mission, board: dict[str, float], mode: HeartbeatMode | None, item: str, message: str
) -> None:
    found = refusals(mission, board, mode)
    assert set(found) == {item}
    assert message in found[item]


def test_motors_on_a_px4io_are_refused_only_if_the_board_has_one(
    mission: Mission, board: dict[str, float]
) -> None:
    turning = {**board, "PWM_MAIN_FUNC1": 101.0, "PWM_MAIN_FUNC4": 104.0}
    found = refusals(mission, turning)
    assert set(found) == {"real_outputs"}
    assert "PWM_MAIN_FUNC1, PWM_MAIN_FUNC4" in found["real_outputs"]
    without = {n: v for n, v in turning.items() if n != "PWM_AUX_FUNC1"}
    assert refusals(mission, without) == {}


def test_a_lock_servo_on_px4s_own_output_is_refused(mission: Mission, board: dict[str, float]) -> None:
    found = refusals(with_driver(mission, LockDriver.PX4), board)
    assert set(found) == {"lock_driver"}
    assert "choose maestro, pwm or mock (--driver)" in found["lock_driver"]


def test_dangerous_parameters_are_refused_as_in_check(mission: Mission, board: dict[str, float]) -> None:
    assert set(refusals(mission, {**board, "COM_OF_LOSS_T": 10.0})) == {"COM_OF_LOSS_T"}
