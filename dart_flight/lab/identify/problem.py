"""The input of an identification: measured hits, and the vehicle and onset rule of the law to fit.

Every fit, held-out check and quality measure takes a `LawProblem`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dart_flight.contact.coefficients import Array, CoefficientArrays
from dart_flight.contact.contact_map import WallContact, contact_map
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.estimates import Errors, Estimate
from dart_flight.lab.identify.measured_impacts import MeasuredImpact


class LawProblem:
    """Hits, and the mass and the onset rule of the law that is fitted to them.

    Attributes:
        speed_in, speed_out, peak, contact, depth, acceleration: quantities of the hits as arrays (n,) in SI
            units; unknown values are NaN.
    """

    def __init__(self, hits: Sequence[MeasuredImpact], mass_kg: float, onset: Onset) -> None:
        self.hits, self.mass_kg, self.onset = list(hits), mass_kg, onset
        self.speed_in, self.speed_out = self.column("normal_in_m_s"), self.column("normal_out_m_s")
        self.peak, self.contact = self.column("peak_force_n"), self.column("contact_s")
        self.depth = self.column("compression_m")
        self.acceleration = np.array([hit.trial.acceleration_m_s2 for hit in hits])

    def column(self, name: str) -> Array:
        """Return an attribute of all hits as an array; unknown values are NaN."""
        return np.array([getattr(hit, name) for hit in self.hits], dtype=float)

    def of(self, hits: Sequence[MeasuredImpact]) -> LawProblem:
        """Return the problem for other hits of the same vehicle."""
        return LawProblem(hits, self.mass_kg, self.onset)

    def only(self, which: NDArray[np.bool_]) -> LawProblem:
        return self.of([hit for hit, chosen in zip(self.hits, which, strict=True) if chosen])

    def by_mode(self) -> dict[str, LawProblem]:
        modes = dict.fromkeys(hit.trial.mode for hit in self.hits)
        return {mode: self.of([hit for hit in self.hits if hit.trial.mode == mode]) for mode in modes}

    @property
    def is_enough(self) -> bool:
        """Whether the hits have enough measured quantities for a fit of k and f.

        At least two values must be known, and at least half of the hits must have a force, duration or depth.
        Speeds alone do not determine the stiffness.
        """
        known = np.isfinite([self.peak, self.contact, self.depth, self.speed_out])
        informative = known[:3].any(axis=0)
        return bool(2 * informative.sum() >= informative.size and known.sum() >= 2)

    def predict(self, k: float, f: float) -> WallContact[Array]:
        """Return the outcome of the hits according to the law, without friction and vertical force."""
        zero = np.zeros_like(self.speed_in)
        push = self.acceleration if self.acceleration.any() else None
        coefficients = CoefficientArrays(zero + k, zero + f, zero, zero)
        return contact_map(
            coefficients, self.mass_kg, -self.speed_in, zero, self.onset, acceleration_m_s2=push
        )

    def errors(self, peak: Array, speed_out: Array) -> Errors:
        """Return the errors of predicted peaks and outgoing speeds."""
        return Errors(
            median(np.abs(peak / self.peak - 1.0)),
            median(np.abs(speed_out - self.speed_out) / self.speed_in),
        )

    def errors_of(self, coefficients: Mapping[str, Estimate | None]) -> Errors:
        """Return the prediction errors of coefficients; None if k or f is unknown."""
        k, f = coefficients["k"], coefficients["f"]
        if k is None or f is None:
            return Errors(None, None)
        predicted = self.predict(k.value, f.value)
        return self.errors(predicted.peak_normal_force_n, predicted.normal_out_m_s)


def median(values: Array) -> float | None:
    """Return the median of the finite values; None if no value is finite."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else None
