"""Statistics of poses: rate, gaps, age and the deviation of PX4's estimate."""

import math
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.geometry import RoomFrame, quaternion_from_euler
from dart_flight.base.records import AttitudeSample, OdometrySample, PoseSample
from dart_flight.vehicle.motion_capture.pose_statistics import PoseFigures, PoseStatistics

ROOM = RoomFrame(y_up=False, heading_rad=0.0)


def poses(times_us: Iterable[int], late_us: int = 0, **changes: object) -> list[PoseSample]:
    fields: dict[str, object] = {"tracked": True, "sender": "a:1", "source_us": 0} | changes
    return [
        PoseSample(
            t, t + late_us, "dart", position_room=(1.0, 2.0, 3.0), q_body_to_room=(1.0, 0.0, 0.0, 0.0),
            **fields | ({"source_us": t - 7_000_000} if fields["source_us"] is not None else {}),  # type: ignore[arg-type]
        )
        for t in times_us
    ]  # fmt: skip


def figures_of(found: list[PoseSample], now_us: int, delay_ms: float | None = None) -> PoseFigures:
    statistics = PoseStatistics(ROOM, delay_ms)
    for pose in found:
        statistics.update(pose)
    return statistics.figures(now_us)


@given(rate_hz=st.floats(5.0, 500.0), seconds=st.floats(1.0, 6.0))
def test_the_rate_is_measured_over_the_last_seconds(rate_hz: float, seconds: float) -> None:
    times = [round(1e6 * i / rate_hz) for i in range(round(seconds * rate_hz) + 1)]
    figures = figures_of(poses(times), times[-1])
    assert figures.rate_hz == pytest.approx(rate_hz, abs=1.01)
    assert figures.gaps == (len(times) - 1 if rate_hz < 9.999 else 0)
    assert figures.lost == 0.0


def test_lost_poses_count_as_a_gap() -> None:
    found = poses(range(0, 1_000_000, 10_000))
    found += poses(range(1_000_000, 1_500_000, 10_000), tracked=False)
    found += poses(range(1_500_000, 2_000_000, 10_000))
    figures = figures_of(found, 1_990_000)
    assert figures.gaps == 1
    assert figures.longest_gap_s == pytest.approx(0.51)
    assert figures.lost == pytest.approx(0.25)
    silent = figures_of(found, 5_000_000)
    assert silent.gaps == 2
    assert silent.longest_gap_s == pytest.approx(3.01)
    assert (silent.rate_hz, silent.senders, silent.distance_to_px4_m) == (0.0, (), None)


def test_age_is_relative_to_the_shortest_delay_and_growth_to_the_first_poses() -> None:
    found = poses(range(0, 1_000_000, 10_000), 4_000) + poses(range(1_000_000, 2_000_000, 10_000), 34_000)
    figures = figures_of(found, 2_030_000, delay_ms=12.0)
    assert figures.age_ms == pytest.approx(12.0 + 30.0)
    assert figures.age_growth_ms == pytest.approx(30.0)
    assert figures_of(poses(range(0, 100_000, 10_000), source_us=None), 100_000).age_ms is None


def test_stamps_that_have_turned_out_useless_leave_no_age() -> None:
    found = poses(range(0, 600_000, 10_000), 4_000) + poses(range(600_000, 2_000_000, 10_000), source_us=None)
    figures = figures_of(found, 2_000_000, delay_ms=12.0)
    assert (figures.age_ms, figures.age_growth_ms) == (None, None)


def test_both_senders_are_named_while_they_send() -> None:
    found = poses(range(0, 1_000_000, 20_000)) + poses(range(1_000_000, 2_000_000, 20_000), sender="b:2")
    assert figures_of(found, 2_000_000).senders == ("a:1", "b:2")
    assert figures_of(found, 3_500_000).senders == ("b:2",)


def test_px4s_estimate_is_compared_with_the_newest_pose() -> None:
    statistics = PoseStatistics(ROOM)
    for pose in poses([0, 10_000]):
        statistics.update(pose)
    position, _ = ROOM.pose_to_ned((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    n, e, d = position
    statistics.update(OdometrySample(10_000, 10_000, (n + 0.3, e, d - 0.4), (0.0, 0.0, 0.0)))
    statistics.update(AttitudeSample(10_000, 10_000, quaternion_from_euler(0.0, 0.0, math.radians(-25.0))))
    figures = statistics.figures(20_000)
    assert figures.distance_to_px4_m == pytest.approx(0.5)
    assert figures.angle_to_px4_deg == pytest.approx(25.0)
