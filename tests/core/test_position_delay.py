"""The regression that measures how far the position estimate leads the IMU."""

import math
import random
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.geometry import GRAVITY_M_S2, Vec3
from dart_flight.core.sense.position_delay import (
    _AHEAD,
    _BEHIND,
    _HIGH_PASS_S,
    _JUMP_M_S,
    _LITTLE_AHEAD,
    _LITTLE_MOTION,
    _MEMORY_S,
    _MOTION,
    _SHARE,
    Momenta,
    PositionDelay,
)
from dart_flight.core.sense.position_delay import _STEP_US as STEP_US

MASS_KG = 1.3
TICK_US = 4000
LAG_S = 0.45  # from a motion to the error that a wrong delay causes

Motion = Callable[[float], Vec3]


def varied_velocity(t_s: float) -> Vec3:
    """Return the velocity of a flight that starts, stops and turns, m/s."""
    return (0.8 * math.sin(1.7 * t_s) ** 3, 0.5 * math.sin(1.1 * t_s), 0.3 * math.sin(2.3 * t_s))


class Imu:
    """An IMU that integrates its readings, as `ForceEstimator` does."""

    def __init__(self) -> None:
        self.momenta: Momenta = deque([(0, 0.0, 0.0, 0.0)], maxlen=40)

    def add_reading(self, t_us: int, acceleration: Sequence[float]) -> None:
        last_us, *sums = self.momenta[-1]
        dt_s = (t_us - last_us) * 1e-6
        if dt_s > 0.05:
            self.momenta.clear()
        reading = (acceleration[0], acceleration[1], acceleration[2] + GRAVITY_M_S2)
        x, y, z = (total + MASS_KG * dt_s * a for total, a in zip(sums, reading, strict=True))
        self.momenta.append((t_us, x, y, z))


def step(delay: PositionDelay, imu: Imu, t_us: int, velocity: Vec3) -> None:
    if t_us >= delay.due_us:
        delay.compare_odometry(t_us, velocity, imu.momenta)


def fly(
    delay: PositionDelay,
    wrong_s: float,
    *,
    motion: Motion = varied_velocity,
    duration_s: float = 8.0,
    bias: Vec3 = (0.0, 0.0, 0.0),
    noise_m_s2: float = 0.0,
    late_us: int = 0,
    seed: int = 1,
) -> list[float | None]:
    """Feed a flight whose velocity estimate has the error of a delay that is wrong by `wrong_s`.

    Args:
        delay: estimator that receives the samples.
        wrong_s: configured minus true delay.
        motion: true velocity over time.
        duration_s: duration of the flight.
        bias: accelerometer bias, m/s2.
        noise_m_s2: accelerometer noise per sample.
        late_us: delay of odometry behind IMU samples of the same stamp.
        seed: seed of the noise.

    Returns:
        `ahead_s` after every odometry sample.
    """
    rng, found, waiting, imu = random.Random(seed), [], [], Imu()
    for tick in range(1, round(duration_s * 1e6 / TICK_US)):
        t_us = tick * TICK_US
        t_s = t_us * 1e-6
        before, now = motion(t_s - TICK_US * 1e-6), motion(t_s)
        reading = [
            (after - earlier) / (TICK_US * 1e-6) + b + rng.gauss(0.0, noise_m_s2)
            for after, earlier, b in zip(now, before, bias, strict=True)
        ]
        imu.add_reading(t_us, reading)
        if tick % 2 == 0:
            past, earlier = motion(t_s - LAG_S + 0.15), motion(t_s - LAG_S - 0.15)
            pull = [0.75 * wrong_s * (a - b) / 0.3 for a, b in zip(past, earlier, strict=True)]
            waiting.append((t_us, (now[0] + pull[0], now[1] + pull[1], now[2] + pull[2])))
        while waiting and waiting[0][0] + late_us <= t_us:
            step(delay, imu, *waiting.pop(0))
            found.append(delay.ahead_s)
    return found


def new_estimator() -> PositionDelay:
    return PositionDelay(MASS_KG, 2.0)


@pytest.mark.parametrize("late_us", [0, 4000, 20_000, 40_000])
@pytest.mark.parametrize("wrong_s", [-0.15, 0.08, 0.3])
def test_a_wrong_delay_is_measured_with_its_sign(wrong_s: float, late_us: int) -> None:
    ahead_s = fly(new_estimator(), wrong_s, late_us=late_us)[-1]
    assert ahead_s == pytest.approx(wrong_s, rel=0.2)


