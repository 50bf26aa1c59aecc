"""Frames of the simulated motion capture, with and without faults."""

import math
from pathlib import Path

import pytest

from dart_flight.base.geometry import (
    Quaternion,
    Vec3,
    quaternion_conjugate,
    quaternion_multiply,
    yaw_ned_of,
)
from dart_flight.config.vehicle.mocap import MotionCapture
from dart_flight.recording.verdict import Verdict
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import load_flyable, with_simulated_mocap
from dart_flight.sim.embedded_autopilot import make_autopilot
from dart_flight.sim.faults.fault_table import Fault
from dart_flight.sim.pose_feed import PoseFeed

SINGLE = Path(__file__).parents[2] / "missions/paper_single_wall.yaml"
MOCAP = MotionCapture(up="y", heading_deg=40.0, body_offset_m=(0.1, 0.0, 0.0))
LEVEL = (1.0, 0.0, 0.0, 0.0)


class Frames:
    """A publisher that stores time, tracked, position and attitude in NED of every frame."""

    def __init__(self) -> None:
        self.kept: list[tuple[int, bool, Vec3, Quaternion]] = []

    def publish(self, t_us: int, position_room: Vec3, q_body_to_room: Quaternion, tracked: bool) -> None:
        self.kept.append((t_us, tracked, *MOCAP.room_frame().pose_to_ned(position_room, q_body_to_room)))


def feed_poses(fault: Fault | None, seconds: float = 1.0) -> tuple[Frames, list[float]]:
    """Feed a vehicle that flies north at 1 m/s, with poses at 100 Hz; return frames and their times."""
    frames, times = Frames(), []
    feed = PoseFeed(MOCAP, frames.publish, (0.0, -2.0, 0.0))
    if fault is not None:
        feed.begin_fault(fault, 0.0)
    for tick in range(round(seconds / 0.004)):
        now_s = 0.004 * tick
        due = tick % 5 in (0, 3)
        if feed.tick(now_s, (now_s, (now_s, 0.0, -1.0), LEVEL) if due else None):
            times.append(now_s)
    assert feed.frames == len(frames.kept) == len(times)
    return frames, times


def test_every_pose_arrives_in_the_axes_of_the_room_without_a_fault() -> None:
    frames, times = feed_poses(None)
    assert len(times) == 100
    for t_us, tracked, position, q in frames.kept:
        assert tracked
        assert position == pytest.approx((1e-6 * t_us, 0.0, -1.0), abs=1e-9)
        assert abs(q[0]) == pytest.approx(1.0)


@pytest.mark.parametrize("seconds", [0.1, 0.3])
def test_a_lost_body_remains_in_the_frames_as_untracked(seconds: float) -> None:
    frames, _ = feed_poses(Fault("mocap-lost", seconds))
    lost = [1e-6 * t_us for t_us, tracked, _, _ in frames.kept if not tracked]
    assert min(lost) == 0.0
    assert max(lost) == pytest.approx(seconds, abs=0.012)


@pytest.mark.parametrize("angle_deg", [90.0, 180.0])
def test_swapped_markers_turn_the_body_about_its_origin(angle_deg: float) -> None:
    frames, _ = feed_poses(Fault("mocap-flip", angle_deg))
    _, _, _, q = frames.kept[-1]
    turn = quaternion_multiply(quaternion_conjugate(LEVEL), q)
    assert 2.0 * math.degrees(math.acos(min(1.0, abs(turn[0])))) == pytest.approx(angle_deg, abs=1e-3)


def test_the_pose_of_another_body_is_north_of_the_start() -> None:
    frames, _ = feed_poses(Fault("mocap-other-body", 1.5))
    assert {tuple(round(x, 6) for x in position) for _, _, position, _ in frames.kept} == {(1.5, -2.0, 0.0)}


@pytest.mark.parametrize("later_ms", [50.0, 150.0])
def test_late_poses_keep_the_stamp_of_their_measurement(later_ms: float) -> None:
    frames, times = feed_poses(Fault("mocap-late", later_ms))
    ages_s = [now_s - 1e-6 * frame[0] for now_s, frame in zip(times, frames.kept, strict=True)]
    assert min(ages_s) >= 1e-3 * later_ms - 1e-9
    assert max(ages_s) <= 1e-3 * later_ms + 0.004


def test_slow_poses_arrive_at_their_rate() -> None:
    _, times = feed_poses(Fault("mocap-slow", 10.0), 2.0)
    assert len(times) == pytest.approx(20, abs=1)


def test_the_embedded_autopilot_has_a_position_only_while_poses_arrive() -> None:
    autopilot = make_autopilot(load_flyable(SINGLE), 1)
    autopilot.use_external_poses()
    for _ in range(500):
        autopilot.step()
    assert not autopilot.estimator.ok
    for _ in range(100):
        autopilot.step()
        autopilot.fuse_external_pose(autopilot.plant.position, autopilot.plant.q)
    assert autopilot.estimator.ok
    for _ in range(1400):  # 5.6 s
        autopilot.step()
    assert not autopilot.estimator.ok


def test_poses_without_attitude_correct_the_position_but_not_the_heading() -> None:
    autopilot = make_autopilot(load_flyable(SINGLE), 1)
    autopilot.use_external_poses()
    for _ in range(300):
        autopilot.step()
        autopilot.fuse_external_pose(autopilot.plant.position, autopilot.plant.q)
    heading = yaw_ned_of(autopilot.estimator.q)
    for _ in range(1400):  # 5.6 s
        autopilot.step()
        autopilot.fuse_external_pose(autopilot.plant.position, None)
    assert autopilot.estimator.ok
    assert math.dist(autopilot.estimator.position, autopilot.plant.position) < 0.03
    assert yaw_ned_of(autopilot.estimator.q) == pytest.approx(heading, abs=math.radians(3.0))


def test_an_autopilot_with_its_own_position_ignores_poses() -> None:
    plain, sent = (make_autopilot(load_flyable(SINGLE), 1) for _ in range(2))
    for _ in range(200):
        plain.step()
        sent.step()
        sent.fuse_external_pose((9.0, 9.0, -9.0), LEVEL)
    assert sent.estimator.position == plain.estimator.position


def fly_on_forwarded_poses() -> Verdict:
    settings = ["simulation.pose_delay_s=0.03", "mocap.delay_ms=30", "mocap.up=y", "mocap.heading_deg=40"]
    mission = with_simulated_mocap(load_flyable(SINGLE, None, settings), "udp")
    return fly_fast(mission, 1, None)


@pytest.fixture(scope="module")
def on_forwarded_poses() -> Verdict:
    return fly_on_forwarded_poses()


def test_a_flight_on_forwarded_poses_completes(on_forwarded_poses: Verdict) -> None:
    assert on_forwarded_poses.outcome == "completed"
    assert on_forwarded_poses.ekf_error_m is not None
    assert on_forwarded_poses.ekf_error_m < 0.05


@pytest.mark.rest
def test_a_flight_on_forwarded_poses_is_reproducible(on_forwarded_poses: Verdict) -> None:
    assert fly_on_forwarded_poses() == on_forwarded_poses
