"""The flight state that core, guard and senses share, updated by samples."""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.geometry import MissionFrame, Vec3, quaternion_from_euler
from dart_flight.base.records import (
    AttitudeSample,
    ClockOffset,
    CommandResult,
    EstimatorSample,
    HealthReport,
    ImuSample,
    OdometrySample,
    StatusText,
    Tick,
)
from dart_flight.base.stamps import FASTEST, LEAP_US
from dart_flight.core.sense.state import (
    _FASTEST_M_S,
    _FURTHEST_M,
    _LEAPS_ACCEPTED,
    _TEXT_AGE_US,
    FlightState,
)

FRAME = MissionFrame(3.0, 1.0, -0.2, 0.7)
SAMPLE = OdometrySample(8, 8, (4.0, -1.0, -1.5), (0.3, 0.1, 0.2))
HERE: Vec3 = (0.0, 0.0, 0.0)
Sample = ImuSample | AttitudeSample | OdometrySample


def at(t_us: int, position: Vec3 = HERE, velocity: Vec3 = HERE) -> OdometrySample:
    return OdometrySample(t_us, t_us, position, velocity)


def test_the_newest_sample_is_converted_to_a_frame_that_is_set_later() -> None:
    after, before = FlightState(), FlightState()
    attitude = AttitudeSample(8, 8, quaternion_from_euler(0.1, -0.2, 0.5))
    after.update_odometry(SAMPLE)
    after.update_attitude(attitude)
    after.anchor(FRAME)
    before.anchor(FRAME)
    before.update_odometry(SAMPLE)
    before.update_attitude(attitude)
    assert after.position == before.position == pytest.approx(FRAME.point_from_ned(SAMPLE.position_ned))
    assert after.velocity == before.velocity == pytest.approx(FRAME.vector_from_ned(SAMPLE.velocity_ned))
    assert after.yaw == before.yaw == pytest.approx(FRAME.yaw_from_ned(0.5))


@given(st.tuples(*[st.floats(-5.0, 5.0)] * 3), st.integers(4000, 40_000))
def test_the_acceleration_follows_the_velocity_with_a_lag_of_60_ms(push: Vec3, period_us: int) -> None:
    """The vehicle starts from rest and accelerates constantly."""
    state, frame = FlightState(), MissionFrame()
    state.anchor(frame)
    steps, h = round(2.0 / (period_us * 1e-6)), period_us * 1e-6
    share = 1.0
    for i in range(1, steps):
        moved = (push[0] * i * h, push[1] * i * h, push[2] * i * h)
        state.update_odometry(at(i * period_us, HERE, frame.vector_to_ned(moved)))
        if i > 1:
            share *= 1.0 - h / 0.06
        for axis in range(3):
            assert state.acceleration[axis] == pytest.approx(push[axis] * (1.0 - share), abs=1e-6)
    assert state.acceleration == pytest.approx(push, abs=1e-6)


def test_the_acceleration_across_a_pause_is_the_mean() -> None:
    state = FlightState()
    state.anchor(MissionFrame())
    state.update_odometry(at(1_000_000))
    state.update_odometry(at(1_500_000, HERE, (2.0, 0.0, 0.0)))
    assert state.acceleration[0] == pytest.approx(4.0)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("field", "most"), [("position_ned", _FURTHEST_M), ("velocity_ned", _FASTEST_M_S)])
def test_an_implausible_sample_is_rejected(field: str, most: float, sign: float, axis: int) -> None:
    def with_value(value: float) -> OdometrySample:
        vector = [0.0, 0.0, 0.0]
        vector[axis] = sign * value
        return msgspec.structs.replace(SAMPLE, **{field: tuple(vector)})

    for refused in (most, math.inf, math.nan):
        state = FlightState()
        assert not state.update_odometry(with_value(refused))
        assert state.odometry is None
    assert FlightState().update_odometry(with_value(0.99 * most))


def test_a_sample_that_is_not_newer_is_rejected() -> None:
    state = FlightState()
    state.anchor(MissionFrame())
    attitude = AttitudeSample(20_000, 20_000, quaternion_from_euler(0.0, 0.0, 0.0))
    assert state.update_odometry(at(20_000))
    assert state.update_attitude(attitude)
    for t_us in (20_000, 12_000):
        assert not state.update_odometry(at(t_us, (1.0, 0.0, 0.0)))
        assert not state.update_attitude(msgspec.structs.replace(attitude, t_us=t_us))
    assert state.position == HERE
    assert state.update_odometry(at(20_001, (1.0, 0.0, 0.0)))


