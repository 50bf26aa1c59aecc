"""How sure estimates are, also where the model is wrong.

Two deviations of every parameter: the statistical one (information of data and priors, widened for
correlation that is left in the residuals), which holds where the law is right; and the resampled one, which
asks how much the estimate would move with other trials (whole trials drawn anew, to first order), or with
other stretches of the same trials where there are few. The interval follows the wider, where it is wider by
more than chance.
"""

from __future__ import annotations

import math

import numpy as np

from dart_flight.contact.coefficients import Array
from dart_flight.lab.identify.sample_fit import SampleFit
from dart_flight.lab.statistics import Z95, student_t

_ENOUGH_TRIALS = 5  # of a call, from which whole trials are drawn
_STRETCH = 12  # samples of free flight drawn together; a contact is drawn in thirds
_BY_CHANCE = 1.3


def correlation(fit: SampleFit, theta: Array) -> float:
    """Factor on the variances for residuals that are not independent, from their lag-1 correlation."""
    products, squares, n = 0.0, 0.0, 0
    for i, window in enumerate(fit.windows):
        for name, predicted in fit.predict(theta, i).items():
            e = window.counts[name] * (predicted - window.series[name].value) / fit.sd[name]
            products += float(np.sum(e[1:] * e[:-1]))
            squares += float(np.sum(e * e))
            n += e.size
    rho = min(products / squares if squares > 0.0 else 0.0, 0.95)
    sure = rho - 2.0 / math.sqrt(n)  # what chance alone gives is no correlation
    return (1.0 + rho) / (1.0 - rho) if sure > 0.0 else 1.0


def covariance(fit: SampleFit, theta: Array) -> Array:
    """Covariance of all parameters at the fit's weights: inverse information of data and priors."""
    jacobian = fit.jacobian(theta)
    scale = np.sqrt(np.sum(jacobian**2, axis=0))
    scale[scale == 0.0] = 1.0
    inverse = np.linalg.pinv((jacobian / scale).T @ (jacobian / scale), rcond=1e-14, hermitian=True)
    result: Array = inverse / np.outer(scale, scale)
    return result


def _stretches(fit: SampleFit, theta: Array) -> list[tuple[Array, Array]]:
    """Rows of Jacobian and residuals that are drawn together."""
    jacobian, residuals = fit.jacobian(theta), fit.residuals(theta)
    whole = len(fit.trials) >= _ENOUGH_TRIALS
    found: list[tuple[Array, Array]] = []
    row = 0
    for window in fit.windows:
        first = row
        for name, series in window.series.items():
            n = series.time_s.size
            inside = np.flatnonzero(window.contact[name])
            outside = np.flatnonzero(~window.contact[name])
            parts = np.array_split(inside, min(3, max(inside.size, 1)))
            parts += np.array_split(outside, max(outside.size // _STRETCH, 1))
            if not whole:
                found += [(jacobian[row + p], residuals[row + p]) for p in parts if p.size]
            row += n
        if whole:
            found.append((jacobian[first:row], residuals[first:row]))
    return found


def half_widths(fit: SampleFit, theta: Array) -> Array:
    """Half widths of the 95 % intervals of all parameters of a fit."""
    data = sum(int(sum((c > 0.0).sum() for c in window.counts.values())) for window in fit.windows)
    squares = sum(float(np.sum(fit.block(theta, i) ** 2)) for i in range(len(fit.trials)))
    freedom = max(data - fit.parameters.size, 1)
    spread = max(squares / freedom, 1e-12) * correlation(fit, theta)
    inverse = covariance(fit, theta)
    statistical = Z95 * np.sqrt(np.diag(inverse) * spread)
    blocks = _stretches(fit, theta)
    n = len(blocks)
    # Drawing blocks with replacement moves the estimate by the sum of their scores times the inverse
    # information: this is the variance of that sum.
    scores = np.stack([j.T @ r for j, r in blocks])
    moved = (scores - scores.mean(axis=0)) @ inverse
    drawn = np.sqrt(np.sum(moved**2, axis=0) * n / max(n - 1, 1))
    half = student_t(max(n - 1, 1)) * drawn
    return np.where(half > _BY_CHANCE * statistical, half, statistical)
