"""Bring-up of a vehicle on a real pseudo-terminal, without faults and with each possible fault."""

from __future__ import annotations

import json
import os
import queue
import statistics
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest

from dart_flight.base.geometry import Quaternion, Vec3
from dart_flight.check.bringup.judgements import StepFinding, StepOutcome
from dart_flight.check.bringup.steps import STEPS, Bringup
from dart_flight.cli import main
from dart_flight.config.mission import Mission, load_empty_room, load_mission
from dart_flight.config.vehicle import LockDriver, packaged
from dart_flight.config.vehicle.mocap import MotionCapture
from dart_flight.lock.drivers import owned_driver
from dart_flight.lock.persistence import ServoInUseError
from dart_flight.sim.motion_capture import make_server
from dart_flight.vehicle.clock import host_us
from dart_flight.vehicle.vehicle_session import NoAnswerError
from tests.check.bringup.test_pose_motion import Hand
from tests.doubles.bench_vehicle import BenchVehicle
from tests.doubles.emulated_maestro import EmulatedMaestro
from tests.real_time import TooSlow, assert_not_later

MISSION = load_mission(packaged("missions", "single_wall.yaml"))
WAIT_S = 6.0


class ScriptedOperator:
    """An operator who follows instructions and answers questions about the lock's motion."""

    def __init__(
        self, vehicle: BenchVehicle | None = None, answer: Callable[[str], bool] = lambda _: True
    ) -> None:
        self.answer, self.instructions = answer, list[str]()
        self._actions: dict[str, Callable[[], None]] = {}
        if vehicle is not None:
            self._actions = {
                "nose down": lambda: vehicle.tilt(pitch_deg=-30.0),
                "right side down": lambda: vehicle.tilt(roll_deg=30.0),
                "Push": vehicle.push,
                "along its nose": lambda: vehicle.carry(0.0),
                "to its right": lambda: vehicle.carry(90.0),
                "evel": vehicle.tilt,
                "switch": vehicle.flip_switch,
                "turn the vehicle left": vehicle.move,
            }

    def instruct(self, text: str) -> None:
        self.instructions.append(text)
        for word, action in self._actions.items():
            if word in text:
                action()
                return

    def confirm(self, question: str) -> bool:
        return self.answer(question)


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "state"))


def run_step(bringup: Bringup, name: str) -> StepFinding:
    return bringup.do(next(step for step in STEPS if step.name == name))


def run_steps(vehicle: BenchVehicle, *names: str) -> dict[str, StepFinding]:
    bringup = Bringup(MISSION, vehicle.url, ScriptedOperator(vehicle), WAIT_S)
    try:
        return {name: run_step(bringup, name) for name in names}
    finally:
        bringup.close()


# Beginnings of findings that the load of the computer may cause.
LATE = ("not detected within", "too slow: ", "the round trip takes")


def assert_passed(found: StepFinding) -> None:
    if found.result is not StepOutcome.PASS:
        raise (TooSlow if found.message.startswith(LATE) else AssertionError)(found.message)


TELEMETRY_STEPS = ("link", "imu_axes", "force_sign", "position", "remote_control")


@pytest.mark.realtime
@pytest.mark.mavlink
def test_every_step_of_a_good_vehicle_passes() -> None:
    with BenchVehicle(MISSION) as vehicle:
        found = run_steps(vehicle, *TELEMETRY_STEPS)
    for finding in found.values():
        assert_passed(finding)
    assert_not_later(-float(found["link"].measured["imu_hz"] or 0.0), -150.0, "minus the IMU's rate")
    direction_deg = found["force_sign"].measured["force_direction_deg"]
    assert isinstance(direction_deg, float)  # 0 is a valid direction
    assert abs(direction_deg) < 10.0


@pytest.mark.realtime
@pytest.mark.mavlink
def test_each_fault_of_the_vehicle_is_named() -> None:
    with BenchVehicle(MISSION, wrong=("axes", "frame", "radio")) as vehicle:
        found = run_steps(vehicle, "imu_axes", "position", "remote_control")
    assert {f.result for f in found.values()} == {StepOutcome.FAIL}
    late = [f.message for f in found.values() if f.message.startswith(LATE)]
    if late:
        raise TooSlow(late[0])
    assert "rotated by 90 degrees: set SENS_BOARD_ROT" in found["imu_axes"].message
    assert "left and right are swapped" in found["position"].message
    assert "PX4 receives no remote control" in found["remote_control"].message


