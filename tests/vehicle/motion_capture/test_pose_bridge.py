"""The motion capture bridge: conversion to ODOMETRY, decimation, and delivered records."""

import json
import random
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.records import PoseSample
from dart_flight.config.vehicle.mocap import MotionCapture
from dart_flight.vehicle.clock import SimulatedTime
from dart_flight.vehicle.motion_capture.pose_bridge import (
    Decimation,
    MotionCaptureBridge,
    StaleFrames,
    forwarded_pose,
)
from dart_flight.vehicle.motion_capture.source import RawPose, lost_pose


class HandSource:
    """A source whose poses the test delivers."""

    problem: str | None = None
    place, remedy = "listening on home", "send poses"

    def start(self, deliver: Callable[[RawPose], None]) -> None:
        self.deliver = deliver

    def stop(self) -> None:
        self.stopped = True


def make_bridge(
    config: MotionCapture, clock: SimulatedTime | None = None
) -> tuple[MotionCaptureBridge, HandSource, list[Any], list[PoseSample]]:
    source, clock = HandSource(), clock or SimulatedTime()
    clock.receive(5_000_000, 0)
    sent: list[Any] = []
    delivered: list[PoseSample] = []
    bridge = MotionCaptureBridge(config, source, sent.append, clock, delivered.append)
    bridge.start()
    return bridge, source, sent, delivered


def pose(source_us: int, tracked: bool = True) -> RawPose:
    return RawPose("dart", tracked, (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), None, source_us, "a:1")


