"""The polynomial of fifth order between two states, for many pairs at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
