"""The planner's polynomials, many together: between two states, and with their derivatives.

Coefficients have the constant term first. `core/mission/trajectories.py` evaluates one trajectory in floats.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dart_flight.contact.coefficients import Array


def quintic(begin: Array | Sequence[Array | float], end: Sequence[Array | float], duration_s: Array) -> Array:
    """Return coefficients (6, n) of the polynomials between pairs of (position, velocity, acceleration).

    States are numbers or arrays (n,), durations an array (n,).
    """
    p, v, a = begin
    q, w, b = end
    t = duration_s
    d, last = q - p, b * t**2
    c3 = (20.0 * d - (8.0 * w + 12.0 * v) * t - 3.0 * a * t**2 + last) / (2.0 * t**3)
    c4 = (-30.0 * d + (14.0 * w + 16.0 * v) * t + 3.0 * a * t**2 - 2.0 * last) / (2.0 * t**4)
    c5 = (12.0 * d - 6.0 * (w + v) * t - a * t**2 + last) / (2.0 * t**5)
    one = np.ones_like(t)
    return np.stack([p * one, v * one, 0.5 * a * one, c3, c4, c5])


def derivative(coefficients: Array, t: Array, order: int) -> Array:
    """Return a derivative of polynomials with coefficients (6, ...) at times that broadcast with (...)."""
    for _ in range(order):
        powers = np.arange(1, len(coefficients)).reshape(-1, *(1,) * (coefficients.ndim - 1))
        coefficients = coefficients[1:] * powers
    value = np.zeros(np.broadcast_shapes(coefficients.shape[1:], t.shape))
    for row in coefficients[::-1]:
        value *= t
        value += row
    return value


def with_derivatives(coefficients: Array, t: Array, order: int) -> list[Array]:
    """Return values (..., n) at t (n,) and their derivatives up to `order`, in one pass of Horner's scheme.

    The coefficients are (m, ..., n). The results differ from `derivative` by rounding.
    """
    found = [coefficients[-1].copy(), *(np.zeros_like(coefficients[-1]) for _ in range(order))]
    for row in coefficients[-2::-1]:
        for k in range(order, 0, -1):
            found[k] *= t
            found[k] += found[k - 1]
        found[0] *= t
        found[0] += row
    return [values if k < 2 else math.factorial(k) * values for k, values in enumerate(found)]
