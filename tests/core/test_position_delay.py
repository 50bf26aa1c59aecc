"""The regression that measures how far the position estimate leads the IMU."""

import math
import random
from collections import deque
from collections.abc import Callable, Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.geometry import GRAVITY_M_S2, Vec3
from dart_flight.core.sense.position_delay import Momenta, PositionDelay

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


@given(
    bias=st.tuples(*[st.floats(-0.3, 0.3)] * 3),
    noise_m_s2=st.floats(0.0, 0.3),
    seed=st.integers(0, 1000),
)
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


def test_an_estimator_reset_gives_no_delay() -> None:
    """Other rules report the step; the comparison restarts after it."""

    def reset(t_s: float) -> Vec3:
        x, y, z = varied_velocity(t_s)
        return (x + (1.0 if t_s > 4.0 else 0.0), y, z)

    delay, imu, found = new_estimator(), Imu(), []
    for tick in range(1, 2000):
        t_us = tick * TICK_US
        t_s = t_us * 1e-6
        before, now = varied_velocity(t_s - 0.004), varied_velocity(t_s)
        imu.add_reading(t_us, [(a - b) / 0.004 for a, b in zip(now, before, strict=True)])
        if tick % 2 == 0:
            step(delay, imu, t_us, reset(t_s))
            found.append(delay.ahead_s)
    assert all(ahead_s is None or abs(ahead_s) < 0.02 for ahead_s in found)


def test_a_gap_in_the_imu_stream_gives_no_delay() -> None:
    delay, imu, found = new_estimator(), Imu(), []
    for tick in range(1, 2000):
        t_us = tick * TICK_US
        t_s = t_us * 1e-6
        before, now = varied_velocity(t_s - 0.004), varied_velocity(t_s)
        if not 3.0 < t_s < 3.4:
            imu.add_reading(t_us, [(a - b) / 0.004 for a, b in zip(now, before, strict=True)])
        if tick % 2 == 0:
            step(delay, imu, t_us, now)
            found.append(delay.ahead_s)
    assert all(ahead_s is None or abs(ahead_s) < 0.02 for ahead_s in found)
