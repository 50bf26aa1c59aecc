"""Errors of the force estimate, learnt in flight: hover bias, thrust scale, noise, slow baseline.

Without contact, the accelerometer reads the thrust along the thrust axis, because drag along that axis is
small. Across this axis, the accelerometer in hover reads only its own bias and perhaps wind. A limited
baseline follows slow forces, such as wind and errors of thrust and drag in tilted flight. A contact rises too
fast for the baseline. The force estimator and the impact detector use this module.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from dart_flight.base.filters import VarianceEstimate, average_weight
from dart_flight.base.geometry import GRAVITY_M_S2, Vec2, Vec3
from dart_flight.config.vehicle import Estimation

# Below both limits the vehicle hovers. Otherwise drag and lever-arm terms would disturb the bias.
HOVER_SPEED_M_S: Final = 0.4
HOVER_RATE_RAD_S: Final = 0.3  # limit of the sum of the three body rates' magnitudes
LEARNING_S: Final = 2.0  # time constant of bias and thrust scale, longer than any contact
BIAS_LIMIT_M_S2: Final = 0.4  # limit per axis; PX4 has already removed most of the bias
THRUST_SCALE_LIMIT: Final = 0.25  # 4.3 standard deviations: 3 % from the mass, 5 % from the battery
BASELINE_S: Final = 0.25  # time constant, faster than wind and thrust errors, longer than contacts
_NOISE_TIME_S: Final = 0.5
_MIN_NOISE2: Final = 1e-4  # m2/s4
_SCALE_STEP: Final = 0.25
_LEARNT: Final = 0.4  # a low-pass reaches this fraction in half a time constant; needed for `thrust_ratio`
_BASELINE_DELAY: Final = 10  # delay in samples, 40 ms; a slow contact reaches the threshold sooner
_BASELINE_STEP_N: Final = 2.0  # largest difference that the baseline follows proportionally


class HoverBias:
    """Accelerometer bias across the thrust axis, thrust scale and noise of one sample.

    Attributes:
        bias_x, bias_y: bias in the accelerometer's readings, body FRD, m/s2.
        scale: true thrust divided by the thrust of the curve, limited to within `THRUST_SCALE_LIMIT` of 1.
        thrust_ratio: the same ratio without a limit, or None before the ratio has settled.
        noise_m_s2: standard deviation of the white noise in one sample of one axis.
    """

    def __init__(self, config: Estimation, mass_kg: float) -> None:
        self._mass = mass_kg
        self.bias_x = self.bias_y = 0.0
        self.scale = 1.0
        self.noise_m_s2 = config.imu_noise_m_s2
        self._variance = VarianceEstimate(config.imu_noise_m_s2**2, _NOISE_TIME_S, _MIN_NOISE2)
        self._last: Vec3 | None = None
        # Low-pass filters that start at zero, so that their quotient has no bias.
        self._weight = self._measured_n = self._curve_n = 0.0
        self.thrust_ratio: float | None = None

    def learn(self, f: Vec3, rate: Vec3, speed_m_s: float, curve_thrust_n: float, dt_s: float) -> None:
        """Learn from a sample outside of contacts.

        Args:
            f: reported specific force, FRD, m/s2.
            rate: body rate, rad/s.
            curve_thrust_n: mean thrust during the tick, computed by the thrust model without `scale`.
        """
        self._learn_noise(f, dt_s)
        share = average_weight(dt_s, LEARNING_S)
        self._weight += share * (1.0 - self._weight)
        self._measured_n += share * (-f[2] * self._mass - self._measured_n)
        self._curve_n += share * (curve_thrust_n - self._curve_n)
        if self._weight > _LEARNT and self._curve_n > 0.0:
            self.thrust_ratio = self._measured_n / self._curve_n
        if curve_thrust_n < 0.5 * self._mass * GRAVITY_M_S2:
            return
        most = THRUST_SCALE_LIMIT
        measured = -f[2] * self._mass / curve_thrust_n
        # Limit the step: a distant value is a disturbance, not a thrust error.
        measured = max(self.scale - _SCALE_STEP, min(self.scale + _SCALE_STEP, measured))
        self.scale = max(1.0 - most, min(1.0 + most, self.scale + share * (measured - self.scale)))
        if speed_m_s < HOVER_SPEED_M_S and abs(rate[0]) + abs(rate[1]) + abs(rate[2]) < HOVER_RATE_RAD_S:
            most = BIAS_LIMIT_M_S2
            self.bias_x = _bounded(self.bias_x + share * (f[0] - self.bias_x), most)
            self.bias_y = _bounded(self.bias_y + share * (f[1] - self.bias_y), most)

    def _learn_noise(self, f: Vec3, dt_s: float) -> None:
        # Differences of successive samples ignore everything that changes more slowly.
        last, self._last = self._last, f
        if last is None:
            return
        dx, dy = f[0] - last[0], f[1] - last[1]
        self.noise_m_s2 = math.sqrt(self._variance.update(0.25 * (dx * dx + dy * dy), dt_s))


def _bounded(value: float, most: float) -> float:
    return value if -most <= value <= most else math.copysign(most, value)


class ForceBaseline:
    """Estimator of the slow horizontal force, mission frame, newton, up to `baseline_limit_n`.

    The detector subtracts `value` before it compares a force with a threshold. `value` is some samples old,
    so the start of a contact is not subtracted from the contact itself.
    """

    def __init__(self, config: Estimation) -> None:
        self._limit = config.baseline_limit_n
        self._now: Vec2 = (0.0, 0.0)
        self._past: deque[Vec2] = deque([(0.0, 0.0)], maxlen=_BASELINE_DELAY)
        self.value: Vec2 = (0.0, 0.0)

    def update(self, fx: float, fy: float, dt_s: float) -> None:
        """Update the baseline with a force sample from outside of contacts, newton."""
        share = average_weight(dt_s, BASELINE_S)
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
        """Reset the baseline to its value before a contact began."""
        self._now = self.value
        self._past.clear()
        self._past.append(self.value)
