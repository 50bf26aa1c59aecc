"""Statistics of campaigns: bins, rank tests and correlations."""

from __future__ import annotations

import bisect
import math
import statistics
from collections.abc import Sequence
from typing import NamedTuple

_FEWEST_PAIRS, _SURE = 10, 1.0 - 1e-12


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
