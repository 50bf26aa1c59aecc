"""Learning of hover bias, thrust scale, noise and force baseline, sample by sample."""

from __future__ import annotations

import math

import pytest

from dart_flight.base.geometry import GRAVITY_M_S2, Vec3
from dart_flight.config.vehicle import load_vehicle, packaged
from dart_flight.core.sense.bias import (
    _BASELINE_DELAY,
    _BASELINE_STEP_N,
    _MIN_NOISE2,
    _SCALE_STEP,
    BASELINE_S,
    BIAS_LIMIT_M_S2,
    HOVER_RATE_RAD_S,
    HOVER_SPEED_M_S,
    LEARNING_S,
    THRUST_SCALE_LIMIT,
    ForceBaseline,
    HoverBias,
)

VEHICLE = load_vehicle(packaged("configs", "dart.yaml"))
MASS, ESTIMATION = VEHICLE.airframe.mass_kg, VEHICLE.estimation
WEIGHT_N, DT_S = MASS * GRAVITY_M_S2, 0.004
STILL: Vec3 = (0.0, 0.0, 0.0)


def learned_bias(
    f: Vec3, seconds: float = 1.0, rate: Vec3 = STILL, speed_m_s: float = 0.0, thrust_n: float = WEIGHT_N
) -> HoverBias:
    bias = HoverBias(ESTIMATION, MASS)
    for _ in range(round(seconds / DT_S)):
        bias.learn(f, rate, speed_m_s, thrust_n, DT_S)
    return bias


def test_the_bias_converges_with_its_time_constant() -> None:
    bias = learned_bias((0.1, -0.05, -GRAVITY_M_S2), LEARNING_S)
    share = 1.0 - math.exp(-1.0)
    assert (bias.bias_x, bias.bias_y) == pytest.approx((0.1 * share, -0.05 * share), rel=0.01)
    assert bias.scale == pytest.approx(1.0)
    settled = learned_bias((0.1, -0.05, -0.95 * GRAVITY_M_S2), 10.0 * LEARNING_S)
    assert (settled.bias_x, settled.bias_y, settled.scale) == pytest.approx((0.1, -0.05, 0.95), rel=1e-3)


def test_the_thrust_ratio_is_known_after_half_a_time_constant() -> None:
    level = (0.0, 0.0, -0.9 * GRAVITY_M_S2)
    assert learned_bias(level, 0.48 * LEARNING_S).thrust_ratio is None
    assert learned_bias(level, 0.54 * LEARNING_S).thrust_ratio == pytest.approx(0.9)


RATE, SPEED = HOVER_RATE_RAD_S, HOVER_SPEED_M_S


@pytest.mark.parametrize(
    ("rate", "speed_m_s", "learns"),
    [
        ((0.32 * RATE, -0.32 * RATE, 0.32 * RATE), 0.95 * SPEED, True),
        ((0.4 * RATE, -0.4 * RATE, 0.4 * RATE), 0.0, False),
        ((1.05 * RATE, 0.0, 0.0), 0.0, False),
        ((0.0, -1.05 * RATE, 0.0), 0.0, False),
        ((0.0, 0.0, -1.05 * RATE), 0.0, False),
        (STILL, 1.05 * SPEED, False),
    ],
)
def test_bias_is_learned_only_in_hover_and_thrust_scale_in_any_flight(
    rate: Vec3, speed_m_s: float, learns: bool
) -> None:
    bias = learned_bias((0.1, -0.05, -0.95 * GRAVITY_M_S2), 1.0, rate, speed_m_s)
    assert (bias.bias_x > 0.0, bias.bias_y < 0.0) == (learns, learns)
    assert bias.scale < 0.999


def test_only_noise_is_learned_while_the_motors_are_nearly_off() -> None:
    f = (0.1, -0.05, -0.95 * GRAVITY_M_S2)
    bias = learned_bias(f, 3.0, thrust_n=0.49 * WEIGHT_N)
    assert (bias.bias_x, bias.bias_y, bias.scale) == (0.0, 0.0, 1.0)
    assert bias.noise_m_s2 < 0.1 * ESTIMATION.imu_noise_m_s2
    assert learned_bias(f, 3.0, thrust_n=0.51 * WEIGHT_N).bias_x > 0.0


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_learned_bias_and_thrust_scale_are_limited(sign: float) -> None:
    far = 3.0 * BIAS_LIMIT_M_S2
    bias = learned_bias((sign * far, -sign * far, -GRAVITY_M_S2 * (1.0 + sign * 0.9)), 20 * LEARNING_S)
    most = BIAS_LIMIT_M_S2
    assert (bias.bias_x, bias.bias_y) == (sign * most, -sign * most)
    assert bias.scale == pytest.approx(1.0 + sign * THRUST_SCALE_LIMIT)


