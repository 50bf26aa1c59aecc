"""Restitution, tangential ratio and friction from the speeds before and after hits.

Intervals follow from the spread of the hits. If there are few hits, Student's factor widens the intervals.
The uncertainty of the speeds gives a lower limit for the width of the intervals.
"""

from __future__ import annotations

import math

import numpy as np

from dart_flight.base.summary import Z95, student_t
from dart_flight.contact.coefficients import Array
from dart_flight.lab.identify.estimates import Estimate
from dart_flight.lab.identify.problem import LawProblem

_MIN_ALONG_M_S = 0.1  # minimum speed along the wall for a ratio


def _ratio(
    shares: Array, deviations: Array, least: float = -math.inf, most: float = math.inf
) -> Estimate | None:
    """Return the median of ratios with a 95 % interval, both clipped to `least` and `most`.

    Two intervals follow from the spread and from the uncertainty of the ratios; the wider one is used.
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


def restitution(problem: LawProblem) -> Estimate | None:
    """Return the ratio of outgoing to incoming normal speed; in a drop, both at the height of first touch."""
    e = problem.speed_out / problem.speed_in
    sd = np.hypot(problem.column("sd_out_m_s"), e * problem.column("sd_in_m_s")) / problem.speed_in
    known = np.isfinite(e)
    return _ratio(e[known], sd[known], 0.0, 1.0)


def _sliding(problem: LawProblem) -> tuple[LawProblem, Array, Array, Array]:
    """Return hits with motion along the wall, their velocities before and after, and standard deviations."""
    before, after = problem.column("tangential_in_m_s"), problem.column("tangential_out_m_s")
    sd = problem.column("sd_tangential_m_s")
    slides = (np.abs(before) >= np.maximum(_MIN_ALONG_M_S, 5.0 * sd)) & np.isfinite(after)
    return problem.only(slides), before[slides], after[slides], sd[slides]


def tangential_ratio(problem: LawProblem) -> Estimate | None:
    """Return outgoing over incoming velocity along the wall; None if no hit has motion along the wall.

    The ratio is negative if the vehicle reverses along the wall.
    """
    _, before, after, sd = _sliding(problem)
    return _ratio(after / before, 1.5 * sd / np.abs(before))


def friction(problem: LawProblem) -> Estimate | None:
    """Return the paper's mu = ln(v_in / v_out) / dv.

    v_in and v_out are the velocities along the wall before and after the hit, and dv is the change of the
    normal velocity.
    """
    hits, before, after, sd = _sliding(problem)
    change = hits.speed_in + hits.speed_out
    slowed = (after / before > 0.05) & np.isfinite(change)
    before, after, sd, change = before[slowed], after[slowed], sd[slowed], change[slowed]
    estimate = _ratio(np.log(before / after) / change, 1.5 * sd / np.abs(after) / change, 0.0)
    return None if estimate is None or estimate.value <= 0.0 else estimate
