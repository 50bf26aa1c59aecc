"""First-order filters of samples, and a running estimate of a noise variance."""

from __future__ import annotations

import math
from typing import Final

from dart_flight.base.geometry import Vec3

_MAX_STEP_S: Final = 0.05  # after a gap in the stream, a sample represents at most this time
_OUTLIER: Final = 9.0  # a square is clipped at this multiple of the current variance


def decay_factor(dt_s: float, time_s: float) -> float:
    """Return the fraction of an old value that remains after `dt_s`, or 0 if the time constant is 0."""
    return math.exp(-dt_s / time_s) if time_s > 0.0 else 0.0


def average_weight(dt_s: float, time_s: float) -> float:
    """Return the weight of a new sample in a slow average; the time constant must be far above `dt_s`."""
    return (dt_s if dt_s < _MAX_STEP_S else _MAX_STEP_S) / time_s


class LowPass:
    """First-order low-pass of a vector; a time constant of 0 disables it."""

    def __init__(self, time_s: float) -> None:
        self._time_s = time_s
        self._dt_s, self._keep = 0.0, 1.0
        self.value: Vec3 = (0.0, 0.0, 0.0)

    def update(self, x: Vec3, dt_s: float) -> Vec3:
        if dt_s != self._dt_s:
            self._dt_s, self._keep = dt_s, decay_factor(dt_s, self._time_s)
        keep, old = self._keep, self.value
        self.value = (
            x[0] + (old[0] - x[0]) * keep,
            x[1] + (old[1] - x[1]) * keep,
            x[2] + (old[2] - x[2]) * keep,
        )
        return self.value


class VarianceEstimate:
    """Running estimate of a noise variance, as a weighted mean of the squares that `update` receives.

    A square far above the variance is clipped first. The variance is never below `least`, because some noise
    is always possible. Every update also adds `added` to the variance.
    """

    def __init__(self, value: float, time_s: float, least: float = 0.0, added: float = 0.0) -> None:
        self.value = value
        self._time_s, self._least, self._added = time_s, least, added

    def update(self, square: float, dt_s: float, least_share: float = 0.0) -> float:
        """Include the next square, `dt_s` after the previous one, with a weight of at least `least_share`."""
        share = (dt_s if dt_s < _MAX_STEP_S else _MAX_STEP_S) / self._time_s
        share = share if share > least_share else least_share
        value = self.value
        most = _OUTLIER * value
        # Comparisons are faster than calls of `min` and `max`, and twelve variances are updated per sample.
        value += share * ((square if square < most else most) - value) + self._added
        self.value = value if value > self._least else self._least
        return self.value
