"""`bringup` measures the latency of motion capture on a vehicle with a real PX4, carried by hand."""

from __future__ import annotations

import time
from pathlib import Path

import msgspec
import pytest

from dart_flight.base.geometry import Quaternion, Vec3
from dart_flight.check.bringup.judgements import StepFinding
from dart_flight.check.bringup.steps import Bringup
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.run.prepare import with_simulated_mocap
from tests.check.bringup.test_bringup import assert_passed
from tests.check.bringup.test_pose_motion import Hand
from tests.px4.carried_vehicle import CarriedVehicle, carried, eased
from tests.real_time import assert_not_later

pytestmark = pytest.mark.px4

_EASE_S = 2.0  # in which a motion by hand begins
_ALIGN_S = 8.0  # in which PX4's estimator aligns


class Waving:
    """The motion by hand of `Hand`, which begins at rest on the ground."""

    def __init__(self) -> None:
        self._hand, self.begun_s = Hand(), float("inf")

    def __call__(self, time_s: float) -> tuple[Vec3, Quaternion]:
        t = max(0.0, time_s - self.begun_s)
        share = eased(t / _EASE_S)
        p, p0 = self._hand.position(t * share), self._hand.position(0.0)
        x, y, z = (a - b for a, b in zip(p, p0, strict=True))
        return (x, y, z - 0.5 * share), self._hand.attitude(t * share)


class Hands:
    """An operator who moves the vehicle when asked to."""

    def __init__(self, vehicle: CarriedVehicle, motion: Waving) -> None:
        self._vehicle, self._motion = vehicle, motion

    def instruct(self, text: str) -> None:
        if "vehicle left" in text:
            self._motion.begun_s = self._vehicle.time_s

    def confirm(self, question: str) -> bool:
        return True


def measure(mission: Mission, px4_dir: Path, folder: Path) -> StepFinding:
    """Return what the position step finds by motion capture."""
    motion = Waving()
    with carried(mission, px4_dir, folder, motion) as (vehicle, url):
        room = msgspec.structs.replace(mission.vehicle.mocap, url=vehicle.mocap_url)
        mission = msgspec.structs.replace(
            mission, vehicle=msgspec.structs.replace(mission.vehicle, mocap=room)
        )
        bringup = Bringup(mission, url, Hands(vehicle, motion), 40.0)
        try:
            # The whole step goes on to carry the vehicle, which is not possible beside a motion by hand.
            link = bringup._connect()
            time.sleep(_ALIGN_S)
            return bringup._measure_poses(link)
        finally:
            bringup.close()


@pytest.mark.realtime
@pytest.mark.parametrize("latency_ms", [5.0, 20.0, 50.0])
def test_bringup_measures_the_latency_of_motion_capture(
    latency_ms: float, px4_dir: Path, tmp_path: Path
) -> None:
    settings = [
        f"simulation.pose_delay_s={1e-3 * latency_ms}",
        "mocap.up=y",
        "mocap.heading_deg=40",
        "mocap.body_yaw_deg=15",
    ]
    mission = load_mission(packaged("missions", "single_wall.yaml"), settings=settings)
    found = measure(with_simulated_mocap(mission, "optitrack"), px4_dir, tmp_path / "px4")
    assert_passed(found)
    print(f"latency {latency_ms:g} ms: {found.measured}")
    measured_ms = float(found.measured["delay_ms"] or 0.0)
    assert measured_ms > latency_ms - 8.0
    assert_not_later(measured_ms, latency_ms + 8.0, "the measured latency")