@pytest.mark.realtime
@pytest.mark.mavlink
def test_a_wrong_baud_rate_is_recognised() -> None:
    with BenchVehicle(MISSION) as vehicle:
        url = vehicle.url.replace("921600", "57600")
        bringup = Bringup(MISSION, url, ScriptedOperator(vehicle), 3.0)
        found = run_step(bringup, "link")
        bringup.close()
    assert found.result is StepOutcome.FAIL
    assert found.message == (
        "wrong baud rate: MAVLink arrives at 921600, but the link's URL has 57600: correct the URL or "
        "SER_TEL2_BAUD"
    )


@pytest.fixture
def maestro(tmp_path: Path) -> Iterator[Mission]:
    """Yield the mission of a vehicle whose lock is moved by an emulated Maestro."""
    lock = MISSION.vehicle.lock
    assert lock is not None
    port = tmp_path / "maestro"
    lock = msgspec.structs.replace(
        lock, driver=LockDriver.MAESTRO, maestro=msgspec.structs.replace(lock.maestro, port=str(port))
    )
    vehicle = msgspec.structs.replace(MISSION.vehicle, lock=lock)
    channel = lock.maestro.channel
    horn_us = lock.servo.flexible_pulse_us
    with EmulatedMaestro(lock.servo, port, host_us, channel=channel, horn_us=horn_us):
        yield msgspec.structs.replace(MISSION, vehicle=vehicle)


@pytest.mark.parametrize(
    ("answer", "result", "message"),
    [
        (lambda question: True, StepOutcome.PASS, "the lock reaches both ends"),
        (
            lambda question: "Commanded" not in question,
            StepOutcome.FAIL,
            "the lock moves in the wrong direction",
        ),
        (
            lambda question: "Commanded rigid" not in question,
            StepOutcome.FAIL,
            "commanded rigid, but the arms are not rigid",
        ),
        (lambda question: False, StepOutcome.NEEDS_OPERATOR, "was not moved"),
    ],
)
def test_the_operator_confirms_the_direction_of_the_servo(
    maestro: Mission, answer: Callable[[str], bool], result: StepOutcome, message: str
) -> None:
    found = run_step(Bringup(maestro, "udpin://127.0.0.1:14999", ScriptedOperator(answer=answer)), "servo")
    assert found.result is result
    assert message in found.message
    if result is StepOutcome.PASS:
        assert 0.05 < float(found.measured["rigid_travel_s"] or 0.0) < 2.0


def test_a_servo_in_use_ends_the_bring_up(maestro: Mission) -> None:
    assert maestro.vehicle.lock is not None
    bringup = Bringup(maestro, "udpin://127.0.0.1:14999", ScriptedOperator())
    with (
        owned_driver(maestro.vehicle.lock, clock_us=host_us),
        pytest.raises(ServoInUseError, match=f"process {os.getpid()}$"),
    ):
        run_step(bringup, "servo")


def test_an_unplugged_servo_controller_is_named() -> None:
    lock = MISSION.vehicle.lock
    assert lock is not None
    lock = msgspec.structs.replace(lock, driver=LockDriver.MAESTRO)
    mission = msgspec.structs.replace(MISSION, vehicle=msgspec.structs.replace(MISSION.vehicle, lock=lock))
    found = run_step(Bringup(mission, "udpin://127.0.0.1:14999", ScriptedOperator()), "servo")
    assert found.result is StepOutcome.FAIL
    assert lock.maestro.port in found.message


@pytest.mark.realtime
@pytest.mark.mavlink
def test_passed_steps_are_stored_and_not_repeated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "bench"
    with BenchVehicle(MISSION) as vehicle:
        command = ["bringup", "--connection", vehicle.url, "--state", str(folder), "--yes", "--json"]
        assert main(command) == 0
        first = json.loads(capsys.readouterr().out)
        assert main(command) == 0
        second = json.loads(capsys.readouterr().out)
    result, *others = (step["result"] for step in first["steps"])
    if result != "pass" and first["steps"][0]["message"].startswith(LATE):
        raise TooSlow(first["steps"][0]["message"])
    assert [result, *others] == ["pass", *["needs operator"] * 5]
    dated, page = (Path(name) for name in first["files"])
    assert json.loads(dated.read_text())["steps"] == second["steps"]
    assert "needs an operator at the vehicle" in page.read_text()
    assert second["steps"][0] == first["steps"][0]  # a passed step is not repeated


