"""Findings of `check` about motion capture before a flight."""

import msgspec
import pytest

from dart_flight.check.pose_check import evaluate_poses
from dart_flight.config.vehicle.mocap import MotionCapture
from dart_flight.vehicle.ground_link import Observation, Source
from dart_flight.vehicle.motion_capture.pose_statistics import PoseFigures
from dart_flight.vehicle.vehicle_session import Sender

CONFIG = MotionCapture(url="udp://0.0.0.0:9763/dart")
GOOD = PoseFigures(
    rate_hz=100.0,
    longest_gap_s=0.012,
    age_ms=12.0,
    age_growth_ms=1.0,
    distance_to_px4_m=0.01,
    angle_to_px4_deg=0.5,
    senders=("a:1",),
)


def test_good_poses_give_a_single_go_finding() -> None:
    (finding,) = evaluate_poses(CONFIG, Observation(poses=GOOD))
    assert finding.go
    assert finding.item == "pose_source"
    assert finding.message == "100 poses/s, 12 ms old; PX4's estimate is 0.01 m and 0.5 deg off"


def test_a_vehicle_without_motion_capture_has_no_pose_findings() -> None:
    assert evaluate_poses(MotionCapture(), Observation()) == []


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"rate_hz": 0.0}, "no poses from udp://0.0.0.0:9763/dart: the body is not tracked"),
        ({"rate_hz": 30.0}, "30 poses/s, minimum 40"),
        ({"lost": 0.2}, "body lost in 20 %"),
        ({"gaps": 2, "longest_gap_s": 0.4}, "2 gaps of more than 0.1 s, longest 0.40 s"),
        ({"senders": ("a:1", "b:2")}, "two sources send the body: a:1, b:2"),
        ({"age_growth_ms": 35.0}, "grew by 35 ms"),
        ({"age_ms": 140.0}, "140 ms old, limit 100 ms"),
        ({"distance_to_px4_m": None}, "PX4 has no estimate from the poses"),
        ({"angle_to_px4_deg": 90.0}, "0.01 m and 90 deg off the poses"),
    ],
)
def test_a_defect_of_the_poses_is_a_no_go_with_its_cause(changes: dict[str, object], says: str) -> None:
    (finding,) = evaluate_poses(CONFIG, Observation(poses=msgspec.structs.replace(GOOD, **changes)))
    assert not finding.go
    assert says in finding.message


def test_absent_cameras_are_a_no_go_among_the_other_findings() -> None:
    (finding,) = evaluate_poses(CONFIG, Observation(pose_problem="no server answers"))
    assert (finding.go, finding.message) == (False, "no poses: no server answers")


def test_every_defect_has_its_own_finding() -> None:
    poses = msgspec.structs.replace(GOOD, rate_hz=30.0, gaps=1, senders=("a:1", "b:2"), age_growth_ms=50.0)
    assert [finding.go for finding in evaluate_poses(CONFIG, Observation(poses=poses))] == [False] * 4


def test_the_sources_own_reason_is_reported() -> None:
    observed = Observation(poses=PoseFigures(), pose_problem="no object dart, only wand")
    assert "no object dart, only wand" in evaluate_poses(CONFIG, observed)[0].message


def test_poses_without_usable_stamps_are_go_with_the_remark_that_their_delay_is_not_watched() -> None:
    poses = msgspec.structs.replace(GOOD, age_ms=None, age_growth_ms=None)
    good, remark = evaluate_poses(CONFIG, Observation(poses=poses))
    assert (good.go, remark.go, remark.remark) == (True, True, True)
    assert "cannot detect growing delays" in remark.message


def test_stamps_that_stand_still_are_named_instead_of_an_age() -> None:
    poses = msgspec.structs.replace(GOOD, age_ms=4_000.0, age_growth_ms=4_000.0)
    observed = Observation(poses=poses, pose_problem="the stamps of the poses stand still for 4 s")
    (finding,) = evaluate_poses(CONFIG, observed)
    assert (finding.go, finding.message) == (False, "the stamps of the poses stand still for 4 s")


def test_another_sender_of_timesync_is_a_remark() -> None:
    sources = tuple(
        Source(Sender("TIMESYNC", 1, component, 0), 10.0, 10.0, component == 1, "") for component in (1, 191)
    )
    _, remark = evaluate_poses(CONFIG, Observation(poses=GOOD, sources=sources))
    assert remark.remark
    assert "system 1 component 191 sends TIMESYNC" in remark.message
