"""Fit of k and f to the measurements of whole hits: outgoing speed, peak force, duration and depth.

If the paper's law does not describe a contact, a fit of the law to the samples gives a wrong peak. This fit
therefore ignores the samples and uses the quantities that the law must predict.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_flight.contact.coefficients import Array, CoefficientArrays
from dart_flight.contact.contact_map import WallHit, contact_map
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.estimates import Errors, Estimate
from dart_flight.lab.identify.measured_impacts import MeasuredImpact
from dart_flight.lab.identify.solver import (
    HIGHEST_F,
    HIGHEST_K,
    LOWEST_F,
    LOWEST_K,
    descend,
    difference,
    half_widths,
    stiffness_and_damping,
)

# Expected errors of the law: outgoing over incoming speed, and logarithms of the others. Duration and depth
# are imprecise and count mainly without a peak.
SD_OUT, SD_PEAK, SD_CONTACT, SD_DEPTH = 0.04, 0.08, 0.3, 0.3
_PRIOR_SD = 3.0  # of a coefficient's logarithm about its start, which holds undetermined coefficients
_LOW, _HIGH = np.log([LOWEST_K, LOWEST_F]), np.log([HIGHEST_K, HIGHEST_F])
_LONGEST = 3.0  # half periods: assumed contact duration of a hit that never leaves the wall
_WIDEST_LOG = math.log(3.0)  # a coefficient with a wider interval than a factor of three is unknown
_ENOUGH_HITS = 3  # fewer hits have no meaningful spread


class HitTable(NamedTuple):
    """Hits of one mode as arrays (n,) in SI units; unknown values are NaN."""

    speed_in: Array
    speed_out: Array
    peak: Array
    contact: Array
    depth: Array
    acceleration: Array

    @classmethod
    def from_hits(cls, hits: Sequence[MeasuredImpact]) -> HitTable:
        rows = [
            (
                h.normal_in_m_s, h.normal_out_m_s, h.peak_force_n, h.contact_s, h.compression_m,
                h.acceleration_m_s2,
            )
            for h in hits
        ]  # fmt: skip
        return cls(*np.array(rows, dtype=float).reshape(-1, 6).T)

    def only(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> HitTable:
        return HitTable(*(column[which] for column in self))

    @property
    def is_enough(self) -> bool:
        """Whether the hits have enough measured quantities for a fit.

        At least two quantities must be known, and half of the hits must have a force, a duration or a depth.
        Speeds alone do not determine the stiffness.
        """
        known = np.isfinite([self.peak, self.contact, self.depth, self.speed_out])
        informative = known[:3].any(axis=0)
        return bool(2 * informative.sum() >= informative.size and known.sum() >= 2)

    def errors(self, peak: Array, speed_out: Array) -> Errors:
        return Errors(
            median(np.abs(peak / self.peak - 1.0)),
            median(np.abs(speed_out - self.speed_out) / self.speed_in),
        )


def median(values: Array) -> float | None:
    """Return the median of the finite values; None if no value is finite."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else None


def predict(k: float, f: float, hits: HitTable, mass_kg: float, onset: Onset) -> WallHit[Array]:
    zero = np.zeros_like(hits.speed_in)
    push = hits.acceleration if hits.acceleration.any() else None
    coefficients = CoefficientArrays(zero + k, zero + f, zero, zero)
    return contact_map(coefficients, mass_kg, -hits.speed_in, zero, onset, acceleration_m_s2=push)


