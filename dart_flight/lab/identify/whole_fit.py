"""k and f from hits as a whole: speed out, peak force, duration, depth.

Where the paper's law does not fit the samples of a contact, no curve of its shape through them has the right
peak; fitting what is to be predicted has.
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
from dart_flight.lab.identify.measured_impacts import MeasuredImpact
from dart_flight.lab.identify.solver import least_squares

# How well the law can be expected to meet each: speed out as a share of the speed in, the others by their
# logarithm. Duration and depth have fuzzy ends; they decide where there is no peak.
SD_OUT, SD_PEAK, SD_CONTACT, SD_DEPTH = 0.04, 0.08, 0.3, 0.3
_HUBER = 1.5
_PRIOR_SD = 3.0  # of a coefficient's logarithm about its start: keeps what the hits do not show where it was
_LOW, _HIGH = np.log([10.0, 1e-3]), np.log([1e6, 1e4])  # of k in N/m and f in N s/m: what is searched
_AT_BOUND = 1e-3
_LONGEST = 3.0  # half periods: how long a hit that never leaves the wall counts as in contact


class HitTable(NamedTuple):
    """Hits as arrays (n,); what is not known is nan."""

    speed_in: Array
    speed_out: Array
    peak: Array
    contact: Array
    depth: Array
    acceleration: Array

    @classmethod
    def of(cls, hits: Sequence[MeasuredImpact]) -> HitTable:
        """From hits of one mode."""

        def column(values: list[float | None]) -> Array:
            return np.array([math.nan if v is None else v for v in values], dtype=float)

        return cls(
            column([h.normal_in_m_s for h in hits]),
            column([h.normal_out_m_s for h in hits]),
            column([h.peak_force_n for h in hits]),
            column([h.contact_s for h in hits]),
            column([h.compression_m for h in hits]),
            column([h.acceleration_m_s2 for h in hits]),
        )

    def only(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> HitTable:
        """Some of the hits, or some of them several times."""
        return HitTable(*(column[which] for column in self))

    @property
    def is_enough(self) -> bool:
        """Whether there are two numbers to fit, and half of the hits or more tell a force, a duration or a
        depth: speeds tell no stiffness."""
        known = np.isfinite([self.peak, self.contact, self.depth, self.speed_out])
        told = known[:3].any(axis=0)
        return bool(2 * told.sum() >= told.size and known.sum() >= 2)


class WholeFit(NamedTuple):
    """Logarithms of k and f, each (2,).

    Attributes:
        logs: best values.
        deviation: standard deviations, if the law meets each number as well as expected.
        at_bound: which ended at a bound of the search.
    """

    logs: Array
    deviation: Array
    at_bound: NDArray[np.bool_]


def predict(k: float, f: float, hits: HitTable, mass_kg: float, onset: Onset) -> WallHit[Array]:
    """What the law makes of the speeds in."""
    zero = np.zeros_like(hits.speed_in)
    push = hits.acceleration if hits.acceleration.any() else None
    coefficients = CoefficientArrays(zero + k, zero + f, zero, zero)
    return contact_map(coefficients, mass_kg, -hits.speed_in, zero, onset, acceleration_m_s2=push)


def fit(hits: HitTable, mass_kg: float, onset: Onset, start: Array | None = None) -> WholeFit:
    """Robust least squares (Huber).

    Args:
        hits: of one mode.
        mass_kg: of the vehicle.
        onset: rule of the law.
        start: logarithms to begin with, (2,); from the hits by default.

    Raises:
        InputError: SciPy is missing.
    """
    origin = _start(hits, mass_kg) if start is None else start
    fuzzy = np.where(np.isfinite(hits.peak), 4.0, 1.0)

    def residuals(logs: Array) -> Array:
        k, f = np.exp(logs)
        said = predict(k, f, hits, mass_kg, onset)
        contact = np.minimum(said.contact_time_s, _LONGEST * math.pi * math.sqrt(mass_kg / k))
        parts = (
            (said.normal_out_m_s - hits.speed_out) / hits.speed_in / SD_OUT,
            np.log(said.peak_normal_force_n / hits.peak) / SD_PEAK,
            np.log(contact / hits.contact) / (SD_CONTACT * fuzzy),
            np.log(said.penetration_m / hits.depth) / (SD_DEPTH * fuzzy),
            (logs - origin) / _PRIOR_SD,
        )
        weighted: Array = np.nan_to_num(np.concatenate(parts))
        return weighted

    found = least_squares(residuals, origin, bounds=(_LOW, _HIGH), loss="huber", f_scale=_HUBER)
    at_bound = (found.x < _LOW + _AT_BOUND) | (found.x > _HIGH - _AT_BOUND)
    return WholeFit(found.x, np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac))), at_bound)


def _start(hits: HitTable, mass_kg: float) -> Array:
    """Logarithms of k and f of about the hits' peak force per speed and restitution."""
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
