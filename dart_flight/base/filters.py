"""First-order filters of samples, and the variance of a noise that is learnt with one."""

from __future__ import annotations

import math
from typing import Final

from dart_flight.base.geometry import Vec3

_MAX_STEP_S: Final = 0.05  # after a gap in the stream one sample counts for this long at most
_OUTLIER: Final = 9.0  # a square counts at most this many times the present variance


def kept_share(dt_s: float, time_s: float) -> float:
    """What is left of a difference after `dt_s` at a time constant; 0 for one of 0."""
    return math.exp(-dt_s / time_s) if time_s > 0.0 else 0.0


def taken_share(dt_s: float, time_s: float) -> float:
    """How much of a sample is taken by what is learnt slowly: at a time constant far over `dt_s`."""
    return (dt_s if dt_s < _MAX_STEP_S else _MAX_STEP_S) / time_s


class LowPass:
    """First-order low-pass of a vector.

    Args:
        time_s: time constant; 0: not filtered.

    Attributes:
        value: newest.
    """

    def __init__(self, time_s: float) -> None:
        self._time_s = time_s
        self._dt_s, self._keep = 0.0, 1.0
        self.value: Vec3 = (0.0, 0.0, 0.0)

    def follow(self, x: Vec3, dt_s: float) -> Vec3:
        """Take a sample, `dt_s` after the one before; returns the new value."""
        if dt_s != self._dt_s:
            self._dt_s, self._keep = dt_s, kept_share(dt_s, self._time_s)
        keep, old = self._keep, self.value
        self.value = (
            x[0] + (old[0] - x[0]) * keep,
            x[1] + (old[1] - x[1]) * keep,
            x[2] + (old[2] - x[2]) * keep,
        )
        return self.value


class LearntVariance:
    """Variance of a noise, from squares of which it is the mean; outliers count for little.

    No noise is ever known not to be there: certainty must not become absolute.

    Args:
        value: to begin with.
        time_s: time constant.
        least: it does not fall below.
        added: with every square.
    """

    def __init__(self, value: float, time_s: float, least: float = 0.0, added: float = 0.0) -> None:
        self.value = value
        self._time_s, self._least, self._added = time_s, least, added

    def learn(self, square: float, dt_s: float, least_share: float = 0.0) -> float:
        """Take a square, `dt_s` after the one before, by this share at least; returns the new value."""
        share = (dt_s if dt_s < _MAX_STEP_S else _MAX_STEP_S) / self._time_s
        share = share if share > least_share else least_share
        value = self.value
        most = _OUTLIER * value
        # Comparisons, where `min` and `max` would do: twelve learn from every sample, and a call costs more.
        value += share * ((square if square < most else most) - value) + self._added
        self.value = value if value > self._least else self._least
        return self.value