class HitFit:
    """The `LawProblem` of hits of one mode; its unknowns are the logarithms of k and f."""

    robust_from = 1.5

    def __init__(self, hits: HitTable, mass_kg: float, onset: Onset) -> None:
        self.hits, self.mass_kg, self.onset = hits, mass_kg, onset
        self._start = _start(hits, mass_kg)
        self._imprecision = np.where(np.isfinite(hits.peak), 4.0, 1.0)
        known = np.concatenate((hits.speed_out, hits.peak, hits.contact, hits.depth))
        self._known = np.isfinite(known).reshape(4, -1)
        self._counts, self._moved = np.ones(known.size), np.zeros(known.size)

    def solve(self) -> Array:
        return descend(self, self._start, ("huber", "linear"))

    def bounds(self) -> tuple[Array, Array]:
        return _LOW, _HIGH

    def _errors(self, theta: Array) -> Array:
        """Return predicted minus measured quantities of all hits, divided by the law's expected errors."""
        (k, f), hits = np.exp(theta), self.hits
        predicted = predict(k, f, hits, self.mass_kg, self.onset)
        contact = np.minimum(predicted.contact_time_s, _LONGEST * math.pi * math.sqrt(self.mass_kg / k))
        parts = (
            (predicted.normal_out_m_s - hits.speed_out) / hits.speed_in / SD_OUT,
            np.log(predicted.peak_normal_force_n / hits.peak) / SD_PEAK,
            np.log(contact / hits.contact) / (SD_CONTACT * self._imprecision),
            np.log(predicted.penetration_m / hits.depth) / (SD_DEPTH * self._imprecision),
        )
        return np.nan_to_num(np.concatenate(parts))

    def residuals(self, theta: Array) -> Array:
        errors = self._counts * (self._errors(theta) - self._moved)
        return np.concatenate((errors, (theta - self._start) / _PRIOR_SD))

    def jacobian(self, theta: Array) -> Array:
        return np.stack([difference(theta, j, self.residuals) for j in range(theta.size)], axis=1)

    def reweight(self, theta: Array) -> None:
        """Replace the errors by Huber's pseudo-values.

        A least-squares fit to the pseudo-values gives the same solution and covariance as Huber's robust fit.
        """
        errors = self._errors(theta).reshape(4, -1)
        inside = (np.abs(errors) <= self.robust_from) & self._known
        share = (inside.sum(axis=1) + 1.0) / (self._known.sum(axis=1) + 1.0)  # never 0
        pseudo = np.clip(errors, -self.robust_from, self.robust_from) / share[:, None]
        self._counts = np.sqrt(np.repeat(share, errors.shape[1]))
        self._moved = (errors - pseudo).ravel()

    def variance(self, theta: Array) -> float:
        """Return 1: the assumed deviations are not scaled. More hits do not reduce the law's errors."""
        return 1.0

    def resampling_groups(self) -> list[NDArray[np.intp]]:
        """Return the rows of each hit; with too few hits, all rows as one group."""
        rows = np.arange(self._counts.size).reshape(4, -1)
        return list(rows.T) if rows.shape[1] >= _ENOUGH_HITS else [rows.ravel()]


def fit_hits(
    hits: Sequence[MeasuredImpact], mass_kg: float, onset: Onset
) -> tuple[dict[str, Estimate | None], list[str]]:
    """Fit k and f (None if unknown) to hits of one mode; return notes, too."""
    table = HitTable.from_hits(hits)
    if not table.is_enough:
        return {"k": None, "f": None}, []
    problem = HitFit(table, mass_kg, onset)
    logs = problem.solve()
    return stiffness_and_damping(logs, half_widths(problem, logs), _WIDEST_LOG)


def _start(hits: HitTable, mass_kg: float) -> Array:
    """Return first guesses of the logarithms of k and f.

    They follow from the median restitution and the median ratio of peak force to incoming speed. Without
    forces, the duration or the depth replaces the peak force.
    """
    out = hits.speed_out / hits.speed_in
    e = min(max(float(np.nanmedian(out)), 0.02), 0.98) if np.isfinite(out).any() else 0.5
    if np.isfinite(hits.peak).any():
        ratio = float(np.nanmedian(hits.peak / hits.speed_in))
    elif np.isfinite(hits.contact).any():
        ratio = mass_kg * math.pi / float(np.nanmedian(hits.contact))
    else:
        ratio = mass_kg * float(np.median(hits.speed_in) / np.nanmedian(hits.depth))
    zeta = -math.log(e) / math.hypot(math.pi, math.log(e)) * 0.9
    omega = ratio / mass_kg * math.exp(0.7 * zeta)
    found = np.log([mass_kg * omega * omega, 2.0 * zeta * mass_kg * omega])
    clipped: Array = np.clip(found, _LOW + 0.01, _HIGH - 0.01)
    return clipped
