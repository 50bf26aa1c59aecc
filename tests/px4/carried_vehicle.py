"""A vehicle with a real PX4 that is carried by hand.

PX4, MAVSDK and the emulated OptiTrack run in real time; only the motion of the plant is prescribed.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from dart_flight.base.geometry import Quaternion, Vec3
from dart_flight.base.thread_context import ThreadContext
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.sim.embedded_autopilot import TICK_S
from dart_flight.sim.pose_feed import EmulatedMotionCapture
from dart_flight.sim.px4.bridge import HilLink, Px4Vehicle
from dart_flight.sim.px4.installation import find_install
from dart_flight.sim.px4.launch import ONBOARD_PORT, Px4, claim_instance, flight_parameters
from tests.doubles.bench_vehicle import Motion, move_by_hand
from tests.real_time import wait_until


def eased(share: float) -> float:
    """Return the part of a way that a smooth motion from rest to rest has covered at a share of its time."""
    s = min(1.0, share)
    return s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)


class CarriedVehicle(ThreadContext):
    """A vehicle with a real PX4, in real time, whose plant follows a motion by hand.

    Args:
        mission: vehicle and room; `simulation.pose_delay_s` is the latency of the cameras.
        px4: PX4, which waits for its simulator.
        link: link to PX4.
        motion: position (NED, relative to the start) and attitude as functions of the plant's time.
    """

    def __init__(self, mission: Mission, px4: Px4, link: HilLink, motion: Motion) -> None:
        self._vehicle = Px4Vehicle(mission, 1, link, sends_poses=False)
        self._plant = self._vehicle.plant
        self._plant.advance = self._advance  # type: ignore[method-assign]
        self._mocap = EmulatedMotionCapture("optitrack", mission, self._plant)
        self._motion = motion
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

    @property
    def time_s(self) -> float:
        """Time of the plant."""
        return self._plant.time_s

    def _moved(self, t: float) -> tuple[Vec3, Quaternion]:
        offset, q = self._motion(t)
        x, y, z = (a + b for a, b in zip(self._start, offset, strict=True))
        return (x, y, z), q

    def _advance(self, motor_commands: Sequence[float], steps: int = 1) -> Vec3:
        plant = self._plant
        plant.time_s += 1e-3 * steps
        p, q, force, rate = move_by_hand(self._moved, plant.time_s)
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


@contextmanager
def carried(
    mission: Mission, px4_dir: Path, folder: Path, motion: Motion
) -> Iterator[tuple[CarriedVehicle, str]]:
    """A carried vehicle and the URL of its PX4."""
    folder.mkdir()
    instance = claim_instance()
    px4 = Px4(find_install(px4_dir), instance.number, folder)
    try:
        px4.wait_waiting()
        px4.set_parameters(flight_parameters(mission.vehicle, PositionSource.MOCAP))
        link = HilLink(px4.wait_connected(instance.listen()))
        with CarriedVehicle(mission, px4, link, motion) as vehicle:
            yield vehicle, f"udpin://127.0.0.1:{ONBOARD_PORT + px4.instance}"
    finally:
        px4.stop()
        instance.release()
