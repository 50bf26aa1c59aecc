"""Resets of the estimated heading: distinguished from rotation by the gyro, reported, and listed."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dart_flight.base.geometry import (
    advance_attitude,
    quaternion_from_euler,
    quaternion_multiply,
    quaternion_normalise,
)
from dart_flight.base.records import (
    AttitudeSample,
    EstimatorSample,
    ImuSample,
    Mode,
    OdometrySample,
    Override,
    Phase,
)
from dart_flight.config.vehicle import packaged
from dart_flight.core.guard.estimator_resets import REACH_US, EstimatorResets
from dart_flight.core.guard.heading_step import HEADING_STEP_DEG
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.faults.fault_table import parse_fault
from tests.core.conftest import HandFedCore, known

NED, REACH = (0.0, 0.0, 0.0), REACH_US // 4000  # ticks


def measured_step_deg(
    step_deg: float, seed: int, lost: float = 0.0, counter: tuple[int, int] = (3, 4), lag: int = 0
) -> float:
    """Return the step measured for a vehicle that tumbles at up to 20 rad/s, degrees.

    Args:
        step_deg: heading step after half a second.
        seed: seed of the motion.
        lost: share of lost attitude samples.
        counter: reset counter before and after.
        lag: ticks by which the counter follows the attitude.
    """
    rng, resets = random.Random(seed), EstimatorResets()
    q = quaternion_from_euler(*(rng.uniform(-1.0, 1.0) for _ in range(3)))
    swing = [(rng.uniform(-11.0, 11.0), rng.uniform(1.0, 8.0), rng.uniform(0.0, 6.0)) for _ in NED]
    resets.update_counter(counter[0], 0)
    for tick in range(1, 250):
        t_us = 1_000_000 + 4000 * tick
        rate = [a * math.sin(f * tick * 0.02 + p) for a, f, p in swing]
        rate_frd = (rate[0], rate[1], rate[2])
        q = quaternion_normalise(advance_attitude(q, rate_frd, 0.004))
        if tick == 125:
            q = quaternion_multiply(quaternion_from_euler(0.0, 0.0, math.radians(step_deg)), q)
        attitude_first = rng.random() < 0.5
        arrives = tick % 2 == 0 and rng.random() >= lost
        if arrives and attitude_first:
            resets.add_attitude(AttitudeSample(t_us, t_us, q))
        resets.add_imu(ImuSample(t_us, t_us, NED, rate_frd))
        if arrives and not attitude_first:
            resets.add_attitude(AttitudeSample(t_us, t_us, q))
        if tick == 125 + lag:
            resets.update_counter(counter[1], t_us)
    return 0.0 if resets.newest is None else math.degrees(resets.newest.heading_rad)


@settings(max_examples=60, deadline=None)
@given(
    st.floats(-170.0, 170.0),
    st.integers(0, 10_000),
    st.sampled_from([0.0, 0.3]),
    st.sampled_from([(3, 4), (255, 0), (7, 12)]),
    st.integers(0, 12),
)
def test_a_heading_step_is_measured_during_any_rotation(
    step_deg: float, seed: int, lost: float, counter: tuple[int, int], lag: int
) -> None:
    assert measured_step_deg(step_deg, seed, lost, counter, lag) == pytest.approx(step_deg, abs=0.5)


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_rotation_alone_is_no_heading_step(seed: int) -> None:
    """This holds even if the counter rises for another reason."""
    assert abs(measured_step_deg(0.0, seed)) < 0.5


def test_a_heading_step_far_from_a_counter_change_is_no_reset() -> None:
    assert measured_step_deg(30.0, 1, lag=60) == pytest.approx(0.0, abs=0.5)
    assert measured_step_deg(30.0, 1, counter=(4, 4)) == 0.0


@pytest.mark.parametrize(("ticks_later", "counts"), [(0, True), (REACH - 1, True), (REACH + 1, False)])
def test_a_heading_step_may_come_shortly_before_the_counter_rises(ticks_later: int, counts: bool) -> None:
    resets = EstimatorResets()
    resets.update_counter(0, 0)
    for tick in range(101 + ticks_later):
        resets.add_imu(ImuSample(4000 * tick, 4000 * tick, NED, NED))
        q = quaternion_from_euler(0.0, 0.0, 0.2 if tick >= 100 else 0.0)
        resets.add_attitude(AttitudeSample(4000 * tick, 4000 * tick, q))
    assert resets.update_counter(1, 4000 * (100 + ticks_later))
    assert known(resets.newest).heading_rad == pytest.approx(0.2 if counts else 0.0)


@pytest.mark.parametrize("rate", [10.0, -15.0])
def test_attitudes_stamped_between_gyro_samples_are_compared_at_their_own_time(rate: float) -> None:
    resets = EstimatorResets()
    resets.update_counter(0, 0)
    for tick in range(40):
        t_us = 4000 * tick
        at_us = t_us - 2000 * (tick % 2)
        resets.add_imu(ImuSample(t_us, t_us, NED, (0.0, 0.0, rate)))
        q = quaternion_from_euler(0.0, 0.0, rate * at_us * 1e-6)
        resets.add_attitude(AttitudeSample(at_us, t_us, q))
        if tick == 20:
            assert resets.update_counter(1, t_us)
    assert known(resets.newest).heading_rad == pytest.approx(0.0, abs=1e-6)


def test_a_tilt_step_is_no_heading_step() -> None:
    resets, q = EstimatorResets(), quaternion_from_euler(0.0, 0.0, 1.0)
    resets.update_counter(0, 0)
    for tick in range(1, 40):
        if tick == 20:
            resets.update_counter(1, 4000 * tick)
            q = quaternion_multiply(quaternion_from_euler(0.3, 0.0, 0.0), q)
        resets.add_imu(ImuSample(4000 * tick, 4000 * tick, NED, NED))
        resets.add_attitude(AttitudeSample(4000 * tick, 4000 * tick, q))
    assert abs(math.degrees(known(resets.newest).heading_rad)) < 0.1


def test_no_heading_step_is_measured_across_a_gap_in_the_gyro_rates() -> None:
    resets = EstimatorResets()
    resets.update_counter(0, 0)
    for t_us, yaw in ((0, 0.0), (4000, 0.0), (400_000, 1.0), (404_000, 1.0)):
        resets.add_imu(ImuSample(t_us, t_us, NED, NED))
        resets.add_attitude(AttitudeSample(t_us, t_us, quaternion_from_euler(0.0, 0.0, yaw)))
    resets.update_counter(1, 404_000)
    assert known(resets.newest).heading_rad == 0.0


@given(rate=st.floats(-15.0, 15.0), before=st.integers(2, 12), gap_us=st.integers(20_001, 90_000))
@example(rate=10.0, before=3, gap_us=30_000)
def test_a_turn_with_a_gap_in_the_gyro_rates_after_a_reset_is_no_heading_step(
    rate: float, before: int, gap_us: int
) -> None:
    resets, t_us = EstimatorResets(), 0
    resets.update_counter(0, 0)
    for i in range(40):
        t_us += gap_us if i == before + 1 else 4000
        resets.add_imu(ImuSample(t_us, t_us, NED, (0.0, 0.0, rate)))
        q = quaternion_from_euler(0.0, 0.0, rate * t_us * 1e-6)
        resets.add_attitude(AttitudeSample(t_us, t_us, q))
        if i == before:
            assert resets.update_counter(1, t_us)
    assert known(resets.newest).heading_rad == pytest.approx(0.0, abs=1e-6)


def test_position_and_velocity_steps_are_separated_from_the_motion() -> None:
    resets = EstimatorResets()
    resets.update_counter(250, 0)
    for n in range(40):
        t_us, late = 8000 * n, n >= 20
        x = 0.008 * n * 2.0 + (0.3 if late else 0.0)
        resets.add_odometry(OdometrySample(t_us, t_us, (x, 0.0, 0.0), (2.0, 0.1 if late else 0.0, 0.0)))
        if n == 22:
            assert resets.update_counter(251, t_us)
    assert resets.newest is not None
    assert resets.newest.position_m == pytest.approx(0.3, abs=1e-6)
    assert resets.newest.velocity_m_s == pytest.approx(0.1, abs=1e-6)


# --- reaction of the guard ------------------------------------------------------------------------------


def step_heading(c: HandFedCore, step_deg: float, counter: int = 2) -> None:
    """Step the heading and set the reset counter."""
    c.q = quaternion_multiply(quaternion_from_euler(0.0, 0.0, math.radians(step_deg)), c.q)
    c.feed(EstimatorSample(c.t_us, c.t_us, reset_counter=counter))
    c.run(0.05)


def with_reset_counter(c: HandFedCore) -> HandFedCore:
    c.feed(EstimatorSample(c.t_us, c.t_us, reset_counter=1))
    return c


@pytest.mark.parametrize("step_deg", [1.1 * HEADING_STEP_DEG, -30.0, 90.0, 175.0, -175.0])
def test_a_heading_step_breaks_off_the_approach(step_deg: float) -> None:
    c = with_reset_counter(HandFedCore())
    c.enter_approach()
    assert c.core.phase is Phase.APPROACH
    step_heading(c, step_deg)
    detail = f"heading stepped by {step_deg:.1f} deg, limit {HEADING_STEP_DEG:g} deg"
    assert c.fired_details == [("heading_reset", detail)]
    assert c.core.override is Override.BREAK_OFF


def test_small_steps_and_counter_changes_alone_end_no_flight() -> None:
    c = with_reset_counter(HandFedCore())
    c.enter_approach()
    step_heading(c, 0.9 * HEADING_STEP_DEG)
    c.run(0.3)
    step_heading(c, 0.0, counter=3)
    c.run(0.3)
    assert c.fired_details == []


def test_the_heading_may_align_in_the_climb() -> None:
    c = with_reset_counter(HandFedCore())
    c.enter_climb()
    assert c.core.phase is Phase.CLIMB
    step_heading(c, 60.0)
    c.run(0.1)
    c.q = quaternion_from_euler(0.0, 0.0, 0.0)  # turned to the heading of the mission
    c.position_ned = (0.0, 0.0, -1.0)
    c.run(0.5)
    assert c.core.phase is not Phase.CLIMB
    assert c.fired_details == []


def test_an_impact_does_not_excuse_a_heading_step() -> None:
    c = with_reset_counter(HandFedCore())
    c.fly_to_wood()
    c.pulse((-10.0, -16.0))
    c.set_lock(Mode.RIGID)
    c.run(0.1)
    assert c.core.phase is Phase.RECOVERY
    step_heading(c, 30.0)
    assert "heading_reset" in c.fired_rules


# --- whole flights ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "outcome", "heading_deg"),
    [
        pytest.param("heading-reset=4@approach", "completed", 4.0, marks=pytest.mark.rest),
        ("heading-reset=-90@recovery", "aborted", -90.0),
        pytest.param("heading-reset=60@take-off", "completed", 60.0, marks=pytest.mark.rest),
    ],
)
def test_the_verdict_lists_estimator_resets(fault: str, outcome: str, heading_deg: float) -> None:
    mission = load_flyable(packaged("missions", "paper_dual_collision.yaml"))
    verdict = fly_fast(mission, 1, None, fault=parse_fault(fault))
    assert verdict.outcome == outcome
    assert (verdict.reason or "").startswith("heading_reset: heading stepped by") is (outcome == "aborted")
    (reset,) = verdict.estimator_resets
    assert reset.heading_deg == pytest.approx(heading_deg, rel=0.06)  # motion capture has begun to correct
    assert reset.position_m < 0.05


def test_a_reset_before_the_first_attitude_has_no_heading_step() -> None:
    resets = EstimatorResets()
    assert [resets.update_counter(counter, 1_000_000) for counter in (3, 4)] == [False, True]
    for tick in range(1, 5):
        t_us = 1_000_000 + 4000 * tick
        resets.add_imu(ImuSample(t_us, t_us, NED, NED))
        resets.add_attitude(AttitudeSample(t_us, t_us, quaternion_from_euler(0.0, 0.0, 0.3 * tick)))
    assert known(resets.newest).heading_rad == 0.0