@given(bias=st.tuples(*[st.floats(-0.3, 0.3)] * 3), noise_m_s2=st.floats(0.0, 0.3), seed=st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_accelerometer_bias_and_noise_give_no_delay(bias: Vec3, noise_m_s2: float, seed: int) -> None:
    found = fly(new_estimator(), 0.0, bias=bias, noise_m_s2=noise_m_s2, seed=seed)
    assert all(ahead_s is None or abs(ahead_s) < 0.05 for ahead_s in found)


def test_a_hovering_vehicle_gives_no_delay_estimate() -> None:
    found = fly(new_estimator(), 0.3, motion=lambda t_s: (0.01 * math.sin(3.0 * t_s), 0.0, 0.0))
    assert set(found) == {None}


def test_the_delay_is_not_estimated_shortly_after_a_contact() -> None:
    """A contact disturbs the velocity estimate."""
    delay = new_estimator()
    delay.disturb(0)
    found = fly(delay, 0.15, duration_s=2.0)
    assert set(found) == {None}
    assert fly(new_estimator(), 0.15, duration_s=2.0)[-1] is not None


@pytest.mark.parametrize(
    ("step_m_s", "imu_gap_s"), [(1.0, 0.0), (0.0, 0.4)], ids=["estimator reset", "gap in the IMU"]
)
def test_a_reset_or_a_gap_gives_no_delay(step_m_s: float, imu_gap_s: float) -> None:
    """Other rules report a step; the comparison restarts after it."""
    delay, imu, found = new_estimator(), Imu(), []
    for tick in range(1, 2000):
        t_us = tick * TICK_US
        t_s = t_us * 1e-6
        before, now = varied_velocity(t_s - 0.004), varied_velocity(t_s)
        if not 3.0 < t_s < 3.0 + imu_gap_s:
            imu.add_reading(t_us, [(a - b) / 0.004 for a, b in zip(now, before, strict=True)])
        if tick % 2 == 0:
            x, y, z = now
            step(delay, imu, t_us, (x + step_m_s * (t_s > 4.0), y, z))
            found.append(delay.ahead_s)
    assert all(ahead_s is None or abs(ahead_s) < 0.02 for ahead_s in found)


# --- the regression, compared with its definition ---------------------------------------------------------

STEP_S = 1e-6 * STEP_US
Series = npt.NDArray[np.float64]  # one row for every step, one column for every axis


def random_motion(rng: random.Random, acceleration_m_s2: float, steps: int) -> tuple[list[Momenta], Series]:
    """Return the IMU's momenta and the true velocity at every step, half of them between two samples."""
    imu, kept, velocities = Imu(), list[Momenta](), []
    velocity = last = np.zeros(3)
    at = np.zeros(3)
    for tick in range(1, steps * STEP_US // TICK_US + 2):
        t_us = tick * TICK_US
        if tick % 50 == 1:
            at = np.array([rng.gauss(0.0, acceleration_m_s2) for _ in range(3)])
        imu.add_reading(t_us, (at[0], at[1], at[2]))
        last, velocity = velocity, velocity + at * TICK_US * 1e-6
        while len(kept) < steps and (len(kept) + 1) * STEP_US <= t_us:
            share = ((len(kept) + 1) * STEP_US - (t_us - TICK_US)) / TICK_US
            kept.append(imu.momenta.copy())
            velocities.append(last + share * (velocity - last))
    return kept, np.array(velocities)


def high_passed(changes: Series) -> Series:
    """Return the sum of the changes behind a high-pass filter."""
    out, value = [], np.zeros(3)
    for change in changes:
        value = (1.0 - STEP_S / _HIGH_PASS_S) * (value + change)
        out.append(value)
    return np.array(out)


def expected_figures(e: Series, z: Series) -> tuple[float, float, float]:
    """Return the covariance of e and z and both variances, with a fading memory, over all axes."""
    weights = STEP_S * (1.0 - STEP_S / _MEMORY_S) ** np.arange(len(e))[::-1, np.newaxis]
    e, z = (x - (weights * x).sum(axis=0) / weights.sum() for x in (e, z))
    return tuple(float((weights * x).sum()) for x in (e * z, z * z, e * e))  # type: ignore[return-value]


def expected_lead(ez: float, zz: float, ee: float) -> float | None:
    """Return the lead, or None if acceleration or correlation is too small.

    To be ahead, more motion permits less correlation; to be behind always takes both.
    """
    correlation = ez / math.sqrt(zz * ee)
    little = zz > _LITTLE_MOTION and correlation > _LITTLE_AHEAD
    ahead = little or (zz > _MOTION and correlation > _AHEAD)
    behind = zz > _MOTION and correlation < -_BEHIND
    return ez / (_SHARE * zz) if ahead or behind else None


# `error_m_s` is white noise of the estimate. In every case, motion or correlation crosses a limit.
@pytest.mark.parametrize(
    ("acceleration_m_s2", "wrong_s", "error_m_s"),
    [(0.5, 0.1, 0.03), (0.5, -0.1, 0.016), (0.22, 0.1, 0.008), (0.22, -0.1, 0.001), (0.15, 0.1, 0.001)],
)
def test_the_lead_follows_from_the_covariance_of_error_and_past_acceleration(
    acceleration_m_s2: float, wrong_s: float, error_m_s: float
) -> None:
    """The acceleration is the mean from 0.6 s to 0.3 s ago; all axes count alike.

    A contact restarts the filters after 2 s, and the sums are kept.
    """
    rng, steps, contact = random.Random(2), 400, 200
    momenta, velocity = random_motion(rng, acceleration_m_s2, steps)
    error = np.array([[rng.gauss(0.0, error_m_s) for _ in range(3)] for _ in range(steps)])
    error[12:] += _SHARE * wrong_s * (velocity[6:-6] - velocity[:-12]) / 0.3
    delay, known, e, z = new_estimator(), set[bool](), np.zeros((0, 3)), np.zeros((0, 3))
    begin = 0
    for i in range(steps):
        t_us = (i + 1) * STEP_US
        if i == contact:
            delay.disturb(t_us)
            begin = contact + 2_000_000 // STEP_US
        delay.compare_odometry(t_us, tuple(velocity[i] + error[i]), momenta[i])
        if i + 1 in (contact, steps):
            past = (velocity[begin + 6 : i - 5] - velocity[begin : i - 11]) / 0.3
            e = np.vstack([e, high_passed(np.diff(error[begin : i + 1], axis=0))[12:]])
            z = np.vstack([z, high_passed(np.diff(past, axis=0))])
            assert delay.figures == pytest.approx(expected_figures(e, z), rel=1e-9)
        if min(delay.figures[1:]) > 1e-9:
            lead = expected_lead(*delay.figures)
            assert delay.ahead_s == (None if lead is None else pytest.approx(lead))
            known.add(lead is not None)
    assert known == {False, True}


def test_odometry_is_compared_at_regular_steps() -> None:
    """Samples arrive every 8 ms. The next step makes up for a late one, but not for a pause of 2 s."""
    delay, imu = new_estimator(), Imu()
    compared_us = []
    for t_us in range(TICK_US, 4_000_000, TICK_US):
        imu.add_reading(t_us, (0.0, 0.0, 0.0))
        if t_us % 8000 == 0 and t_us >= delay.due_us and not 1_000_000 < t_us < 3_000_000:
            delay.compare_odometry(t_us, (0.0, 0.0, 0.0), imu.momenta)
            compared_us.append(t_us)
    assert compared_us[:5] == [8000, 56_000, 104_000, 152_000, 200_000]
    assert sum(t_us <= 1_000_000 for t_us in compared_us) == 21
    assert sum(t_us >= 3_000_000 for t_us in compared_us) == 21


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("share", "counts"), [(0.93, True), (1.07, False)])
def test_a_large_change_in_one_step_restarts_the_comparison(
    share: float, counts: bool, sign: float, axis: int
) -> None:
    momenta, velocity = random_motion(random.Random(2), 0.5, 40)
    velocity[30:, axis] += sign * share * _JUMP_M_S
    delay, found = new_estimator(), []
    for i in range(40):
        delay.compare_odometry((i + 1) * STEP_US, tuple(velocity[i]), momenta[i])
        found.append(delay.figures)
    assert found[28] != found[29]
    assert (found[29] != found[30]) is counts
