"""The choice of the next hits of a trial series: a pure function of the fit so far and the limits.

The speeds are equal steps up to the fastest safe speed. Half of the hits at each end of this range, or a
D-optimal choice over speed, angle and mode, did not narrow the intervals by as much as a quarter
(docs/results/series_designs.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from dart_flight.base.records import Mode
from dart_flight.config.vehicle import Coefficients
from dart_flight.contact.coefficients import Array, CoefficientArrays
from dart_flight.contact.contact_map import WallContact, contact_map
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.impact_fit import SD_OUT, SD_PEAK

FITTED: Final = ("k", "f", "mu")
_SLIDING: Final = 0.4  # velocity along the wall, relative to the normal velocity
_SPEED_SD_M_S: Final = 0.05  # standard deviation of the flown approach speed
_MARGIN_SDS: Final = 2.0
_SLIDING_SD: Final = 0.05  # measured tangential ratio
_STEP: Final = 1e-3


class Known(NamedTuple):
    """A coefficient with half the width of the 95 % interval of its logarithm."""

    value: float
    half: float


class ModeFit(NamedTuple):
    """The coefficients of the contact law in one mode, as known so far.

    Attributes:
        nu: bound of the vertical force, N; it does not influence the choice of hits.
    """

    k: Known
    f: Known
    mu: Known
    nu: float

    @property
    def coefficients(self) -> Coefficients:
        return Coefficients(self.k.value, self.f.value, self.mu.value, self.nu)

    @property
    def corners(self) -> CoefficientArrays:
        """The eight combinations of the intervals' ends, arrays (8,)."""
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1)
        k, f, mu = (
            known.value * np.exp(sign * known.half)
            for known, sign in zip((self.k, self.f, self.mu), signs, strict=True)
        )
        return CoefficientArrays(k, f, mu, np.full(8, self.nu))


class NextHitLimits(NamedTuple):
    """Limits of the next hits.

    Attributes:
        slowest_m_s, fastest_m_s: range of the normal speed.
        speed_m_s: limit of the whole velocity.
        peak_n: largest planned peak force, normal and friction together, by the upper end of the interval.
    """

    slowest_m_s: float
    fastest_m_s: float
    speed_m_s: float
    peak_n: float
    mass_kg: float
    onset: Onset


class NextHit(NamedTuple):
    """A hit to be flown, in the collision frame.

    Attributes:
        normal_m_s: velocity along the wall's normal, negative.
        peak_n: predicted peak force, normal and friction together.
        highest_n: the peak force by the upper end of the interval, at an approach that is faster than planned
            by two standard deviations.
    """

    mode: Mode
    normal_m_s: float
    tangential_m_s: float
    peak_n: float
    highest_n: float


def next_hits(fits: Mapping[Mode, ModeFit], limits: NextHitLimits, count: int) -> list[NextHit]:
    """Return up to `count` hits in all modes together, the smallest peak first.

    The speeds of a mode are equal steps between the slowest speed and the fastest safe speed. The list is
    empty if no speed of the range stays below the force limit.
    """
    hits = []
    for i, (mode, fit) in enumerate(fits.items()):
        number = count // len(fits) + (i < count % len(fits))
        top = fastest_m_s(fit, limits)
        if top is not None:
            speeds = np.linspace(limits.slowest_m_s, top, number).tolist()
            hits += [predict_hit(fit, limits, mode, -speed, _SLIDING * speed) for speed in speeds]
    return sorted(hits, key=lambda hit: hit.highest_n)


def predict_hit(
    fit: ModeFit, limits: NextHitLimits, mode: Mode, normal_m_s: float, tangential_m_s: float
) -> NextHit:
    """Return a hit with its predicted peak force, and the peak by the upper end of the interval."""
    at = CoefficientArrays.from_table(fit.coefficients)
    peak = float(_peak(contact_map(at, limits.mass_kg, normal_m_s, tangential_m_s, limits.onset)))
    return NextHit(
        mode, normal_m_s, tangential_m_s, peak, _highest_n(fit, limits, normal_m_s, tangential_m_s)
    )


def fastest_m_s(fit: ModeFit, limits: NextHitLimits, sliding: float = _SLIDING) -> float | None:
    """Return the largest normal speed whose peak stays below the force limit, or None if none does.

    `sliding` is the velocity along the wall relative to the normal velocity. The peak grows with the speed,
    so bisection finds the largest speed.
    """
    top = min(limits.fastest_m_s, limits.speed_m_s / math.hypot(1.0, sliding))

    def is_safe(speed: float) -> bool:
        return _highest_n(fit, limits, -speed, sliding * speed) <= limits.peak_n

    if top < limits.slowest_m_s or not is_safe(limits.slowest_m_s):
        return None
    low, high = limits.slowest_m_s, top
    if is_safe(high):
        return high
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_safe(middle) else (low, middle)
    return low


def _peak(contact: WallContact[Array]) -> Array:
    return np.hypot(contact.peak_normal_force_n, contact.peak_friction_force_n)


def _highest_n(fit: ModeFit, limits: NextHitLimits, normal_m_s: float, tangential_m_s: float) -> float:
    more = _MARGIN_SDS * _SPEED_SD_M_S
    along = tangential_m_s + math.copysign(more, tangential_m_s)
    contact = contact_map(fit.corners, limits.mass_kg, normal_m_s - more, along, limits.onset)
    return float(_peak(contact).max())


def information_of(fit: ModeFit, limits: NextHitLimits, normal_m_s: float, tangential_m_s: float) -> Array:
    """Return the information (3, 3) that a hit is expected to add on the logarithms of k, f and mu."""
    logs = np.log([fit.k.value, max(fit.f.value, 1e-3), max(fit.mu.value, 1e-3)])
    shifted = np.exp(logs[:, None] + _STEP * np.concatenate([np.eye(3), -np.eye(3)], axis=1))
    c = CoefficientArrays(shifted[0], shifted[1], shifted[2], np.full(6, fit.nu))
    contact = contact_map(c, limits.mass_kg, normal_m_s, tangential_m_s, limits.onset)
    measured = [
        contact.normal_out_m_s / -normal_m_s / SD_OUT,
        np.log(contact.peak_normal_force_n) / SD_PEAK,
        contact.tangential_out_m_s / max(abs(tangential_m_s), 0.1) / _SLIDING_SD,
    ]
    slopes = np.array([(row[:3] - row[3:]) / (2.0 * _STEP) for row in measured])
    information: Array = slopes.T @ slopes
    return information


def expected_halves(fit: ModeFit, limits: NextHitLimits, hits: Sequence[NextHit]) -> dict[str, float]:
    """Return the expected half widths of the 95 % intervals of ln k, ln f and ln mu after more hits."""
    total = np.diag((np.array([fit.k.half, fit.f.half, fit.mu.half]) / 1.96) ** -2.0)
    for hit in hits:
        total = total + information_of(fit, limits, hit.normal_m_s, hit.tangential_m_s)
    halves = 1.96 * np.sqrt(np.diag(np.linalg.inv(total)))
    return dict(zip(FITTED, halves.tolist(), strict=True))