@pytest.mark.parametrize("share", [0.46, 0.8, 1.0, 1.25, 2.2])
def test_the_thrust_ratio_has_no_limit(share: float) -> None:
    """0.46: the vehicle weighs 1.85 kg and is configured with 0.85 kg."""
    bias = learned_bias((0.0, 0.0, -GRAVITY_M_S2), 1.2, thrust_n=WEIGHT_N / share)
    assert bias.thrust_ratio == pytest.approx(share)
    assert learned_bias((0.0, 0.0, -GRAVITY_M_S2), 0.5, thrust_n=WEIGHT_N / share).thrust_ratio is None


def test_a_climb_does_not_change_the_thrust_ratio() -> None:
    """The accelerometer measures the additional thrust as well."""
    assert learned_bias(
        (0.0, 0.0, -1.4 * GRAVITY_M_S2), thrust_n=1.4 * WEIGHT_N, seconds=1.2
    ).thrust_ratio == (pytest.approx(1.0))


def test_a_bump_counts_as_a_limited_share_of_the_thrust() -> None:
    factors = (5.0, 1.0 + _SCALE_STEP)
    hard, soft = (learned_bias((0.0, 0.0, -factor * GRAVITY_M_S2), DT_S) for factor in factors)
    assert hard.scale == pytest.approx(soft.scale)
    assert soft.scale > 1.0


def test_noise_is_stated_per_sample_and_axis() -> None:
    """It is half the mean square of the differences, which are 0.2 m/s2 on each axis."""
    bias = HoverBias(ESTIMATION, MASS)
    for i in range(2000):
        bias.learn((0.2 * (i % 2), 0.2 * (i % 2), -GRAVITY_M_S2), STILL, 0.0, WEIGHT_N, DT_S)
    assert bias.noise_m_s2 == pytest.approx(0.2 / math.sqrt(2.0), rel=0.02)


def test_noise_has_a_lower_limit() -> None:
    """A simulated sensor repeats itself."""
    bias = HoverBias(ESTIMATION, MASS)
    for _ in range(3000):
        bias.learn((0.0, 0.0, -GRAVITY_M_S2), STILL, 0.0, WEIGHT_N, DT_S)
    assert bias.noise_m_s2 == pytest.approx(math.sqrt(_MIN_NOISE2))


# --- the baseline ------------------------------------------------------------------------------------------


def test_the_baseline_follows_a_slow_force_late() -> None:
    baseline, values = ForceBaseline(ESTIMATION), []
    for _ in range(round(BASELINE_S / DT_S)):
        baseline.update(0.5, -0.3, DT_S)
        values.append(baseline.value)
    delay = _BASELINE_DELAY - 1
    assert values[: delay - 1] == [(0.0, 0.0)] * (delay - 1)
    assert values[delay][0] > 0.0
    x, y = values[-1]
    late = math.exp(-1.0 + delay * DT_S / BASELINE_S)
    assert (x, y) == pytest.approx((0.5 * (1.0 - late), -0.3 * (1.0 - late)), rel=0.02)


def test_the_baseline_is_limited_in_size_and_rate() -> None:
    baseline, fast = ForceBaseline(ESTIMATION), ForceBaseline(ESTIMATION)
    for _ in range(round(20 * BASELINE_S / DT_S)):
        baseline.update(40.0, -40.0, DT_S)
    limit = ESTIMATION.baseline_limit_n / math.sqrt(2.0)
    assert baseline.value == pytest.approx((limit, -limit), rel=0.01)
    first = ForceBaseline(ESTIMATION)
    for _ in range(10):
        fast.update(-100.0, 0.0, DT_S)
        first.update(-_BASELINE_STEP_N, 0.0, DT_S)
    assert fast.value[0] == pytest.approx(first.value[0], rel=0.05)


def test_a_contact_restores_the_baseline_from_before_its_onset() -> None:
    baseline = ForceBaseline(ESTIMATION)
    for _ in range(500):
        baseline.update(0.5, 0.0, DT_S)
    before = baseline.value
    baseline.update(9.0, 0.0, DT_S)
    baseline.settle()
    assert baseline.value[0] == pytest.approx(before[0], rel=0.01)
    again = baseline.value
    for _ in range(5):
        baseline.update(9.0, 0.0, DT_S)
        assert baseline.value == again  # the delay applies again
    baseline.settle()
    for _ in range(12):
        baseline.update(*baseline.value, DT_S)
    assert baseline.value[0] == pytest.approx(before[0], rel=0.01)
