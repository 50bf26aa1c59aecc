"""`check --connection` with a real PX4 that waits on the ground."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dart_flight.check.checks import FlightContext, select_checks
from dart_flight.check.findings import CheckFinding
from dart_flight.check.stages import Stage, run_checks
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import Parameter, PositionSource
from dart_flight.run.prepare import load_flyable
from dart_flight.run.simulator_process import Px4SimulatorProcess
from dart_flight.sim.pipe import Px4SimulatorSpec, SimulatorSpec
from dart_flight.sim.px4.launch import ONBOARD_PORT, flight_parameters
from tests.doubles.operator_station import OperatorStation

pytestmark = pytest.mark.px4

MISSION = Path(__file__).parents[2] / "missions" / "paper_single_wall.yaml"


@contextmanager
def waiting_px4(
    mission: Mission, px4_dir: Path, folder: Path, source: PositionSource, changes: dict[str, int | float]
) -> Iterator[str]:
    """Start PX4 on the ground, set up as for `dry-run` except for `changes`, and yield its URL."""
    own = {name: Parameter(name, value, "") for name, value in changes.items()}
    parameters = {**flight_parameters(mission.vehicle, source), **own}
    spec = SimulatorSpec(
        mission, 1, [], None, Px4SimulatorSpec(str(px4_dir), str(folder), parameters, source)
    )
    world = Px4SimulatorProcess(spec, lambda record: None)
    try:
        world.wait_ready()
        yield f"udpin://127.0.0.1:{world.port}"
    finally:
        world.close()


def station_of(url: str) -> OperatorStation:
    """Return the ground station of a waiting PX4, whose instance is 0 only if no other PX4 runs."""
    return OperatorStation.of_px4(int(url.rpartition(":")[2]) - ONBOARD_PORT)


def findings_by_item(findings: list[CheckFinding]) -> dict[str, CheckFinding]:
    items = {f.item: f for f in findings}
    assert len(items) == len(findings)  # every item has one finding
    return items


def test_the_shipped_setup_is_go_and_every_change_is_reported(px4_dir: Path, tmp_path: Path) -> None:
    mission = load_flyable(MISSION)
    changes = {"NAV_RCL_ACT": 2, "COM_FAIL_ACT_T": 5.0}
    with waiting_px4(mission, px4_dir, tmp_path, PositionSource.MOCAP, changes) as url:
        found = findings_by_item(run_checks(select_checks(Stage.VEHICLE), FlightContext(mission, url=url)))
    assert found["position_source"].says == "motion capture"
    assert found["version"].says.startswith("PX4 1.")
    # The lock's driver of this mission is the mock, which is a no-go.
    assert {item for item, f in found.items() if not f.go} == {"NAV_RCL_ACT", "lock_driver"}
    # Without a global position PX4 would not arm in Hold, the mode that it waits in.
    # Not every version's answer to TIMESYNC reaches MAVSDK (docs/px4.md).
    remarks = {item for item, f in found.items() if f.remark} - {"round_trip"}
    assert remarks == {"COM_FAIL_ACT_T", "EKF2_EV_DELAY", "px4_checks"}  # mocap.delay_ms is unmeasured
    assert "Land at once" in found["COM_FAIL_ACT_T"].says
    assert found["motor_outputs"].says == "PWM 1000 to 2000 us, on PWM_MAIN"
    assert " component 1: ACTUATOR_OUTPUT_STATUS, ATTITUDE" in found["sources"].says


@pytest.mark.parametrize(("source", "go"), [(PositionSource.RTK, True), (PositionSource.PLAIN, False)])
def test_only_an_rtk_fix_is_accepted_as_gps_position(
    px4_dir: Path, tmp_path: Path, source: PositionSource, go: bool
) -> None:
    mission = load_flyable(MISSION)
    with waiting_px4(mission, px4_dir, tmp_path, source, {}) as url:
        found = findings_by_item(run_checks(select_checks(Stage.VEHICLE), FlightContext(mission, url=url)))
    position = found["position_source"]
    assert position.go is go
    assert ("rtk fixed" if go else "needs RTK, motion capture or") in position.says
    # Plain GPS may place the vehicle some decimetres beside its start.
    assert {item for item, f in found.items() if f.remark} <= {"px4_checks", "round_trip", "place"}


@pytest.mark.parametrize("vehicle", ["rigid_cage", "ring_guard_250g"])
def test_a_vehicle_without_a_lock_is_go_without_an_overrule(
    px4_dir: Path, tmp_path: Path, vehicle: str
) -> None:
    mission = load_flyable(MISSION.parent / vehicle / "single_wall.yaml")
    with waiting_px4(mission, px4_dir, tmp_path, PositionSource.MOCAP, {}) as url:
        found = findings_by_item(run_checks(select_checks(Stage.VEHICLE), FlightContext(mission, url=url)))
    assert [f"{item}: {f.says}" for item, f in found.items() if not f.go] == []
    assert not any("lock" in item for item in found)
    assert found["airframe"].go
