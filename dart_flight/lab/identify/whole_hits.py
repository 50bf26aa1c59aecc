"""What hits as a whole tell: restitution, tangential ratio, and coefficients where samples do not.

Intervals come from resampling hits (the spread of what they say, with Student's factor for few), and are
never narrower than the measurement of the speeds allows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dart_flight.contact.coefficients import Array
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.estimates import Estimate
from dart_flight.lab.identify.measured_impacts import MeasuredImpact
from dart_flight.lab.identify.whole_fit import HitTable, fit
from dart_flight.lab.statistics import Z95, student_t

_RESAMPLES = 60
_SEED = 1  # the same trials give the same interval
_MIN_ALONG_M_S = 0.1  # along the wall, below which a ratio says nothing
_WIDEST_LOG = math.log(3.0)  # a coefficient known less well than to a factor of three is not known


def _ratio(
    shares: Array, deviations: Array, least: float = -math.inf, most: float = math.inf
) -> Estimate | None:
    """Median of ratios with a 95 % interval: of their spread, at least of their measurement.

    Value and interval are kept between the least and the most that the ratio can be.
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
    return Estimate(*(min(max(v, least), most) for v in (value, value - half, value + half)))


def restitution(hits: Sequence[MeasuredImpact]) -> Estimate | None:
    """Normal speed out over normal speed in; in a drop at the height of first touch."""
    known = [(h, h.normal_out_m_s) for h in hits if h.normal_out_m_s is not None]
    shares = np.array([out / h.normal_in_m_s for h, out in known])
    sds = np.array(
        [
            math.hypot(h.sd_out_m_s, e * h.sd_in_m_s) / h.normal_in_m_s
            for (h, _), e in zip(known, shares, strict=True)
        ]
    )
    return _ratio(shares, sds, 0.0, 1.0)


def tangential_ratio(hits: Sequence[MeasuredImpact]) -> Estimate | None:
    """Velocity along the wall after a hit over that before; None where none of them moves along it.

    Below 0 where the vehicle comes back along the wall.
    """
    shares, sds = [], []
    for h in hits:
        before, after = h.tangential_in_m_s, h.tangential_out_m_s
        if before is None or after is None or abs(before) < max(_MIN_ALONG_M_S, 5.0 * h.sd_tangential_m_s):
            continue
        shares.append(after / before)
        sds.append(1.5 * h.sd_tangential_m_s / abs(before))
    return _ratio(np.array(shares), np.array(sds))


def friction(hits: Sequence[MeasuredImpact]) -> Estimate | None:
    """The paper's mu from speeds alone: ln(in/out) along the wall is mu times the normal speed's change."""
    found, sds = [], []
    for h in hits:
        before, after, out = h.tangential_in_m_s, h.tangential_out_m_s, h.normal_out_m_s
        if before is None or after is None or out is None or after / before <= 0.05:
            continue
        if abs(before) < max(_MIN_ALONG_M_S, 5.0 * h.sd_tangential_m_s):
            continue
        change = h.normal_in_m_s + out
        found.append(math.log(before / after) / change)
        sds.append(1.5 * h.sd_tangential_m_s / abs(after) / change)
    estimate = _ratio(np.array(found), np.array(sds), 0.0)
    if estimate is None or estimate.value <= 0.0:
        return None
    return estimate


def stiffness_and_damping(
    hits: Sequence[MeasuredImpact], mass_kg: float, onset: Onset
) -> tuple[dict[str, Estimate | None], list[str]]:
    """k and f from hits as a whole, with intervals from drawing the hits anew.

    Returns:
        `k` and `f` -> estimate, None where it is not known; and notes.
    """
    table = HitTable.of(hits)
    found: dict[str, Estimate | None] = {"k": None, "f": None}
    if not table.is_enough:
        return found, []
    best = fit(table, mass_kg, onset)
    n = len(hits)
    half = Z95 * best.deviation
    if n >= 3:
        random = np.random.default_rng(_SEED)
        times = random.multinomial(n, np.full(n, 1.0 / n), size=_RESAMPLES)
        again = (table.only(np.repeat(np.arange(n), drawn)) for drawn in times)
        logs = np.array([fit(drawn, mass_kg, onset, best.logs).logs for drawn in again])
        spread = 1.4826 * np.median(np.abs(logs - np.median(logs, axis=0)), axis=0)
        half = np.maximum(half / math.sqrt(n), student_t(n - 1) * spread * math.sqrt(n / (n - 1)))
    notes = []
    for name, log, off, at_bound in zip(found, best.logs, half, best.at_bound, strict=True):
        if at_bound:
            notes.append(f"{name} is at a bound of the search and not known")
        elif off < _WIDEST_LOG:
            found[name] = Estimate(*(math.exp(v) for v in (log, log - off, log + off)))
    return found, notes
