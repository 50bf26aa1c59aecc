"""Hardware in the loop by command, with a real PX4 without lockstep on two pseudo-terminals."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dart_flight.config.document import InputError
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.px4.installation import find_install
from tests.doubles.hitl_bench import fly_bench
from tests.doubles.hitl_px4 import ENVIRONMENT, HitlPx4

pytestmark = pytest.mark.px4

MISSION = Path(__file__).parents[2] / "missions" / "single_wall.yaml"


@pytest.fixture(scope="module")
def hitl_dir() -> str:
    named = os.environ.get(ENVIRONMENT)
    if not named:
        pytest.skip(f"{ENVIRONMENT} is not set: no PX4 without lockstep (px4_sitl_nolockstep) to test with")
    try:
        find_install(named)
    except InputError as error:
        pytest.fail(f"{ENVIRONMENT}: {error}")
    return named


def test_a_flight_completes_and_leaves_the_flight_controller_disarmed(hitl_dir: str) -> None:
    flight = fly_bench("single_wall", 1)
    assert flight.outcome == "completed", flight.reason
    assert flight.problems == []
    assert flight.tilt_deg is not None
    assert flight.tilt_deg < 45.0
    assert flight.ekf_m is not None
    assert flight.ekf_m < 0.15
    assert flight.lost_bytes[:2] == [0, 0]


def test_a_cut_port_ends_the_flight_with_its_cause(hitl_dir: str) -> None:
    flight = fly_bench("single_wall", 1, cut_usb_s=0.2)
    assert flight.outcome == "aborted"
    assert "without simulated sensors for 2" in (flight.reason or "")
    assert flight.problems == []


def test_check_and_fly_refuse_a_vehicle_in_hitl_mode(hitl_dir: str, tmp_path: Path) -> None:
    with HitlPx4(hitl_dir, tmp_path, load_flyable(MISSION)) as px4:
        for command in ("check", "fly"):
            arguments = [command, str(MISSION), "--connection", px4.url]
            result = subprocess.run(
                [sys.executable, "-m", "dart_flight", *arguments],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                check=False,
                timeout=180.0,
            )
            assert result.returncode != 0
            assert "SYS_HITL" in result.stdout + result.stderr
            assert "Traceback" not in result.stderr
        assert not px4.is_armed()
