"""The position step with motion capture: findings from a motion by hand, and the delay that it writes."""

import argparse
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from dart_flight.base.geometry import Quaternion, Vec3
from dart_flight.base.records import AttitudeSample, ImuSample, PoseSample
from dart_flight.check.bringup.judgements import StepFinding, StepOutcome, evaluate_motion
from dart_flight.check.bringup.pose_motion import MotionEstimate, estimate_motion
from dart_flight.check.bringup.steps import Bringup
from dart_flight.cli.bringup_command import _write_delay  # the command around it asks a vehicle first
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import load_vehicle, packaged
from dart_flight.config.vehicle.mocap import MotionCapture
from dart_flight.run.fast import FastFlight
from dart_flight.run.prepare import with_simulated_mocap
from tests.check.bringup.test_pose_motion import Hand, Room, samples

MISSION = load_mission(packaged("missions", "single_wall.yaml"))
URL = "udp://0.0.0.0:9763/dart"
GOOD = MotionEstimate(0.03, 0.99, (0.6, 0.5, 0.8), np.eye(3), (0.0, 0.0, -1.0), 0.95, 2.0, 1.0)
TURNED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
ROLLED = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


class Link:
    """A link over which the hand's samples arrive."""

    pose_problem = "no object dart, only wand"

    def round_trip_s(self) -> float:
        return 0.004


class ScriptedOperator:
    """An operator who moves the vehicle on instruction; the samples of the motion arrive at once."""

    def __init__(self) -> None:
        self.instructions: list[str] = []
        self.actions: dict[str, Any] = {}

    def instruct(self, text: str) -> None:
        self.instructions.append(text)
        for word, action in self.actions.items():
            if word in text:
                action()

    def confirm(self, question: str) -> bool:
        return True


class FedBringup(Bringup):
    """The bring-up of a vehicle whose motion is computed.

    Args:
        true: the actual room.
        configured: the room in the configuration.
        hand: the vehicle's motion.
        other: the motion of the tracked body, if it differs from the vehicle's.
    """

    def __init__(
        self,
        true: MotionCapture,
        configured: MotionCapture,
        hand: Hand | None = None,
        other: Hand | None = None,
    ) -> None:
        self.hands = ScriptedOperator()
        vehicle = msgspec.structs.replace(MISSION.vehicle, mocap=configured)
        mission: Mission = msgspec.structs.replace(MISSION, vehicle=vehicle)
        super().__init__(mission, "serial:///dev/none:921600", self.hands, 1.0)
        imu_s, rates, forces = samples(hand or Hand(), Room())[3:]
        shown_s, positions, attitudes = samples(other or hand or Hand(), Room())[:3]
        room, t = true.room_frame(), self._telemetry

        def begin() -> None:
            t.store(make_pose(0.0, *room.pose_from_ned((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))))

        def move() -> None:
            for sample_s, rate, force in zip(imu_s, rates.tolist(), forces.tolist(), strict=True):
                t.store(ImuSample(round(1e6 * sample_s), round(1e6 * sample_s), tuple(force), tuple(rate)))
            for sample_s, position, q in zip(shown_s, positions.tolist(), attitudes.tolist(), strict=True):
                t.store(make_pose(sample_s, *room.pose_from_ned(tuple(position), tuple(q))))
                t.store(AttitudeSample(round(1e6 * sample_s) - 30_000, round(1e6 * sample_s), tuple(q)))

        self.hands.actions = {"Waiting": begin, "turn the vehicle left": move}

    def measure(self) -> StepFinding:
        return self._measure_poses(Link())  # type: ignore[arg-type]


def make_pose(at_s: float, position: Vec3, q: Quaternion) -> PoseSample:
    return PoseSample(round(1e6 * at_s), round(1e6 * at_s), "dart", True, position, q, None, None, "a:1")


ROOMS = [
    MotionCapture(url=URL),
    MotionCapture(url=URL, up="y", heading_deg=70.0, body_yaw_deg=-40.0),
    MotionCapture(url=URL, heading_deg=-120.0, body_yaw_deg=150.0, body_offset_m=(0.05, 0.0, 0.02)),
]


@pytest.mark.parametrize("room", ROOMS)
def test_a_correctly_configured_room_passes(room: MotionCapture) -> None:
    found = FedBringup(room, room).measure()
    assert found.result is StepOutcome.PASS, found.message
    assert found.measured["delay_ms"] == pytest.approx(34.0, abs=2.0)
    assert found.measured["heading_error_deg"] == pytest.approx(0.0, abs=1.0)
    assert "34 ms old when they reach PX4" in found.message


def test_the_proposed_body_yaw_is_correct() -> None:
    true = MotionCapture(url=URL, up="y", body_yaw_deg=50.0)
    found = FedBringup(true, MotionCapture(url=URL, up="y", body_yaw_deg=10.0)).measure()
    assert found.message.startswith("the body's yaw is wrong: set mocap.body_yaw_deg to ")
    assert float(found.message.split()[-1]) == pytest.approx(50.0, abs=1.0)


