"""Statistics of campaigns and identification: confidence intervals, bins, rank tests and correlations."""

from __future__ import annotations

import bisect
import math
import statistics
from collections.abc import Sequence
from typing import NamedTuple

import msgspec

Z95 = 1.959964  # 97.5 % point of the normal distribution
_FEWEST_PAIRS, _SURE = 10, 1.0 - 1e-12
_T_FEW = (12.7062, 4.3027, 3.1824, 2.7764, 2.5706, 2.4469, 2.3646, 2.3060, 2.2622, 2.2281)


class Share(msgspec.Struct, frozen=True):
    """A success rate (`count` of `of`) with its 95 % interval (Wilson's score interval), 0 to 1.

    Rate and interval are None without flights.
    """

    count: int
    of: int
    share: float | None
    low: float | None
    high: float | None

    def words(self, unknown: str) -> tuple[str, str]:
        """Return the rate and its interval as two strings, in percent; without flights both are `unknown`."""
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


def bin_edges(values: Sequence[float], most: int = 8, least_in_one: int = 25) -> list[float]:
    """Return quantiles as the edges of bins with about equal counts. For few values there is one bin."""
    ordered = sorted(values)
    count = max(1, min(most, len(ordered) // least_in_one))
    edges = [ordered[round(i * (len(ordered) - 1) / count)] for i in range(count + 1)]
    distinct = sorted(set(edges))
    return distinct if len(distinct) > 1 else [ordered[0], ordered[-1]]


def bin_of(value: float, edges: Sequence[float]) -> int:
    """Return the index of the bin that contains a value; the last bin includes its upper edge."""
    return min(max(bisect.bisect_right(edges, value) - 1, 0), len(edges) - 2)


class Separation(NamedTuple):
    """The separation of two groups by a quantity (Mann and Whitney's U).

    Attributes:
        chance: probability that a value of the first group exceeds a value of the second group. A tie counts
            half. 0.5 means no separation.
        z: (`chance` - 0.5) / s, where s is the standard deviation of `chance` for groups that do not differ.
    """

    chance: float
    z: float


def separation(first: Sequence[float], second: Sequence[float]) -> Separation:
    """Compare two groups of values; neither may be empty."""
    below = sorted(second)
    wins = sum(0.5 * (bisect.bisect_left(below, v) + bisect.bisect_right(below, v)) for v in first)
    n, m = len(first), len(second)
    chance = wins / (n * m)
    return Separation(chance, (chance - 0.5) / math.sqrt((n + m + 1) / (12.0 * n * m)))


def rank_correlation(pairs: Sequence[tuple[float, float]]) -> float:
    """Return Spearman's rank correlation; equal values share a rank.

    The pairs must have at least two different first values and two different second values.
    """

    def ranks(values: Sequence[float]) -> list[float]:
        ordered = sorted(values)
        return [bisect.bisect_left(ordered, v) + bisect.bisect_right(ordered, v) for v in values]

    return statistics.correlation(ranks([x for x, _ in pairs]), ranks([y for _, y in pairs]))


def rank_correlation_chance(correlation: float, pairs: int) -> float:
    """Return the two-sided p value of Spearman's rank correlation; 1 for fewer than ten pairs.

    Fisher's z has the variance 1.06 / (n - 3).
    """
    if pairs < _FEWEST_PAIRS:
        return 1.0
    z = math.atanh(max(-_SURE, min(_SURE, correlation))) * math.sqrt((pairs - 3) / 1.06)
    return math.erfc(abs(z) / math.sqrt(2.0))


def student_t(freedom: int) -> float:
    """Return the 97.5 % point of Student's t.

    Up to ten degrees of freedom, use a table: the expansion about the normal quantile is inaccurate
    there.
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
