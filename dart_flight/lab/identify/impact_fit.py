"""Fit of k and f to the measurements of whole hits: outgoing speed, peak force, duration and depth.

If the paper's law does not describe a contact, a fit of the law to the samples gives a wrong peak. This fit
therefore ignores the samples and uses the quantities that the law must predict.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dart_flight.contact.coefficients import Array
from dart_flight.lab.identify.estimates import Estimate
from dart_flight.lab.identify.problem import LawProblem
from dart_flight.lab.identify.solver import (
    HIGHEST_F,
    HIGHEST_K,
    LOWEST_F,
    LOWEST_K,
    LawFit,
    stiffness_and_damping,
)

# Expected errors of the ratio of outgoing to incoming speed, and of the logarithms of peak, duration and
# depth. Duration and depth are imprecise, so they matter mainly if the peak is unknown.
SD_OUT, SD_PEAK, SD_CONTACT, SD_DEPTH = 0.04, 0.08, 0.3, 0.3
_PRIOR_SD = 3.0  # prior standard deviation of log k and log f; keeps both near the first guess
_LOW, _HIGH = np.log([LOWEST_K, LOWEST_F]), np.log([HIGHEST_K, HIGHEST_F])
_LONGEST = 3.0  # assumed contact duration of a hit that never leaves the wall, in half periods
_WIDEST_LOG = math.log(3.0)  # a coefficient is unknown if its interval is wider than a factor of 3
_ENOUGH_HITS = 3  # minimum number of hits from which their spread is estimated


class ImpactFit(LawFit):
    """The fit of the logarithms of k and f to hits of one mode."""

    robust_from = 1.5
    losses: Sequence[str] = ("huber", "linear")
    bounds = _LOW, _HIGH

    def __init__(self, problem: LawProblem) -> None:
        self.problem = problem
        self._imprecision = np.where(np.isfinite(problem.peak), 4.0, 1.0)
        known = np.concatenate((problem.speed_out, problem.peak, problem.contact, problem.depth))
        self._known = np.isfinite(known).reshape(4, -1)
        self._counts, self._moved = np.ones(known.size), np.zeros(known.size)
        self.start = self._start()

    def _start(self) -> Array:
        """Return first guesses of the logarithms of k and f.

        They follow from the median restitution and the median ratio of peak force to incoming speed. Without
        forces, the duration or the depth replaces the peak force.
        """
        hits, mass_kg = self.problem, self.problem.mass_kg
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

    def _errors(self, theta: Array) -> Array:
        """Return predicted minus measured quantities of all hits, divided by the law's expected errors."""
        (k, f), hits = np.exp(theta), self.problem
        predicted = hits.predict(k, f)
        contact = np.minimum(predicted.contact_time_s, _LONGEST * math.pi * math.sqrt(hits.mass_kg / k))
        parts = (
            (predicted.normal_out_m_s - hits.speed_out) / hits.speed_in / SD_OUT,
            np.log(predicted.peak_normal_force_n / hits.peak) / SD_PEAK,
            np.log(contact / hits.contact) / (SD_CONTACT * self._imprecision),
            np.log(predicted.penetration_m / hits.depth) / (SD_DEPTH * self._imprecision),
        )
        errors: Array = np.nan_to_num(np.concatenate(parts))
        return errors

    def residuals(self, theta: Array) -> Array:
        errors = self._counts * (self._errors(theta) - self._moved)
        return np.concatenate((errors, (theta - self.start) / _PRIOR_SD))

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

    def resampling_groups(self) -> list[NDArray[np.intp]]:
        """Return the rows of each hit as a group, or all rows as one group if there are too few hits."""
        rows = np.arange(self._counts.size).reshape(4, -1)
        return list(rows.T) if rows.shape[1] >= _ENOUGH_HITS else [rows.ravel()]


def fit_impacts(problem: LawProblem) -> tuple[dict[str, Estimate | None], list[str]]:
    """Fit k and f (None if unknown) to hits of one mode; return notes, too."""
    if not problem.is_enough:
        return {"k": None, "f": None}, []
    fit = ImpactFit(problem)
    return stiffness_and_damping(fit.solve(fit.start), fit.half_widths(), _WIDEST_LOG)