@pytest.mark.parametrize(("vehicle", "by_hand"), [("dart", 5), ("rigid_cage", 4), ("ring_guard_250g", 4)])
def test_the_servo_step_of_a_vehicle_without_a_lock_needs_no_operator(vehicle: str, by_hand: int) -> None:
    mission = load_empty_room(packaged("configs", f"{vehicle}.yaml"))
    bringup = Bringup(mission, "udpin://127.0.0.1:14999", ScriptedOperator())
    assert sum(bringup.needs_operator(step) for step in STEPS) == by_hand
    if not mission.vehicle.has_lock:
        assert run_step(bringup, "servo").result is StepOutcome.SKIPPED


@pytest.mark.parametrize("content", [b"{}", b'{"vehicle": "\xff"}'])
def test_a_foreign_state_file_is_refused(
    content: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bringup.json").write_bytes(content)
    assert (
        main(["bringup", "--connection", "udpin://127.0.0.1:14999", "--state", str(tmp_path), "--yes"]) == 2
    )
    assert "not a bring-up record of dart-flight" in capsys.readouterr().err


def test_an_unreadable_state_file_is_not_reported_as_foreign(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bringup.json").mkdir()
    assert (
        main(["bringup", "--connection", "udpin://127.0.0.1:14999", "--state", str(tmp_path), "--yes"]) == 2
    )
    assert capsys.readouterr().err.strip().endswith("bringup.json: cannot read: Is a directory")


def test_a_vehicle_that_answers_no_requests_fails_the_link_step(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: Bringup) -> None:
        raise NoAnswerError("sends telemetry but does not answer requests: TIMESYNC")

    monkeypatch.setattr(Bringup, "_connect", refuse)
    found = run_step(Bringup(MISSION, "udpin://127.0.0.1:14999", ScriptedOperator()), "link")
    assert found.result is StepOutcome.FAIL
    assert "does not answer requests: TIMESYNC" in found.message


@pytest.mark.realtime
@pytest.mark.mavlink
def test_the_age_of_poses_is_measured_over_the_real_link() -> None:
    delay_s = 0.04
    room = MotionCapture(up="y", heading_deg=40.0, body_yaw_deg=15.0)
    hand, server, ages_s = Hand(), make_server("optitrack", "dart"), list[float]()
    waiting: queue.SimpleQueue[tuple[float, int, Vec3, Quaternion] | None] = queue.SimpleQueue()

    def publish(t_us: int, position: Vec3, q: Quaternion) -> None:
        waiting.put((time.monotonic(), t_us, *room.room_frame().pose_from_ned(position, q)))

    def deliver() -> None:
        while (frame := waiting.get()) is not None:
            began_s, t_us, position, q = frame
            time.sleep(max(0.0, began_s + delay_s - time.monotonic()))
            ages_s.append(time.monotonic() - began_s)  # a busy computer may oversleep
            server.publish(t_us, position, q)

    delivering = threading.Thread(target=deliver)
    delivering.start()

    vehicle_config = msgspec.structs.replace(
        MISSION.vehicle, mocap=msgspec.structs.replace(room, url=server.url)
    )
    mission = msgspec.structs.replace(MISSION, vehicle=vehicle_config)
    with BenchVehicle(
        MISSION, motion=lambda t: (hand.position(t), hand.attitude(t)), publish=publish
    ) as vehicle:
        bringup = Bringup(mission, vehicle.url, ScriptedOperator(vehicle), 30.0)
        try:
            # The whole step goes on to carry the vehicle, which is not possible beside a motion by hand.
            found = bringup._measure_poses(bringup._connect())
        finally:
            bringup.close()
    waiting.put(None)
    delivering.join()
    server.close()
    assert_passed(found)
    # The serial line's round trip and the reading threads add to the age.
    age_ms, measured_ms = 1e3 * statistics.median(ages_s), float(found.measured["delay_ms"] or 0.0)
    assert measured_ms > age_ms - 5.0
    assert_not_later(measured_ms, age_ms + 45.0, "the measured age")
    assert found.measured["scale"] == pytest.approx(1.0, abs=0.05)