def test_a_pose_is_sent_as_odometry_in_local_ned() -> None:
    config = MotionCapture(heading_deg=30.0, body_yaw_deg=20.0, body_offset_m=(0.1, 0.0, -0.05))
    bridge, _, sent, delivered = make_bridge(config)
    bridge.forward(pose(0))
    fields = json.loads(sent[0].fields_json)
    position, attitude = config.room_frame().pose_to_ned((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    assert (fields["x"], fields["y"], fields["z"]) == pytest.approx(position)
    assert fields["q"] == pytest.approx(attitude)
    assert (fields["frame_id"], fields["estimator_type"], fields["time_usec"]) == (1, 2, 5_000_000)
    assert fields["vx"] is fields["yawspeed"] is fields["velocity_covariance"][0] is None
    assert fields["pose_covariance"][0] == fields["pose_covariance"][20] == pytest.approx(1e-4)
    assert len(fields["pose_covariance"]) == 21
    assert delivered == [PoseSample(5_000_000, 5_000_000, *pose(0))]


def test_a_lost_pose_is_delivered_but_not_sent() -> None:
    bridge, source, sent, delivered = make_bridge(MotionCapture())
    bridge.forward(lost_pose("dart", 1, 20_000, "a:1"))
    assert (sent, [p.tracked for p in delivered]) == ([], [False])
    bridge.stop()
    bridge.forward(pose(40_000))
    assert (len(sent), source.stopped, len(delivered)) == (0, True, 1)


def test_withheld_attitudes_keep_the_position_and_withheld_poses_are_not_sent() -> None:
    bridge, _, sent, delivered = make_bridge(MotionCapture())
    bridge.withhold(attitude_only=True)
    bridge.forward(pose(0))
    assert forwarded_pose(sent[0]).attitude is None
    assert forwarded_pose(sent[0]).x == 1.0
    bridge.withhold(attitude_only=False)
    bridge.withhold(attitude_only=True)
    bridge.forward(pose(40_000))
    assert (len(sent), len(delivered)) == (1, 2)


@settings(max_examples=40)
@given(rate_hz=st.floats(20.0, 200.0), source_hz=st.floats(20.0, 500.0), seed=st.integers(0, 10**6))
def test_decimation_reaches_the_mean_rate_with_even_gaps(rate_hz: float, source_hz: float, seed: int) -> None:
    frame_us, period_us, jitter = 1e6 / source_hz, 1e6 / rate_hz, random.Random(seed)
    stamps = [round(i * frame_us) + jitter.randint(-300, 300) for i in range(600)]
    decimation = Decimation(rate_hz)
    selected = [t for t in stamps if decimation.selects(t)]
    mean_us = (selected[-1] - selected[0]) / (len(selected) - 1)
    assert mean_us == pytest.approx(max(frame_us, period_us), rel=0.03)
    longest = max(frame_us, period_us) + frame_us + 1300
    assert max(b - a for a, b in pairwise(selected)) <= longest + 0.125 * period_us


def test_decimation_from_240_hz_to_50_hz_keeps_every_fourth_or_fifth_pose() -> None:
    decimation = Decimation(50.0)
    selected = [i for i in range(2401) if decimation.selects(round(i * 1e6 / 240))]
    assert len(selected) == 501
    assert {b - a for a, b in pairwise(selected)} == {4, 5}


@pytest.mark.parametrize("jump_us", [-10_000_000, 10_000_000])
def test_decimation_continues_after_a_clock_jump(jump_us: int) -> None:
    decimation = Decimation(50.0)
    assert decimation.selects(0)
    assert decimation.selects(jump_us)
    assert not decimation.selects(jump_us + 5_000)
    assert decimation.selects(jump_us + 20_000)


def test_only_the_newest_poses_of_a_burst_after_an_outage_are_sent() -> None:
    """The core receives them all, and the rule `pose_source` acts on the outage."""
    bridge, _, sent, delivered = make_bridge(MotionCapture(), clock := SimulatedTime())

    def forward(stamps_us: range, received_us: int | None = None) -> int:
        before = len(sent)
        for stamp_us in stamps_us:
            clock.receive(5_000_000 + (received_us or stamp_us + 10_000), 0)
            bridge.forward(pose(stamp_us))
        return len(sent) - before

    assert forward(range(0, 1_000_000, 20_000)) == 50
    assert forward(range(1_000_000, 4_000_000, 20_000), 4_000_000) == 15  # those of the last 0.31 s
    assert forward(range(4_000_000, 5_000_000, 20_000)) == 50
    assert len(delivered) == 250


@given(st.lists(st.integers(0, 300_000), min_size=1, max_size=50))
def test_a_pose_within_the_allowed_growth_of_latency_is_never_stale(latencies_us: list[int]) -> None:
    stale = StaleFrames()
    for number, latency_us in enumerate(latencies_us):
        assert not stale.contains(20_000 * number, 20_000 * number + latency_us)


@pytest.mark.parametrize("jump_us", [-10_000_000, 10_000_000])
def test_poses_are_fresh_within_a_second_of_a_clock_jump_of_the_source(jump_us: int) -> None:
    stale = StaleFrames()
    times_us = range(0, 3_000_000, 10_000)
    found = [stale.contains(t + (jump_us if t >= 1_000_000 else 0), t) for t in times_us]
    assert not any(found[:100])
    assert sum(found) <= 101
    assert not any(found[-50:])


@pytest.mark.parametrize("drift", [-2e-4, 2e-4])
def test_poses_stay_fresh_while_the_sources_clock_drifts_for_hours(drift: float) -> None:
    """Standby forwards poses all day."""
    stale = StaleFrames()
    assert not any(stale.contains(round(t * (1.0 + drift)), t) for t in range(0, 10_000_000_000, 500_000))


def moving_pose(number: int, stamp_us: int | None) -> RawPose:
    """Return a pose that differs from the previous one by a camera's noise."""
    return pose(0)._replace(position_room=(1.0 + 1e-5 * (number % 7), 2.0, 3.0), source_us=stamp_us)


# name -> stamp of the frame with this number, at 100 Hz
USELESS_STAMPS: dict[str, Callable[[int], int | None]] = {
    "never filled": lambda i: 0,
    "whole seconds of the day": lambda i: 1_700_000_000_000_000 + 1_000_000 * (i // 100),
    "tenths of a second": lambda i: 100_000 * (i // 10),
    "the frame's number": lambda i: 1_000_000 * i,
    "milliseconds instead of seconds": lambda i: 10_000_000 * i,
    "a clock that runs backwards": lambda i: -10_000 * i,
    "none": lambda i: None,
}


def forward_all(
    raws: list[RawPose], config: MotionCapture | None = None
) -> tuple[MotionCaptureBridge, list[Any], list[PoseSample]]:
    """Return a bridge that has forwarded poses at 100 Hz, and what it sent and delivered."""
    bridge, _, sent, delivered = make_bridge(config or MotionCapture(), clock := SimulatedTime())
    for number, raw in enumerate(raws):
        clock.receive(6_000_000 + 10_000 * number, 0)
        bridge.forward(raw)
    return bridge, sent, delivered


@pytest.mark.parametrize("kind", USELESS_STAMPS)
def test_poses_with_useless_stamps_count_by_their_time_of_arrival(kind: str) -> None:
    stamps = USELESS_STAMPS[kind]
    bridge, sent, delivered = forward_all([moving_pose(i, stamps(i)) for i in range(800)])
    # At most 0.6 s until the decision, and 1 s until poses by another clock are not stale any more.
    assert len(sent) >= 50 * (8.0 - 1.6)
    assert delivered[-1].source_us is None
    assert (bridge.problem, bridge.missing) == (None, None)


@pytest.mark.parametrize("step_us", [4_167, 10_000, 15_625, 20_000])
def test_good_stamps_stay_and_if_they_stop_the_poses_are_lost(step_us: int) -> None:
    good = [moving_pose(i, 10_000 * i // step_us * step_us) for i in range(200)]
    assert len(forward_all(good)[1]) == pytest.approx(100, abs=24)
    bridge, sent, delivered = forward_all(good + [moving_pose(i, good[-1].source_us) for i in range(600)])
    assert len(sent) <= 102
    assert delivered[-1].source_us == good[-1].source_us
    assert "the pose stamps have not changed for 6 s" in str(bridge.missing)


def test_a_server_that_repeats_one_frame_is_not_taken_for_a_body_at_rest() -> None:
    bridge, sent, delivered = forward_all([pose(0)] * 800)
    assert len(sent) == 1
    assert delivered[-1].source_us == 0
    assert "the pose stamps have not changed" in str(bridge.missing)


def test_a_source_that_sends_nothing_or_no_body_is_named_within_five_seconds() -> None:
    bridge, source, _, _ = make_bridge(MotionCapture(), clock := SimulatedTime())
    assert bridge.missing is None
    clock.receive(5_000_000 + 4_000_000, 0)
    assert bridge.missing == "no frame for 4 s (listening on home): send poses"
    bridge.forward(lost_pose("dart ", 1, 20_000, "a:1"))
    assert bridge.missing == 'body "dart " not tracked for 4 s: check markers and cameras'
    source.problem = "no object"
    assert bridge.missing == "no object"
    source.problem = None
    bridge.forward(pose(40_000))
    assert (bridge.problem, bridge.missing) == (None, None)
