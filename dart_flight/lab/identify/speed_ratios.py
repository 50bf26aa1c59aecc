"""Restitution, tangential ratio and friction from the speeds before and after hits.

Intervals follow from the spread of the hits. If there are few hits, Student's factor widens the intervals.
The uncertainty of the speeds gives a lower limit for the width of the intervals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from dart_flight.base.summary import Z95, student_t
from dart_flight.contact.coefficients import Array
from dart_flight.lab.identify.estimates import Estimate
from dart_flight.lab.identify.measured_impacts import MeasuredImpact

_MIN_ALONG_M_S = 0.1  # speed along the wall required for a ratio


def _ratio(
    shares: Array, deviations: Array, least: float = -math.inf, most: float = math.inf
) -> Estimate | None:
    """Return the median of ratios with a 95 % interval, both clipped to `least` and `most`.

    The interval follows from the spread of the ratios or from their uncertainty, whichever gives the wider
    interval.
    """
    n = shares.size
    if not n:
        return None
    value = float(np.median(shares))
    half = Z95 * float(np.sqrt(np.mean(deviations**2) / n))
    if n >= 2:
        # The median of a normal sample spreads 1.25 times as much as its mean.
        spread = 1.25 * float(np.std(shares, ddof=1)) / math.sqrt(n)
        half = max(half, student_t(n - 1) * spread)
    return Estimate.about(value, half, least, most)


def restitution(hits: Sequence[MeasuredImpact]) -> Estimate | None:
    """Return outgoing over incoming normal speed; in a drop, both at the height of first touch."""
    known = [(h, h.normal_out_m_s) for h in hits if h.normal_out_m_s is not None]
    shares = np.array([out / h.normal_in_m_s for h, out in known])
    sds = np.array(
        [
            math.hypot(h.sd_out_m_s, e * h.sd_in_m_s) / h.normal_in_m_s
            for (h, _), e in zip(known, shares, strict=True)
        ]
    )
    return _ratio(shares, sds, 0.0, 1.0)


def _sliding_hits(hits: Sequence[MeasuredImpact]) -> Iterator[tuple[MeasuredImpact, float, float]]:
    """Yield each hit with motion along the wall, with the velocities along the wall before and after."""
    for h in hits:
        before, after = h.tangential_in_m_s, h.tangential_out_m_s
        if before is None or after is None:
            continue
        if abs(before) >= max(_MIN_ALONG_M_S, 5.0 * h.sd_tangential_m_s):
            yield h, before, after


def tangential_ratio(hits: Sequence[MeasuredImpact]) -> Estimate | None:
    """Return outgoing over incoming velocity along the wall; None if no hit has motion along the wall.

    The ratio is negative if the vehicle reverses along the wall.
    """
    pairs = [
        (after / before, 1.5 * h.sd_tangential_m_s / abs(before)) for h, before, after in _sliding_hits(hits)
    ]
    shares, deviations = np.array(pairs).reshape(-1, 2).T
    return _ratio(shares, deviations)


def friction(hits: Sequence[MeasuredImpact]) -> Estimate | None:
    """Return the paper's mu = ln(v_in / v_out) / dv.

    v_in and v_out are the velocities along the wall before and after the hit, and dv is the change of the
    normal velocity.
    """
    pairs = []
    for h, before, after in _sliding_hits(hits):
        if h.normal_out_m_s is not None and after / before > 0.05:
            change = h.normal_in_m_s + h.normal_out_m_s
            pairs.append((math.log(before / after) / change, 1.5 * h.sd_tangential_m_s / abs(after) / change))
    shares, deviations = np.array(pairs).reshape(-1, 2).T
    estimate = _ratio(shares, deviations, 0.0)
    return None if estimate is None or estimate.value <= 0.0 else estimate
