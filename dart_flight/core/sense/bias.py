"""What is learnt of the estimate's own errors in flight: hover bias, thrust scale, noise, slow baseline.

Along the thrust axis the accelerometer reads the thrust, in any flight without contact: air drag along that
axis is small. Across it, while the vehicle hovers, it reads its own bias, wind at most. Slow forces that come
and go (wind, errors of thrust and drag when tilted) are followed by a baseline with a limit; a contact rises
too fast for it.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from dart_flight.base.filters import LearntVariance, taken_share
from dart_flight.base.geometry import GRAVITY_M_S2, Vec2, Vec3
from dart_flight.config.vehicle import Estimation

# Below both it counts as hovering: faster flight adds drag, and turning a lever arm, to the bias.
HOVER_SPEED_M_S: Final = 0.4
HOVER_RATE_RAD_S: Final = 0.3  # sum of the body rates' magnitudes
LEARNING_S: Final = 2.0  # time constant of bias and thrust scale, longer than any contact
BIAS_LIMIT_M_S2: Final = 0.4  # per axis; PX4 has removed most
THRUST_SCALE_LIMIT: Final = 0.25  # 4.3 standard deviations for 3 % spread of mass and 5 % of battery
BASELINE_S: Final = 0.25  # wind and thrust error are slower, a contact is shorter
_NOISE_TIME_S: Final = 0.5
_MIN_NOISE2: Final = 1e-4  # m2/s4
_SCALE_STEP: Final = 0.25
_LEARNT: Final = 0.4  # output of a low-pass, as a share of its final value, after half a time constant
_BASELINE_DELAY: Final = 10  # samples: 40 ms, in which even a slow contact reaches the threshold
_BASELINE_STEP_N: Final = 2.0  # further than this from the baseline it is not followed any faster


class HoverBias:
    """Accelerometer bias across the thrust axis, thrust scale and noise of one sample.

    Attributes:
        bias_x, bias_y: body FRD, m/s2; part of the reading.
        scale: true thrust over the curve's, limited.
        thrust_ratio: the same ratio without a limit, or None before it has settled.
        noise_m_s2: standard deviation of the white part of one sample and axis.
    """

    def __init__(self, config: Estimation, mass_kg: float) -> None:
        self._mass = mass_kg
        self.bias_x = self.bias_y = 0.0
        self.scale = 1.0
        self.noise_m_s2 = config.imu_noise_m_s2
        self._variance = LearntVariance(config.imu_noise_m_s2**2, _NOISE_TIME_S, _MIN_NOISE2)
        self._last: Vec3 | None = None
        self._weight = self._felt_n = self._curve_n = (
            0.0  # low-passes that start at zero, so their quotient has no bias
        )
        self.thrust_ratio: float | None = None

    def learn(self, f: Vec3, rate: Vec3, speed_m_s: float, curve_thrust_n: float, dt_s: float) -> None:
        """A sample outside of contacts.

        Args:
            f: specific force as reported, FRD, m/s2.
            rate: body rate, rad/s.
            speed_m_s: of the vehicle.
            curve_thrust_n: mean thrust over the tick by the curve alone.
            dt_s: since the sample before.
        """
        self._learn_noise(f, dt_s)
        share = taken_share(dt_s, LEARNING_S)
        self._weight += share * (1.0 - self._weight)
        self._felt_n += share * (-f[2] * self._mass - self._felt_n)
        self._curve_n += share * (curve_thrust_n - self._curve_n)
        if self._weight > _LEARNT and self._curve_n > 0.0:
            self.thrust_ratio = self._felt_n / self._curve_n
        if curve_thrust_n < 0.5 * self._mass * GRAVITY_M_S2:
            return
        most = THRUST_SCALE_LIMIT
        seen = -f[2] * self._mass / curve_thrust_n
        # A seen scale far off is a bump and no thrust: it counts only as far as the limit.
        seen = max(self.scale - _SCALE_STEP, min(self.scale + _SCALE_STEP, seen))
        self.scale = max(1.0 - most, min(1.0 + most, self.scale + share * (seen - self.scale)))
        if speed_m_s < HOVER_SPEED_M_S and abs(rate[0]) + abs(rate[1]) + abs(rate[2]) < HOVER_RATE_RAD_S:
            most = BIAS_LIMIT_M_S2
            self.bias_x = _bounded(self.bias_x + share * (f[0] - self.bias_x), most)
            self.bias_y = _bounded(self.bias_y + share * (f[1] - self.bias_y), most)

    def _learn_noise(self, f: Vec3, dt_s: float) -> None:
        # Half the mean square of successive differences: blind to everything slower than two samples.
        last, self._last = self._last, f
        if last is None:
            return
        dx, dy = f[0] - last[0], f[1] - last[1]
        self.noise_m_s2 = math.sqrt(self._variance.learn(0.25 * (dx * dx + dy * dy), dt_s))


def _bounded(value: float, most: float) -> float:
    return value if -most <= value <= most else math.copysign(most, value)


class ForceBaseline:
    """Slow horizontal force, mission frame, newton, limited in size; `value` is taken off before a threshold.

    `value` is that of some samples ago, so that the foot of a contact is not taken off the contact itself.
    """

    def __init__(self, config: Estimation) -> None:
        self._limit = config.baseline_limit_n
        self._now: Vec2 = (0.0, 0.0)
        self._past: deque[Vec2] = deque([(0.0, 0.0)], maxlen=_BASELINE_DELAY)
        self.value: Vec2 = (0.0, 0.0)

    def follow(self, fx: float, fy: float, dt_s: float) -> None:
        """A sample outside of contacts, `dt_s` after the one before."""
        share = taken_share(dt_s, BASELINE_S)
        x, y = self._now
        x += share * _bounded(fx - x, _BASELINE_STEP_N)
        y += share * _bounded(fy - y, _BASELINE_STEP_N)
        size = math.sqrt(x * x + y * y)
        if size > self._limit:
            x, y = x * self._limit / size, y * self._limit / size
        self._now = (x, y)
        self._past.append(self._now)
        self.value = self._past[0]

    def settle(self) -> None:
        """A contact begins: go back to before its foot."""
        self._now = self.value
        self._past.clear()
        self._past.append(self.value)
