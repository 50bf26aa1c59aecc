"""A day from standby: real MAVSDK, real child processes, a ground station, and the transmitter's switch."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from dart_flight.config.vehicle import LockDriver
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.lock.drivers import ActuatorLink, owned_driver
from dart_flight.lock.persistence import ServoInUseError
from dart_flight.run.operator_buttons import Button
from dart_flight.vehicle.command_server import Result
from tests.doubles.operator_station import OperatorStation
from tests.doubles.ports import free_udp_port
from tests.real_time import limited, wait_until
from tests.shared_flights import patient

ROOT = Path(__file__).parents[2]
CHANNEL = 7
MISSION = """
version: 1
name: {name}
vehicle: dart.yaml
start: {{position_m: [{x}, 0.0], altitude_m: 1.0}}
goal: {{position_m: [{x}, 0.0], capture_radius_m: 0.15, hold_s: 0.5}}
bounds_m: {{x: [-2.0, 2.2], y: [-1.6, 2.0], z: [0.3, 2.0]}}
waypoints: [{{position_m: [{x}, 0.3]}}]
collisions: []
"""
OK, NO = Result.ACCEPTED, Result.DENIED

pytestmark = [pytest.mark.mavlink, pytest.mark.realtime]


class Laboratory:
    """A vehicle, standby, a ground station, and three missions, the third with a start elsewhere."""

    def __init__(self, folder: Path, station: OperatorStation, port: int) -> None:
        self.station, self._folder, self._port = station, folder, port
        self.lines: list[str] = []
        self.poses_port = 0  # UDP port on which standby expects poses

    @property
    def standby(self) -> subprocess.Popen[str]:
        return self._standby

    @contextlib.contextmanager
    def standing_by(self) -> Iterator[None]:
        command = [sys.executable, "-m", "dart_flight", "standby", "one.yaml", "two.yaml", "three.yaml"]
        command += ["--connection", f"udpin://127.0.0.1:{self._port}", "--driver", "px4", "--json"]
        environment = os.environ | {
            "PYTHONPATH": str(ROOT),
            "DART_FLIGHT_STATE_DIR": str(self._folder / "state"),
        }
        with open(self._folder / "standby.jsonl", "w") as output:
            self._standby = subprocess.Popen(
                command, cwd=self._folder, env=environment, text=True, stdout=output
            )
        try:
            yield
        finally:
            self._standby.terminate()
            with limited("the end of standby"):
                self._standby.wait(60.0)

    def printed_lines(self) -> list[str]:
        lines = (self._folder / "standby.jsonl").read_text().splitlines()
        return [json.loads(line)["text"] for line in lines]

    def own_servo(self) -> None:
        """Own the servo of the vehicle, as `dart-flight lock` does."""
        lock = load_vehicle(self._folder / "dart.yaml").lock
        assert lock is not None
        lock = msgspec.structs.replace(lock, driver=LockDriver.PX4)
        link = ActuatorLink(lambda index, value: None, f"udpin://127.0.0.1:{self._port}")
        with owned_driver(lock, clock_us=lambda: 0, link=link):
            pass

    def fly(self, number: int) -> None:
        assert self.station.press(Button.FLY, number) == OK
        assert self.station.press(Button.FLY, number) == OK

    def flight_process(self) -> int:
        """Return the process id of `fly`, which must be running."""
        children = Path(f"/proc/{self._standby.pid}/task/{self._standby.pid}/children")
        (pid,) = children.read_text().split()
        return int(pid)

    def wait_for_flight_process(self) -> None:
        """Wait until standby has passed the link to `fly`."""

        def has_passed() -> bool:
            assert self.standby.poll() is None
            return any("passing the link to dart-flight fly" in line for line in self.printed_lines())

        wait_until(has_passed, 60.0, "standby passes the link")

    def wait_for_standby(self, times: int) -> None:
        """Wait until standby holds the link for the nth time, and check that it answers."""
        self.station.wait_for_text("standby", times, timeout_s=120.0)
        assert self.standby.poll() is None
        assert self.station.press(Button.LAND) == NO
        time.sleep(1.0)  # until standby has received the transmitter's state


@pytest.fixture
def laboratory(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Laboratory]:
    config = patient((ROOT / "configs" / "dart.yaml").read_text())
    config = config.replace("rc_channel: null", f"rc_channel: {CHANNEL}")
    poses_port = free_udp_port()
    if getattr(request, "param", "") == "poses":
        config = config.replace("\nmocap:", f"\nmocap:\n  url: udp://127.0.0.1:{poses_port}/dart", 1)
    (tmp_path / "dart.yaml").write_text(config)
    for name, x in (("one", 0.0), ("two", 0.0), ("three", 1.5)):
        (tmp_path / f"{name}.yaml").write_text(MISSION.format(name=name, x=x))
    port, ground_port = free_udp_port(), free_udp_port()
    command = [sys.executable, "-m", "tests.doubles.forwarding_vehicle", str(tmp_path / "one.yaml")]
    command += [str(tmp_path / "dart.yaml"), str(port), str(ground_port)]
    with (
        OperatorStation(ground_port) as station,
        open(tmp_path / "vehicle.log", "w") as log,
        subprocess.Popen(command, cwd=ROOT, stdout=log) as vehicle,
    ):
        laboratory = Laboratory(tmp_path, station, port)
        laboratory.poses_port = poses_port
        try:
            with laboratory.standing_by():
                yield laboratory
        finally:
            vehicle.terminate()


def test_a_day_of_checks_and_flights_completes_from_standby(laboratory: Laboratory) -> None:
    station = laboratory.station
    laboratory.wait_for_standby(1)
    # The lock, by button and by switch.
    assert [station.press(b) for b in (Button.LOCK_RIGID, Button.CONTINUE, Button.LAND)] == [OK, NO, NO]
    station.wait_for_text("lock rigid: settled")
    assert station.press(Button.LOCK_FLEXIBLE) == OK
    station.wait_for_text("lock flexible: settled")
    for pulse_us in (1000, 2000):
        for _ in range(8):
            station.move_switch(CHANNEL, pulse_us)
            time.sleep(0.2)
    station.wait_for_text("lock rigid: settled", 2)
    # A check, and a flight that its check refuses.
    assert station.press(Button.CHECK, 1) == OK
    station.wait_for_text("one: go", timeout_s=120.0)
    laboratory.wait_for_standby(2)
    with pytest.raises(ServoInUseError, match=f"by dart-flight standby, process {laboratory.standby.pid}$"):
        laboratory.own_servo()
    assert station.press(Button.FLY, 9) == NO
    laboratory.fly(3)
    station.wait_for_text("three: no-go", timeout_s=120.0)
    station.wait_for_text("place: the vehicle is 1.50 m from start")
    laboratory.wait_for_standby(3)
    # Two flights, and between them one whose process is killed.
    laboratory.fly(2)
    station.wait_for_text("phase waypoint", timeout_s=120.0)
    assert station.press(Button.LOCK_RIGID) == NO, "in flight only the mission moves the lock"
    station.wait_for_text("two: completed", timeout_s=120.0)
    laboratory.wait_for_standby(4)
    laboratory.fly(1)
    station.wait_for_text("phase waypoint", 2, timeout_s=120.0)
    os.kill(laboratory.flight_process(), signal.SIGKILL)
    station.wait_for_text("one: the process was killed by SIGKILL: PX4's failsafe flies the vehicle")
    laboratory.wait_for_standby(5)
    assert station.press(Button.FLY, 1) == NO, "the vehicle is still in the air"
    station.wait_for_text("denied: the vehicle is armed")
    station.wait_disarmed()
    time.sleep(1.5)  # until standby has received it as well
    assert station.press(Button.LOCK_FLEXIBLE) == OK
    laboratory.fly(1)
    station.wait_for_text("one: completed", timeout_s=120.0)
    laboratory.wait_for_standby(6)


def test_ending_standby_lands_its_flight(laboratory: Laboratory) -> None:
    laboratory.wait_for_standby(1)
    laboratory.fly(2)
    laboratory.station.wait_for_text("phase waypoint", timeout_s=120.0)
    with pytest.raises(ServoInUseError, match=f"by dart-flight fly, process {laboratory.flight_process()}$"):
        laboratory.own_servo()
    laboratory.standby.send_signal(signal.SIGTERM)
    with limited("the flight lands and standby ends"):
        assert laboratory.standby.wait(60.0) == 0
    (end,) = (line for line in laboratory.printed_lines() if line.startswith("two: aborted"))
    assert "landing requested" in end


def test_landing_during_the_check_cancels_the_take_off(laboratory: Laboratory) -> None:
    station = laboratory.station
    laboratory.wait_for_standby(1)
    laboratory.fly(1)
    laboratory.wait_for_flight_process()

    def is_cancelled() -> bool:
        assert not station.armed
        return station.press(Button.LAND) == OK

    wait_until(is_cancelled, 60.0, "the land button is accepted")
    station.wait_for_text("take-off cancelled")
    station.wait_for_text("one: no-go", timeout_s=60.0)
    station.wait_for_text("operator: landing requested during the check")
    assert not station.was_armed


@pytest.mark.parametrize("laboratory", ["poses"], indirect=True)
def test_standby_forwards_motion_capture(laboratory: Laboratory) -> None:
    laboratory.wait_for_standby(1)
    pose = json.dumps({"position_m": [0.0, 0.0, 0.0], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}).encode()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as camera:

        def comes_back() -> int:
            camera.sendto(pose, ("127.0.0.1", laboratory.poses_port))
            return laboratory.station.poses

        wait_until(comes_back, 10.0, "a pose comes back through the vehicle")
