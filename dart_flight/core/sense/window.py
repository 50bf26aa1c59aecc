"""Means of the horizontal force over windows as long as a contact, and the noise of these means.

A mean over 30 or 100 ms reduces motor vibration and white noise. The mean hardly reduces the force of a
contact that lasts as long as the window. The reduction of a vibration depends on its frequency, so the noise
of a mean does not follow from the noise of a sample. Each window therefore learns the variance of its own
mean outside of contacts (docs/force.md).
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from dart_flight.base.arithmetic import sum_in_order
from dart_flight.base.filters import VarianceEstimate
from dart_flight.base.geometry import Vec2

# Time constants of two variances. The larger variance is used: it follows rising noise quickly and falling
# noise slowly.
_QUICK_S: Final = 0.5
_SLOW_S: Final = 5.0
_MIN_N2: Final = 1e-4
_ASSUMED: Final = 5  # the initial noise counts as this many samples
_DELAY: Final = 10  # learning is delayed by this many samples; an onset discards the samples in between


class WindowMean:
    """Mean of the horizontal force over the newest `length_s`, with the learnt noise of that mean.

    Args:
        length_s: averaging time; 0 if the newest sample alone is the mean.
        noise_n: initial standard deviation of one sample of one axis; the noise is assumed white.
        samples: number of samples in the window at the IMU's nominal rate.

    Attributes:
        mean: newton, mission frame.
        full: whether the samples cover the whole window.
        noise_n: standard deviation of one component of the mean.
    """

    def __init__(self, length_s: float, noise_n: float, samples: int) -> None:
        self._length_us = length_s * 1e6
        self._kept: deque[tuple[int, float, float]] = deque()
        self._x = self._y = 0.0
        self._since_sum = 0
        self._seen = 0
        variance = noise_n * noise_n / max(1, samples)
        self._quick = VarianceEstimate(variance, _QUICK_S, _MIN_N2)
        self._slow = VarianceEstimate(variance, _SLOW_S, _MIN_N2)
        self._pending: deque[float] = deque()
        # Two means one window apart share no samples, and in their difference a constant force cancels out.
        self._past: deque[Vec2] = deque(maxlen=max(1, samples))
        self.mean: Vec2 = (0.0, 0.0)
        self.full = False
        self.noise_n = math.sqrt(variance)

    def add(self, t_us: int, fx: float, fy: float) -> None:
        kept = self._kept
        kept.append((t_us, fx, fy))
        x, y = self._x + fx, self._y + fy
        first = t_us - self._length_us
        while kept[0][0] <= first and len(kept) > 1:
            _, old_x, old_y = kept.popleft()
            x, y = x - old_x, y - old_y
            self._since_sum += 1
            self.full = True
        n = len(kept)
        if self._since_sum > n:
            # Sum again once per window, so that rounding errors do not accumulate.
            self._since_sum = 0
            x, y = sum_in_order([s[1] for s in kept]), sum_in_order([s[2] for s in kept])
        self._x, self._y = x, y
        self.mean = (x / n, y / n)

    def learn(self, dt_s: float) -> None:
        """Update the noise from the current mean and the mean one window earlier; do not call in contacts."""
        past, pending, mean = self._past, self._pending, self.mean
        if len(past) == past.maxlen:
            (x, y), (before_x, before_y) = mean, past[0]
            dx, dy = x - before_x, y - before_y
            pending.append(0.25 * (dx * dx + dy * dy))
        past.append(mean)
        if len(pending) <= _DELAY:
            return
        square = pending.popleft()
        self._seen += 1
        # Use a plain mean at first, so that measurements quickly replace the initial noise.
        first = 1.0 / (_ASSUMED + self._seen)
        quick, slow = self._quick.update(square, dt_s, first), self._slow.update(square, dt_s, first)
        self.noise_n = math.sqrt(quick if quick > slow else slow)

    def forget(self) -> None:
        """Discard the noise samples that are not used yet; call after an onset or a gap in the stream."""
        self._pending.clear()
        self._past.clear()


def half_sine_share(samples: int, duration_s: float, period_s: float) -> float:
    """Return the worst-case ratio of the largest mean of `samples` to the height of a half-sine.

    In the worst case, the centre of the window lies half a sampling period off the middle of the half-sine.
    The result is the closed form of a sum of equally spaced sines.
    """
    x = 0.5 * math.pi * period_s / duration_s
    if x >= 0.5 * math.pi:
        return 0.0  # in the worst case, no sample falls into the half-sine
    return math.sin(min(samples * x, 0.5 * math.pi)) / (samples * math.tan(x))