@pytest.mark.parametrize(("true", "configured", "axis"), [("y", "z", "y"), ("z", "y", "z")])
def test_a_wrong_axis_is_named(true: Any, configured: Any, axis: str) -> None:
    found = FedBringup(MotionCapture(url=URL, up=true), MotionCapture(url=URL, up=configured)).measure()
    assert found.message == f"wrong axis: the room's {axis} axis points up, but mocap.up is {configured}"


def test_another_vehicles_body_is_named() -> None:
    found = FedBringup(ROOMS[0], ROOMS[0], Hand(1), Hand(4)).measure()
    assert f"the body {URL} does not rotate with this vehicle" in found.message


def test_missing_poses_are_reported_with_the_sources_reason() -> None:
    bringup = FedBringup(ROOMS[0], ROOMS[0])
    bringup.hands.actions = {}
    assert bringup.measure().message == f"no poses from {URL}: no object dart, only wand"
    assert "No poses yet: no object dart, only wand." in bringup.hands.instructions


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"rate_correlation": 0.6}, "the body belongs to another vehicle"),
        ({"force_correlation": -0.9}, "the room is mirrored"),
        ({"up_room": (0.0, -1.0, 0.0)}, "wrong axis: the room's y axis points up, but mocap.up is z"),
        ({"body_to_frd": ROLLED}, "wrong axis: the body is tilted by 90 degrees"),
        ({"body_to_frd": TURNED}, "set mocap.body_yaw_deg to 90"),
        ({"force_correlation": 0.3}, "does not match the accelerometer"),
        ({"scale": 0.001}, "lengths are 0.00 times"),
        ({"latency_s": 0.12}, "poses are 124 ms old when they reach PX4, limit 100 ms"),
    ],
)
def test_each_defect_is_named(changes: dict[str, Any], says: str) -> None:
    found = evaluate_motion(GOOD._replace(**changes), MotionCapture(url=URL), 0.004, 0.0)
    assert found.result is StepOutcome.FAIL
    assert says in found.message


def test_a_heading_difference_to_px4_is_named() -> None:
    found = evaluate_motion(GOOD, MotionCapture(url=URL), None, -45.0)
    assert "PX4's heading is -45 degrees off the heading of the poses" in found.message
    assert math.isclose(float(found.measured["delay_ms"] or 0.0), 30.0)


# --- the configuration ---------------------------------------------------------------------------------


def test_the_measured_age_is_written_into_the_configuration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "vehicle.yaml"
    path.write_text(packaged("configs", "dart.yaml").read_text())
    _write_delay(argparse.Namespace(config=str(path)), str(path), 31.5)
    assert load_vehicle(path).mocap.delay_ms == 31.5
    assert "wrote mocap.delay_ms 31.5" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["airframe: {mass_kg: 1.0}\n", ""])
def test_a_configuration_without_the_key_is_not_changed(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "vehicle.yaml"
    path.write_text(text)
    _write_delay(argparse.Namespace(config=str(path)), str(path), 31.5)
    assert path.read_text() == text
    assert "set mocap.delay_ms to 31.5 by hand" in capsys.readouterr().err


def test_the_packaged_configuration_is_never_written(capsys: pytest.CaptureFixture[str]) -> None:
    path = packaged("configs", "dart.yaml")
    before = path.read_bytes()
    _write_delay(argparse.Namespace(config=None), str(path), 31.5)
    assert path.read_bytes() == before
    assert "is the packaged default; copy it" in capsys.readouterr().err


# --- a flight ------------------------------------------------------------------------------------------


def test_the_age_of_poses_is_estimated_from_a_simulated_flight() -> None:
    """The flight includes a contact, and each pose is sent at the next 4 ms tick."""
    delay_s = 0.05
    settings = [
        f"simulation.pose_delay_s={delay_s}",
        "mocap.up=y",
        "mocap.heading_deg=65",
        "mocap.body_yaw_deg=20",
    ]
    mission = load_mission(packaged("missions", "single_wall.yaml"), settings=settings)
    flight = FastFlight(with_simulated_mocap(mission, "optitrack"), 1)
    inputs: list[Any] = []
    step = flight.core.step

    def record_and_step(item: Any) -> Any:
        inputs.append(item)
        return step(item)

    flight.core.step = record_and_step  # type: ignore[method-assign]
    flight.run()
    imu = [item for item in inputs if isinstance(item, ImuSample)]
    poses = [item for item in inputs if isinstance(item, PoseSample)]
    room = mission.vehicle.mocap.room_frame()
    shown = [room.pose_to_ned(p.position_room, p.q_body_to_room) for p in poses]
    found = estimate_motion(
        np.array([1e-6 * p.t_us for p in poses]),
        np.array([position for position, _ in shown]),
        np.array([q for _, q in shown]),
        np.array([1e-6 * s.t_us for s in imu]),
        np.array([s.rate_frd for s in imu]),
        np.array([s.specific_force_frd for s in imu]),
    )
    assert found.latency_s == pytest.approx(delay_s, abs=0.004)
    assert found.rate_correlation > 0.99
    assert found.force_correlation > 0.99
    assert found.scale == pytest.approx(1.0, abs=0.02)
    assert found.body_to_frd == pytest.approx(np.eye(3), abs=0.02)
