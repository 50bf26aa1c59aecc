"""The least-squares solver of all fits of the law, and the intervals of their unknowns.

The intervals hold even if the law is wrong. The statistical interval follows from the information in data and
priors, and holds if the law is right. The resampled interval follows from the first-order change of the
estimate when the data are resampled. If it is wider than chance explains, it replaces the statistical one.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dart_flight.base.summary import Z95, student_t
from dart_flight.config.packages import missing_package
from dart_flight.contact.coefficients import Array
from dart_flight.lab.identify.estimates import Estimate

LOWEST_K, HIGHEST_K, LOWEST_F, HIGHEST_F = 10.0, 1e6, 1e-3, 1e4  # search range: k in N/m, f in N s/m
_AT_BOUND = 1e-3  # maximum distance of a logarithm from a bound at which it counts as at the bound
_BY_CHANCE = 1.3


class LawFit(ABC):
    """A least-squares fit whose unknowns include the law's coefficients.

    Attributes:
        robust_from: weighted residual beyond which a residual counts less in a robust loss.
        losses: the losses to minimise, one after the other; the data are reweighted between two losses.
        bounds: limits of the unknowns.
        theta: the unknowns, after `solve`.
    """

    robust_from: float
    losses: Sequence[str]
    bounds: tuple[Array, Array]
    theta: Array

    @abstractmethod
    def residuals(self, theta: Array) -> Array:
        """Return the weighted residuals of the data, then of the priors."""

    @abstractmethod
    def reweight(self, theta: Array) -> None:
        """Replace the weights of the data by weights from their residuals."""

    @abstractmethod
    def resampling_groups(self) -> Sequence[NDArray[np.intp]]:
        """Return the groups of rows that are resampled together."""

    def jacobian(self, theta: Array) -> Array:
        """Return the derivatives of the residuals, one column for each unknown."""
        return np.stack([difference(theta, j, self.residuals) for j in range(theta.size)], axis=1)

    def variance(self) -> float:
        """Return the actual variance of the data, relative to the variance that the weights assume."""
        return 1.0

    def solve(self, start: Array) -> Array:
        try:
            from scipy.optimize import least_squares  # noqa: PLC0415
        except ImportError:
            raise missing_package("needs SciPy", "identify") from None
        self.theta = start
        for turn, loss in enumerate(self.losses):
            if turn:
                self.reweight(self.theta)
            found: Any = least_squares(
                self.residuals, np.clip(self.theta, *self.bounds), jac=self.jacobian, bounds=self.bounds,
                x_scale="jac", loss=loss, f_scale=self.robust_from, max_nfev=80,
            )  # fmt: skip
            self.theta = found.x
        return self.theta

    def half_widths(self) -> Array:
        """Return half the width of each unknown's 95 % interval."""
        jacobian, residuals = self.jacobian(self.theta), self.residuals(self.theta)
        inverse = covariance(jacobian)
        statistical = Z95 * np.sqrt(np.diag(inverse) * self.variance())
        # Resampling changes the estimate by the drawn groups' scores times the inverse information.
        scores = np.stack([jacobian[rows].T @ residuals[rows] for rows in self.resampling_groups()])
        n = len(scores)
        moved = (scores - scores.mean(axis=0)) @ inverse
        drawn = np.sqrt(np.sum(moved**2, axis=0) * n / max(n - 1, 1))
        half = student_t(max(n - 1, 1)) * drawn
        return np.where(half > _BY_CHANCE * statistical, half, statistical)


def difference(theta: Array, j: int, function: Callable[[Array], Array]) -> Array:
    """Return the derivative of `function` with respect to unknown `j`, by central differences."""
    h = 1e-6 * max(1.0, abs(float(theta[j])))
    up, down = theta.copy(), theta.copy()
    up[j] += h
    down[j] -= h
    slope: Array = (function(up) - function(down)) / (2.0 * h)
    return slope


def covariance(jacobian: Array) -> Array:
    """Return the covariance of all unknowns: the inverse of J^T J."""
    scale = np.sqrt(np.sum(jacobian**2, axis=0))
    scale[scale == 0.0] = 1.0
    inverse = np.linalg.pinv((jacobian / scale).T @ (jacobian / scale), rcond=1e-14, hermitian=True)
    result: Array = inverse / np.outer(scale, scale)
    return result


def stiffness_and_damping(
    logs: Array, halves: Array, widest: float
) -> tuple[dict[str, Estimate | None], list[str]]:
    """Return k and f from their logarithms and half widths, and a note for each unknown coefficient.

    A coefficient counts as unknown if the half width of its logarithm reaches `widest`.
    """
    found: dict[str, Estimate | None] = {"k": None, "f": None}
    notes = []
    bounds = ((LOWEST_K, HIGHEST_K), (LOWEST_F, HIGHEST_F))
    for name, (lowest, highest), log, half in zip(found, bounds, logs.tolist(), halves.tolist(), strict=True):
        if not math.log(lowest) + _AT_BOUND <= log <= math.log(highest) - _AT_BOUND:
            notes.append(f"{name} is unknown: the fit ended at the bound {math.exp(log):.3g} of its range")
        elif half >= widest:
            notes.append(f"these trials do not determine {name}")
        else:
            found[name] = Estimate(*(math.exp(v) for v in (log, log - half, log + half)))
    return found, notes