def test_the_position_is_extrapolated_at_constant_velocity() -> None:
    state = FlightState()
    assert state.position_at(5) == HERE
    state.anchor(MissionFrame())
    state.update_odometry(at(1_000_000, (1.0, 2.0, -3.0), (0.5, -1.0, 0.25)))
    assert state.position_at(1_200_000) == pytest.approx((1.1, -1.8, 2.95))
    assert state.position_at(900_000) == pytest.approx((0.95, -2.1, 3.025))


def test_velocities_are_kept_for_a_second() -> None:
    state = FlightState()
    state.anchor(MissionFrame())
    for i in range(1, 301):
        state.update_odometry(at(i * 10_000, HERE, (0.01 * i, 0.0, 0.0)))
    assert state.velocity_before(2_500_000)[0] == pytest.approx(2.49)
    assert state.velocity_before(2_500_001)[0] == pytest.approx(2.50)
    assert state.velocity_before(2_000_001)[0] == pytest.approx(2.00)
    assert state.velocity_before(2_000_000) == state.velocity  # older velocities are dropped
    assert state.mean_velocity(0.5)[0] == pytest.approx(0.01 * (300 + 251) / 2)
    assert state.mean_velocity(9.0)[0] == pytest.approx(0.01 * (300 + 200) / 2)


def test_time_follows_the_host_clock_while_the_streams_are_silent() -> None:
    """The autopilot is 5 s ahead. Time never goes back; an offset jump moves it by a limited time."""
    state = FlightState()
    state.advance(Tick(900_000))
    assert (state.now_us, state.host_us) == (0, 900_000)
    state.update_odometry(OdometrySample(6_000_000, 1_000_000, HERE, HERE))
    state.update_clock(ClockOffset(0, 5_000_000))
    for host_us, now_us in ((1_000_000, 6_000_000), (1_400_000, 6_400_000), (1_200_000, 6_400_000)):
        state.advance(Tick(host_us))
        assert state.now_us == now_us
    state.update_clock(ClockOffset(0, 50_000_000))
    state.advance(Tick(1_500_000))
    assert state.now_us == 6_000_000 + 500_000 + LEAP_US
    assert state.host_us == 1_500_000


def test_a_jump_of_the_stamps_is_accepted_once_it_lasts() -> None:
    state = FlightState()
    state.update_odometry(at(1_000_000))
    for i in range(1, _LEAPS_ACCEPTED):
        t_us = 1_000_000 + 8000 * i
        assert not state.update_odometry(OdometrySample(t_us + 9_000_000, t_us, HERE, HERE))
    t_us = 1_000_000 + 8000 * _LEAPS_ACCEPTED
    assert state.update_odometry(OdometrySample(t_us + 9_000_000, t_us, HERE, HERE))
    assert state.now_us == t_us + 9_000_000


def test_isolated_jumps_of_a_stamp_are_never_accepted() -> None:
    state = FlightState()
    state.update_odometry(at(1_000_000))
    for i in range(1, 60):
        t_us = 1_000_000 + 8000 * i
        assert not state.update_odometry(OdometrySample(t_us + 9_000_000, t_us, HERE, HERE))
        assert state.update_odometry(at(t_us))


def test_a_stamp_may_advance_further_after_a_pause() -> None:
    """The limit is the elapsed time of the host in the fastest simulation, and one leap."""
    limit_us = FASTEST * 500_000 + LEAP_US
    for ahead_us, accepted in ((limit_us, True), (limit_us + 1, False)):
        state = FlightState()
        state.update_odometry(at(1_000_000))
        later = OdometrySample(1_000_000 + ahead_us, 1_500_000, HERE, HERE)
        assert state.update_odometry(later) is accepted


def imu_at(t_us: int, received_us: int) -> ImuSample:
    return ImuSample(t_us, received_us, HERE, HERE)


