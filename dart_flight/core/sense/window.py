"""The horizontal force averaged over windows as long as the contacts waited for, and its own noise.

A motor's ringing and white noise shrink in a mean over 30 or 100 ms, a contact of that length hardly does. By
how much they shrink depends on their frequency, so it is not computed from the noise of a sample: what is
learnt, outside of contacts, is by how much each mean itself varies. docs/force.md.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from dart_flight.base.filters import LearntVariance
from dart_flight.base.geometry import Vec2

_QUICK_S: Final = 0.5  # a manoeuvre counts at once, and its noise is not forgotten at once
_SLOW_S: Final = 5.0
_MIN_N2: Final = 1e-4
_ASSUMED: Final = 5  # samples that the noise to begin with counts for
_DELAY: Final = 10  # samples: what a contact's foot teaches is thrown away at its onset


class WindowMean:
    """Mean of the horizontal force over the newest `length_s`, and the learnt deviation of that mean.

    Args:
        length_s: 0 for the sample itself.
        noise_n: deviation of one sample and axis to begin with, taken as white.
        samples: how many samples the window holds at the IMU's nominal rate.

    Attributes:
        mean: newton, mission frame.
        full: whether the samples reach back over the whole window.
        noise_n: deviation of one component of the mean.
    """

    def __init__(self, length_s: float, noise_n: float, samples: int) -> None:
        self._length_us = length_s * 1e6
        self._kept: deque[tuple[int, float, float]] = deque()
        self._x = self._y = 0.0
        self._since_sum = 0
        self._seen = 0
        variance = noise_n * noise_n / max(1, samples)
        self._quick = LearntVariance(variance, _QUICK_S, _MIN_N2)
        self._slow = LearntVariance(variance, _SLOW_S, _MIN_N2)
        self._pending: deque[float] = deque()
        # A force that is there all the time is no noise: two means are compared that share no sample. One
        # window apart they agree by chance only for a tone that the window itself takes out.
        self._past: deque[Vec2] = deque(maxlen=max(1, samples))
        self.mean: Vec2 = (0.0, 0.0)
        self.full = False
        self.noise_n = math.sqrt(variance)

    def add(self, t_us: int, fx: float, fy: float) -> None:
        """Take a sample."""
        kept = self._kept
        kept.append((t_us, fx, fy))
        self._x += fx
        self._y += fy
        first = t_us - self._length_us
        while kept[0][0] <= first and len(kept) > 1:
            _, x, y = kept.popleft()
            self._x -= x
            self._y -= y
            self._since_sum += 1
            self.full = True
        if self._since_sum > len(kept):
            # Rounding must not pile up over hours: sum anew once a window.
            self._since_sum = 0
            self._x, self._y = sum(s[1] for s in kept), sum(s[2] for s in kept)
        n = len(kept)
        self.mean = (self._x / n, self._y / n)

    def learn(self, dt_s: float) -> None:
        """A mean outside of contacts teaches the noise: how far it is from the one a window before it."""
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
        # At first a plain mean, so that what was assumed is forgotten once something is known.
        first = 1.0 / (_ASSUMED + self._seen)
        quick, slow = self._quick.learn(square, dt_s, first), self._slow.learn(square, dt_s, first)
        self.noise_n = math.sqrt(quick if quick > slow else slow)

    def forget(self) -> None:
        """A contact has begun, or the stream broke off: what it has taught so far is thrown away."""
        self._pending.clear()
        self._past.clear()


def half_sine_share(samples: int, duration_s: float, period_s: float) -> float:
    """The least that the largest mean over a window of a half-sine of height one can be.

    Samples fall on it anyhow: half a period beside its middle at the worst. It is the sum of sines at equal
    distances, in closed form.

    Args:
        samples: in the window.
        duration_s: of the half-sine.
        period_s: between samples.
    """
    x = 0.5 * math.pi * period_s / duration_s
    if x >= 0.5 * math.pi:
        return 0.0  # it may fall between two samples
    return math.sin(min(samples * x, 0.5 * math.pi)) / (samples * math.tan(x))
