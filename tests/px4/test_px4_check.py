"""`check --connection` with a real PX4 that waits on the ground."""

from __future__ import annotations

from pathlib import Path

import pytest

from dart_flight.config.parameter_file import PositionSource
from dart_flight.run.prepare import load_flyable
from tests.px4.real_px4 import MISSIONS, SINGLE, vehicle_findings, waiting_px4

pytestmark = pytest.mark.px4


def test_the_shipped_setup_is_go_and_every_change_is_reported(px4_dir: Path, tmp_path: Path) -> None:
    with waiting_px4(px4_dir, tmp_path, {"NAV_RCL_ACT": 2, "COM_FAIL_ACT_T": 5.0}) as url:
        found = vehicle_findings(SINGLE, url)
    assert found["position_source"].message == "motion capture"
    assert found["version"].message.startswith("PX4 1.")
    # The lock's driver of this mission is the mock, which is a no-go.
    assert {item for item, f in found.items() if not f.go} == {"NAV_RCL_ACT", "lock_driver"}
    # Without a global position PX4 would not arm in Hold, the mode that it waits in.
    # Not every version's answer to TIMESYNC reaches MAVSDK (docs/px4.md).
    remarks = {item for item, f in found.items() if f.remark} - {"round_trip"}
    assert remarks == {"COM_FAIL_ACT_T", "EKF2_EV_DELAY", "px4_checks"}  # mocap.delay_ms is unmeasured
    assert "Land at once" in found["COM_FAIL_ACT_T"].message
    assert found["motor_outputs"].message == "PWM 1000 to 2000 us, on PWM_MAIN"
    assert " component 1: ACTUATOR_OUTPUT_STATUS, ATTITUDE" in found["sources"].message


@pytest.mark.parametrize(("source", "go"), [(PositionSource.RTK, True), (PositionSource.PLAIN, False)])
def test_only_an_rtk_fix_is_accepted_as_gps_position(
    px4_dir: Path, tmp_path: Path, source: PositionSource, go: bool
) -> None:
    with waiting_px4(px4_dir, tmp_path, source=source) as url:
        found = vehicle_findings(SINGLE, url)
    position = found["position_source"]
    assert position.go is go
    assert ("rtk fixed" if go else "needs RTK, motion capture or") in position.message
    # Plain GPS may place the vehicle some decimetres beside its start.
    assert {item for item, f in found.items() if f.remark} <= {"px4_checks", "round_trip", "place"}


@pytest.mark.parametrize("vehicle", ["rigid_cage", "ring_guard_250g"])
def test_a_vehicle_without_a_lock_is_go_without_an_overrule(
    px4_dir: Path, tmp_path: Path, vehicle: str
) -> None:
    mission = load_flyable(MISSIONS / vehicle / "single_wall.yaml")
    with waiting_px4(px4_dir, tmp_path, mission=mission) as url:
        found = vehicle_findings(mission, url)
    assert [f"{item}: {f.message}" for item, f in found.items() if not f.go] == []
    assert not any("lock" in item for item in found)
    assert found["airframe"].go