def attitude_at(t_us: int, received_us: int) -> AttitudeSample:
    return AttitudeSample(t_us, received_us, (1.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("first", [imu_at, attitude_at, lambda t, host: OdometrySample(t, host, HERE, HERE)])
@pytest.mark.parametrize("pause_us", [0, 500_000])
def test_the_first_sample_of_a_stream_may_not_be_ahead_of_the_other_streams(
    first: Callable[[int, int], Sample], pause_us: int
) -> None:
    """Such a sample may come from another vehicle. Silence permits a later stamp."""
    begin_us, host_us = 300_000_000, 7_000_000
    for ahead_us, accepted in ((0, True), (LEAP_US, True), (LEAP_US + 1, False)):
        state = FlightState()
        state.update_imu(imu_at(begin_us - 4000, host_us))
        state.update_attitude(attitude_at(begin_us, host_us))
        stream = {ImuSample: "imu", AttitudeSample: "attitude", OdometrySample: "odometry"}
        sample = first(begin_us + ahead_us + FASTEST * pause_us, host_us + pause_us)
        setattr(state, stream[type(sample)], None)  # the stream has not begun
        update = getattr(state, f"update_{stream[type(sample)]}")
        assert update(sample) is accepted


def test_the_position_uncertainty_is_kept_until_it_is_reported_again() -> None:
    state = FlightState()
    state.update_estimator(EstimatorSample(0, 10, position_sd_m=0.3))
    state.update_estimator(EstimatorSample(0, 20))
    assert (state.position_sd_m, state.host_us) == (0.3, 20)


# --- reports of PX4 -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("later_us", "reason"), [(_TEXT_AGE_US - 1, "; PX4 reports: compass swung"), (_TEXT_AGE_US, "")]
)
def test_a_px4_text_counts_as_a_reason_for_a_while(later_us: int, reason: str) -> None:
    state = FlightState()
    state.add_text(StatusText(0, 0, "warning", "compass swung"))
    state.now_us = later_us
    assert state.reasons() == reason


def test_the_newest_six_px4_texts_are_reported_once_each() -> None:
    state = FlightState()
    for text in ("A", "B", "C", "D", "E", "F", "A", "G"):
        state.add_text(StatusText(0, 0, "warning", text))
    state.add_text(StatusText(0, 0, "info", "H"))
    assert state.reasons() == "; PX4 reports: C, D, E, F, A, G"


def test_health_findings_come_first_and_no_text_is_repeated() -> None:
    state = FlightState()
    state.add_text(StatusText(0, 0, "error", "no heading"))
    state.add_text(StatusText(0, 0, "error", "low battery"))
    state.update_health(HealthReport(0, 0, False, ("low battery",), ("no heading", "no sticks")))
    assert state.reasons() == "; PX4 reports: low battery, no heading; also no sticks"


def test_findings_of_this_program_are_not_attributed_to_px4() -> None:
    state, here = FlightState(), "ODOMETRY arrives, but no message is usable: the velocity is NaN"
    state.add_text(StatusText(0, 0, "error", here, found_here=True))
    assert state.reasons() == f"; {here}"
    assert state.text_about("ODOMETRY") == f"; {here}"
    state.add_text(StatusText(0, 0, "error", "no heading"))
    assert state.reasons() == f"; {here}; PX4 reports: no heading"
    state.now_us = _TEXT_AGE_US
    assert state.reasons() == ""
    state.add_text(StatusText(0, 0, "error", here, found_here=True))
    state.add_result(CommandResult(0, "arm", False, "DENIED"))
    assert state.reasons("arm") == f"; {here}; PX4 answers: DENIED"


def test_the_newest_of_several_findings_is_quoted() -> None:
    """PX4's texts and this program's findings count alike."""
    state = FlightState()
    here = [("ODOMETRY: no velocity", True), ("ODOMETRY: NaN", False), ("ODOMETRY: late", True)]
    for t_us, (text, found_here) in enumerate(here):
        state.now_us = t_us
        state.add_text(StatusText(0, 0, "warning", text, found_here=found_here))
    state.add_text(StatusText(0, 0, "warning", "IMU: late"))
    assert state.text_about("ODOMETRY") == "; ODOMETRY: late"
    assert state.text_about("GPS") == ""


def test_a_refusal_is_reported_for_its_command_until_it_is_accepted() -> None:
    state = FlightState()
    state.add_result(CommandResult(0, "arm", False, "DENIED"))
    assert state.reasons("offboard") == state.reasons() == ""
    assert state.reasons("arm") == "; PX4 answers: DENIED"
    state.update_health(HealthReport(0, 0, True, (), ("no sticks",)))
    assert state.reasons("arm") == "; PX4 answers: DENIED; PX4 gives no reason, but reports: no sticks"
    state.add_result(CommandResult(0, "arm", True, ""))
    assert state.reasons("arm") == "; PX4 gives no reason, but reports: no sticks"
