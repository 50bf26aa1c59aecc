"""A law's parameters from hits as a whole: speed out, peak force, duration, depth.

Where a law does not fit the samples of a contact, no curve of its shape through them has the right peak;
fitting what is to be predicted has. Many fits run at once (every fold of a comparison, every resample of an
interval), because each is small and the steps through a contact are the same for all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_flight.contact.coefficients import Array
from dart_flight.lab.identify.hits import Hit
from dart_flight.lab.identify.laws import ContactLaw, LawOutcome, collide

# How well a law of this kind can be expected to meet each: speed out as a share of the speed in, the others
# by their logarithm. Duration and depth have fuzzy ends; they decide where there is no peak.
SD_OUT, SD_PEAK, SD_CONTACT, SD_DEPTH = 0.04, 0.08, 0.3, 0.3
_HUBER = 1.5
_ITERATIONS = 10
_PRIOR_SD = 3.0  # of a parameter's logarithm about its start: keeps what the hits do not show where it was
_AT_BOUND = 1e-3


class HitTable(NamedTuple):
    """Hits as arrays (n,); what is not known is nan."""

    speed_in: Array
    speed_out: Array
    peak: Array
    contact: Array
    depth: Array
    acceleration: Array

    @classmethod
    def of(cls, hits: Sequence[Hit]) -> HitTable:
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

    @property
    def equations(self) -> int:
        """How many numbers there are to fit."""
        return int(sum(np.isfinite(v).sum() for v in (self.speed_out, self.peak, self.contact, self.depth)))

    @property
    def shows_size(self) -> bool:
        """Whether half of the hits or more tell a force, a duration or a depth: speeds tell no stiffness."""
        told = np.isfinite(self.peak) | np.isfinite(self.contact) | np.isfinite(self.depth)
        return bool(2 * told.sum() >= told.size)


class LawFit(NamedTuple):
    """Fits of one law, one per row of weights.

    Attributes:
        values: parameters (fits, parameters).
        cost: half the robust sum of squares (fits,).
        at_bound: which parameters ended at a bound of their search (fits, parameters).
        deviation: of the parameters' logarithms at the stated deviations (fits, parameters).
    """

    values: Array
    cost: Array
    at_bound: NDArray[np.bool_]
    deviation: Array


def start_values(law: ContactLaw, hits: HitTable, mass_kg: float) -> Array:
    """Parameters to begin with, (parameters,)."""
    speed = float(np.median(hits.speed_in))
    out = hits.speed_out / hits.speed_in
    e = float(np.nanmedian(out)) if np.isfinite(out).any() else 0.5
    if np.isfinite(hits.peak).any():
        ratio = float(np.nanmedian(hits.peak / hits.speed_in))
    elif np.isfinite(hits.contact).any():
        ratio = mass_kg * math.pi / float(np.nanmedian(hits.contact))
    elif np.isfinite(hits.depth).any():
        ratio = mass_kg * speed / float(np.nanmedian(hits.depth))
    else:
        ratio = mass_kg * 60.0
    found = np.array(law.start(ratio, e, mass_kg, speed))
    low = np.array([p.low for p in law.parameters]) * 1.01
    high = np.array([p.high for p in law.parameters]) / 1.01
    clipped: Array = np.clip(found, low, high)
    return clipped


def predict(law: ContactLaw, values: Array, hits: HitTable, mass_kg: float) -> LawOutcome:
    """The hits under parameters (fits, parameters); arrays (fits, n)."""
    fits, n = values.shape[0], hits.speed_in.size
    p = np.repeat(values, n, axis=0).T
    outcome = collide(law, p, mass_kg, np.tile(hits.speed_in, fits), np.tile(hits.acceleration, fits))
    return LawOutcome(*(v.reshape(fits, n) for v in outcome))


def _residuals(law: ContactLaw, logs: Array, hits: HitTable, mass_kg: float) -> Array:
    """Weighted by their deviations, (fits, 4 n); 0 where there is nothing to compare."""
    r = predict(law, np.exp(logs), hits, mass_kg)
    fuzzy = np.where(np.isfinite(hits.peak), 4.0, 1.0)
    parts = (
        (r.normal_out_m_s - hits.speed_out) / hits.speed_in / SD_OUT,
        np.log(np.maximum(r.peak_force_n, 1e-9) / hits.peak) / SD_PEAK,
        np.log(np.maximum(r.contact_s, 1e-9) / hits.contact) / (SD_CONTACT * fuzzy),
        np.log(np.maximum(r.compression_m, 1e-9) / hits.depth) / (SD_DEPTH * fuzzy),
    )
    weighted: Array = np.nan_to_num(np.concatenate(parts, axis=1), nan=0.0)
    return weighted


def fit_law(
    law: ContactLaw,
    hits: HitTable,
    mass_kg: float,
    weights: Array,
    start: Array,
    iterations: int = _ITERATIONS,
) -> LawFit:
    """Robust least squares (Huber, Levenberg and Marquardt) for several weightings of the hits at once.

    Args:
        law: which.
        hits: all of one mode.
        mass_kg: of the vehicle.
        weights: how often each hit counts, (fits, n).
        start: parameters (parameters,) or (fits, parameters).
        iterations: at most.
    """
    fits, size = weights.shape[0], len(law.parameters)
    low = np.log([p.low for p in law.parameters])
    high = np.log([p.high for p in law.parameters])
    origin = np.broadcast_to(np.log(start), (fits, size)).copy()
    logs = origin.copy()
    row = np.tile(weights, (1, 4))
    damping = np.full(fits, 1e-2)
    step = 1e-3

    def robust(r: Array) -> Array:
        size = np.abs(r)
        loss = np.where(size <= _HUBER, 0.5 * r * r, _HUBER * (size - 0.5 * _HUBER))
        result: Array = np.sum(row * loss, axis=1)
        return result

    def prior(x: Array) -> Array:
        result: Array = 0.5 * np.sum(((x - origin) / _PRIOR_SD) ** 2, axis=1)
        return result

    eye = np.eye(size)
    hessian = np.broadcast_to(eye, (fits, size, size))
    for _ in range(iterations):
        shifted = np.concatenate([logs, *(logs + step * eye[j] for j in range(size))])
        everything = _residuals(law, shifted, hits, mass_kg).reshape(size + 1, fits, -1)
        r, slopes = everything[0], (everything[1:] - everything[0]) / step
        cost = robust(r) + prior(logs)
        counted = row * np.minimum(1.0, _HUBER / np.maximum(np.abs(r), 1e-12))
        hessian = np.einsum("jfn,fn,kfn->fjk", slopes, counted, slopes) + eye / _PRIOR_SD**2
        gradient = np.einsum("jfn,fn,fn->fj", slopes, counted, r) + (logs - origin) / _PRIOR_SD**2
        scale = np.einsum("fjj->fj", hessian)
        moved = np.linalg.solve(
            hessian + damping[:, None, None] * scale[:, :, None] * eye, gradient[:, :, None]
        )[:, :, 0]
        tried = np.clip(logs - np.clip(moved, -1.0, 1.0), low, high)
        better = robust(_residuals(law, tried, hits, mass_kg)) + prior(tried)
        good = better < cost
        small = float(np.abs(np.where(good[:, None], tried - logs, 0.0)).max())
        logs = np.where(good[:, None], tried, logs)
        damping = np.where(good, damping * 0.2, np.minimum(damping * 8.0, 1e6))
        if small < 2e-3 and (good.any() or float(damping.min()) > 1e3):
            break
    cost = robust(_residuals(law, logs, hits, mass_kg))
    at_bound = (logs < low + _AT_BOUND) | (logs > high - _AT_BOUND)
    deviation = np.sqrt(np.einsum("fjj->fj", np.linalg.inv(hessian)))
    return LawFit(np.exp(logs), cost, at_bound, deviation)


def best_fit(law: ContactLaw, hits: HitTable, mass_kg: float) -> LawFit:
    """One fit to all hits, the best of several starts."""
    first = start_values(law, hits, mass_kg)
    starts = [first]
    for j in range(2, first.size):  # beyond stiffness and damping, which the start has from the hits
        for factor in (0.3, 3.0):
            other = first.copy()
            other[j] = np.clip(other[j] * factor, law.parameters[j].low * 1.01, law.parameters[j].high / 1.01)
            starts.append(other)
    found = fit_law(law, hits, mass_kg, np.ones((len(starts), hits.speed_in.size)), np.array(starts))
    at = int(np.argmin(found.cost))
    best = slice(at, at + 1)
    return LawFit(found.values[best], found.cost[best], found.at_bound[best], found.deviation[best])
