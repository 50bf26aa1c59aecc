"""Evaluation of samples by the steps of a bring-up."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.geometry import GRAVITY_M_S2, Vec3, quaternion_from_euler, rotate_back
from dart_flight.base.records import ImuSample, OdometrySample
from dart_flight.check.bringup.judgements import (
    StepOutcome,
    evaluate_axes,
    evaluate_level,
    evaluate_link,
    evaluate_position,
    evaluate_push,
    find_push,
    mean_while_still,
    measure_displacement,
)
from dart_flight.check.telemetry_check import stream_rates
from dart_flight.vehicle.baud_rate import has_frames

UP = (0.0, 0.0, -GRAVITY_M_S2)


def reading(roll_deg: float, pitch_deg: float) -> Vec3:
    return rotate_back(quaternion_from_euler(math.radians(roll_deg), math.radians(pitch_deg), 0.4), UP)


def rotated(v: Vec3, by_deg: float) -> Vec3:
    c, s = math.cos(math.radians(by_deg)), math.sin(math.radians(by_deg))
    return (c * v[0] - s * v[1], s * v[0] + c * v[1], v[2])


@given(
    st.sampled_from([0, 90, 180, -90]), st.floats(22.0, 50.0), st.floats(22.0, 50.0), st.floats(-20.0, 20.0)
)
def test_rotated_axes_are_reported_with_their_angle(by: int, nose: float, side: float, aim: float) -> None:
    level, down, right = (rotated(v, by + aim) for v in (UP, reading(0.0, -nose), reading(side, 0.0)))
    found = evaluate_axes(level, down, right)
    if by == 0:
        assert found.result is StepOutcome.PASS
    else:
        assert found.result is StepOutcome.FAIL
        assert f"rotated by {by}" in found.message or (by == 180 and "rotated by -180" in found.message)


@given(st.floats(22.0, 50.0), st.floats(22.0, 50.0))
def test_mirrored_axes_are_not_reported_as_rotated(nose: float, side: float) -> None:
    found = evaluate_axes(UP, reading(0.0, -nose), reading(-side, 0.0))
    assert found.result is StepOutcome.FAIL
    assert "mirrored" in found.message


@pytest.mark.parametrize(
    ("level", "message"),
    [((0.0, 0.0, 9.8), "upside down"), (reading(0.0, 20.0), "off level"), ((0.0, 0.0, -8.9), "calibrate")],
)
def test_a_wrong_level_is_reported_with_its_cause(level: Vec3, message: str) -> None:
    found = evaluate_level(level)
    assert found is not None
    assert message in found.message


def samples(forces: list[Vec3], period_us: int = 4000) -> list[ImuSample]:
    return [ImuSample(1 + k * period_us, k * period_us, f, (0.0, 0.0, 0.0)) for k, f in enumerate(forces)]


def test_a_moving_vehicle_has_no_mean_reading() -> None:
    assert mean_while_still(samples([UP] * 200)) == pytest.approx(UP)
    assert mean_while_still(samples([UP] * 60)) is None
    shaken = [(2.0 * (-1.0) ** k, 0.0, -9.8) for k in range(200)]
    assert mean_while_still(samples(shaken)) is None


@given(st.floats(-180.0, 180.0), st.floats(4.0, 20.0))
def test_the_first_push_counts_and_not_the_catch(direction: float, size: float) -> None:
    c, s = math.cos(math.radians(direction)), math.sin(math.radians(direction))
    pushed, caught = (size * c, size * s, -9.8), (-size * c, -size * s, -9.8)
    push = find_push(samples([UP] * 50 + [pushed] * 20 + [caught] * 20), UP)
    assert push is not None
    x, y = push.acceleration_m_s2
    assert math.cos(math.atan2(y, x) - math.radians(direction)) > 0.99


def test_a_bump_of_one_sample_is_not_a_push() -> None:
    assert find_push(samples([UP] * 50 + [(20.0, 0.0, -9.8)] + [UP] * 50), UP) is None


def test_a_reversed_force_is_detected() -> None:
    assert evaluate_push((6.0, 0.0), (7.8, 0.5)).result is StepOutcome.PASS
    assert "force points back" in evaluate_push((6.0, 0.0), (-7.8, 0.0)).message
    assert "the push pointed right, not forward" in evaluate_push((0.0, 6.0), (0.0, 7.8)).message


def test_a_displacement_is_measured_in_the_vehicles_own_axes() -> None:
    q = quaternion_from_euler(0.0, 0.0, math.radians(90.0))  # nose to the east
    path = [OdometrySample(k, k, (0.0, 0.1 * k, 0.0), (0.0, 1.0, 0.0)) for k in range(6)]
    assert measure_displacement(path, q) is None  # still moving
    rests = OdometrySample(7, 7, (0.0, 0.5, 0.0), (0.0, 0.0, 0.0))
    assert measure_displacement([*path, rests], q) == pytest.approx((0.5, 0.0), abs=1e-9)
    assert evaluate_position((0.5, 0.0), (0.0, 0.5)).result is StepOutcome.PASS
    assert "rotated by 90" in evaluate_position((0.0, 0.5), (-0.5, 0.0)).message
    assert "swapped" in evaluate_position((0.5, 0.0), (0.0, -0.5)).message


def test_a_slow_stream_is_named_with_its_minimum_rate() -> None:
    rates = {"imu": 49.0, "attitude": 100.0, "odometry": 100.0, "actuator": 100.0}
    found = evaluate_link(stream_rates(rates, {}), 0.005, 0.2, {})
    assert found.result is StepOutcome.FAIL
    assert "imu 49 Hz, minimum 150 Hz" in found.message
    rates["imu"] = 180.0
    assert evaluate_link(stream_rates(rates, {}), 0.005, 0.2, {}).result is StepOutcome.PASS
    assert "radio" in evaluate_link(stream_rates(rates, {}), 0.5, 0.2, {}).message
    assert "5.0 %" in evaluate_link(stream_rates(rates, {}), 0.005, 0.2, {"drop_rate_comm": 500.0}).message
    why = {"odometry": "125 Hz arrive, but no message is usable: the velocity is NaN"}
    empty = evaluate_link(stream_rates({**rates, "odometry": 0.0}, why), 0.005, 0.2, {})
    # There is no hint about the baud rate.
    assert empty.message == "odometry: 125 Hz arrive, but no message is usable: the velocity is NaN"


@given(st.binary(max_size=400))
def test_noise_is_not_recognised_as_mavlink(data: bytes) -> None:
    frame = bytes([0xFD, 3, 0, 0, 1, 1, 1, 0, 0, 0, 7, 7, 7, 9, 9])
    assert has_frames(data.replace(b"\xfd", b"") + frame * 3)
    assert not has_frames(data.replace(b"\xfd", b"") + frame * 2)
