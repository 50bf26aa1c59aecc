"""Contact coefficients of many collisions, stored as arrays for the vectorised contact model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_flight.config.vehicle import Coefficients

Array = NDArray[np.float64]
Rows = NDArray[np.intp]


class CoefficientArrays(NamedTuple):
    """Contact coefficients as arrays of one shape: k N/m, f N s/m, mu s/m, nu N."""

    k: Array
    f: Array
    mu: Array
    nu: Array

    @classmethod
    def from_table(cls, table: Coefficients | Sequence[Coefficients]) -> CoefficientArrays:
        """Return zero-dimensional arrays for one set, or arrays of shape (n,) for n sets."""
        if isinstance(table, Coefficients):
            return cls(*(np.asarray(v, dtype=float) for v in (table.k, table.f, table.mu, table.nu)))
        return cls(*(np.array([getattr(row, name) for row in table], dtype=float) for name in cls._fields))

    @property
    def lead_s(self) -> Array:
        return self.f / self.k

    def select(self, rows: Rows) -> CoefficientArrays:
        return CoefficientArrays(*(values[rows] for values in self))
