"""`bringup` measures the latency of motion capture on a vehicle with a real PX4, carried by hand.

PX4, MAVSDK and the emulated OptiTrack run in real time; only the motion of the plant is prescribed.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from dart_flight.base.geometry import Quaternion, Vec3
from dart_flight.base.thread_context import ThreadContext
from dart_flight.check.bringup.judgements import StepFinding
from dart_flight.check.bringup.steps import Bringup
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.vehicle import packaged
from dart_flight.run.prepare import with_simulated_mocap
from dart_flight.sim.embedded_autopilot import TICK_S
from dart_flight.sim.pose_feed import EmulatedMotionCapture
from dart_flight.sim.px4.bridge import HilLink, Px4Vehicle
from dart_flight.sim.px4.installation import find_install
from dart_flight.sim.px4.launch import ONBOARD_PORT, Px4, claim_instance, flight_parameters
from tests.check.bringup.test_bringup import assert_passed
from tests.check.bringup.test_pose_motion import Hand
from tests.doubles.bench_vehicle import move_by_hand
from tests.real_time import assert_not_later, wait_until

pytestmark = pytest.mark.px4

_EASE_S = 2.0  # in which a motion by hand begins
_ALIGN_S = 8.0  # in which PX4's estimator aligns


class CarriedVehicle(ThreadContext):
    """A vehicle with a real PX4, in real time, whose plant follows a motion by hand.

    Args:
        mission: vehicle and room; `simulation.pose_delay_s` is the latency of the cameras.
        px4: PX4, which waits for its simulator.
        link: link to PX4.
    """

    def __init__(self, mission: Mission, px4: Px4, link: HilLink) -> None:
        self._vehicle = Px4Vehicle(mission, 1, link, sends_poses=False)
        self._plant = self._vehicle.plant
        self._plant.advance = self._advance  # type: ignore[method-assign]
        self._mocap = EmulatedMotionCapture("optitrack", mission, self._plant)
        self._hand, self._begun_s = Hand(), float("inf")
        self._start = self._plant.position

        def has_booted() -> bool:
            for _ in range(10):
                self._vehicle.step()
            return px4.booted()

        wait_until(has_booted, 15.0, "PX4 boots")
        super().__init__()

    @property
    def mocap_url(self) -> str:
        """URL of the pose source."""
        return self._mocap.url

    def move(self) -> None:
        """Begin the motion."""
        self._begun_s = self._plant.time_s

    def _motion(self, t: float) -> tuple[Vec3, Quaternion]:
        """Return position and attitude; the motion begins at rest on the ground."""
        s = min(1.0, max(0.0, t / _EASE_S))
        share = s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)
        p, p0 = self._hand.position(t * share), self._hand.position(0.0)
        x, y, z = (a + b - c for a, b, c in zip(self._start, p, p0, strict=True))
        return (x, y, z - 0.5 * share), self._hand.attitude(t * share)

    def _advance(self, motor_commands: Sequence[float], steps: int = 1) -> Vec3:
        plant = self._plant
        plant.time_s += 1e-3 * steps
        p, q, force, rate = move_by_hand(self._motion, max(0.0, plant.time_s - self._begun_s))
        plant.position, plant.q, plant.rate = p, q, rate
        return force

    def _run(self) -> None:
        due_s = time.monotonic()
        while not self._stop.is_set():
            self._vehicle.step()
            self._mocap.publish(self._plant.time_s, self._vehicle.pose)
            due_s += TICK_S
            time.sleep(max(0.0, due_s - time.monotonic()))

    def _close(self) -> None:
        self._mocap.close()


class Hands:
    """An operator who moves the vehicle when asked to."""

    def __init__(self, vehicle: CarriedVehicle) -> None:
        self._vehicle = vehicle

    def instruct(self, text: str) -> None:
        if "vehicle left" in text:
            self._vehicle.move()

    def confirm(self, question: str) -> bool:
        return True


@contextmanager
def carried(mission: Mission, px4_dir: Path, folder: Path) -> Iterator[tuple[CarriedVehicle, str]]:
    """A carried vehicle and the URL of its PX4."""
    folder.mkdir()
    instance = claim_instance()
    px4 = Px4(find_install(px4_dir), instance.number, folder)
    try:
        px4.wait_waiting()
        px4.set_parameters(flight_parameters(mission.vehicle, PositionSource.MOCAP))
        link = HilLink(px4.wait_connected(instance.listen()))
        with CarriedVehicle(mission, px4, link) as vehicle:
            yield vehicle, f"udpin://127.0.0.1:{ONBOARD_PORT + px4.instance}"
    finally:
        px4.stop()
        instance.release()


def measure(mission: Mission, px4_dir: Path, folder: Path) -> StepFinding:
    """Return what the position step finds by motion capture."""
    with carried(mission, px4_dir, folder) as (vehicle, url):
        room = msgspec.structs.replace(mission.vehicle.mocap, url=vehicle.mocap_url)
        mission = msgspec.structs.replace(
            mission, vehicle=msgspec.structs.replace(mission.vehicle, mocap=room)
        )
        bringup = Bringup(mission, url, Hands(vehicle), 40.0)
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
