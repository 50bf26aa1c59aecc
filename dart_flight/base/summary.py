"""Summaries of many flights: rates and spreads with their confidence intervals, and causes."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Sequence

import msgspec

Z95 = 1.959964  # 97.5 % point of the normal distribution
_T_FEW = (12.7062, 4.3027, 3.1824, 2.7764, 2.5706, 2.4469, 2.3646, 2.3060, 2.2622, 2.2281)


class Share(msgspec.Struct, frozen=True):
    """A success rate (`count` of `of` flights) with its 95 % interval (Wilson's score interval), 0 to 1.

    Rate and interval are None without flights.
    """

    count: int
    of: int
    share: float | None
    low: float | None
    high: float | None

    def words(self, unknown: str) -> tuple[str, str]:
        """Return the rate and its interval as two texts, in percent. Without flights both are `unknown`."""
        if self.share is None or self.low is None or self.high is None:
            return unknown, unknown
        return f"{100.0 * self.share:.1f} %", f"{100.0 * self.low:.1f} to {100.0 * self.high:.1f} %"


def share(successes: int, flights: int) -> Share:
    if not flights:
        return Share(0, 0, None, None, None)
    return Share(successes, flights, successes / flights, *wilson(successes, flights))


def wilson(successes: int, flights: int) -> tuple[float, float]:
    """Return the 95 % interval of a success rate (Wilson's score interval)."""
    z, p = Z95, successes / flights
    middle = (p + z * z / (2 * flights)) / (1 + z * z / flights)
    half = z * math.sqrt(p * (1 - p) / flights + z * z / (4 * flights**2)) / (1 + z * z / flights)
    return max(0.0, middle - half), min(1.0, middle + half)


class Spread(msgspec.Struct, frozen=True):
    """Distribution of one value over many flights. Flights without this value are not counted.

    Attributes:
        mean_half_width: half the width of the mean's 95 % interval (Student's t).
        low, low_5, high_95, high: smallest value, 5 % and 95 % percentiles, and largest value. They are
            sorted by value, or by magnitude with `order=abs`.
    """

    count: int
    mean: float
    mean_half_width: float | None
    sd: float | None
    low: float
    low_5: float
    median: float
    high_95: float
    high: float


def spread(values: Iterable[float | None], order: Callable[[float], float] | None = None) -> Spread | None:
    """Return the distribution of the finite values, or None if there is none.

    Args:
        order: `abs` orders by magnitude, so that `high` of negative velocities is the fastest.
    """
    known = sorted((v for v in values if v is not None and math.isfinite(v)), key=order)
    if not known:
        return None
    last = len(known) - 1
    return Spread(
        len(known),
        statistics.fmean(known),
        mean_half_width(known),
        statistics.stdev(known) if last else None,
        known[0],
        known[round(0.05 * last)],
        statistics.median(known),
        known[round(0.95 * last)],
        known[-1],
    )


def cause_of(reason: str) -> str:
    """Return the cause in a flight's reason: the text up to the first colon, such as a guard rule."""
    return reason.partition(":")[0]


def student_t(freedom: int) -> float:
    """Return the 97.5 % point of Student's t.

    Up to ten degrees of freedom the point comes from a table, because the expansion about the normal quantile
    is inaccurate.
    """
    if freedom <= len(_T_FEW):
        return _T_FEW[freedom - 1]
    z = Z95
    g1, g2 = (z**3 + z) / 4.0, (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / 96.0
    g3 = (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / 384.0
    return z + g1 / freedom + g2 / freedom**2 + g3 / freedom**3


def mean_half_width(values: Sequence[float]) -> float | None:
    """Return half the width of the mean's 95 % interval (Student's t), or None for fewer than two values."""
    n = len(values)
    if n < 2:
        return None
    return student_t(n - 1) * statistics.stdev(values) / math.sqrt(n)
