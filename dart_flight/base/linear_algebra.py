"""Cholesky solution of symmetric, positive definite systems of a few unknowns, in scalar arithmetic.

The lower triangle of H is sufficient: row i has at least the first i + 1 numbers of H's row i. If H is
not positive definite, both functions raise ValueError.
"""

from __future__ import annotations

import math

Rows = list[list[float]]


def cholesky(h: Rows, damping: float = 0.0) -> Rows:
    """Return the lower triangle L of L L' = H + damping diag(H)."""
    n = len(h)
    low = [[0.0] * n for _ in range(n)]
    for i in range(n):
        row = low[i]
        for j in range(i + 1):
            other = low[j]
            s = h[i][j]
            if i == j:
                s += damping * s
            for p in range(j):
                s -= row[p] * other[p]
            if i == j:
                if not s > 0.0:
                    raise ValueError("the matrix is not positive definite")
                row[i] = math.sqrt(s)
            else:
                row[j] = s / other[j]
    return low


def solve(h: Rows, g: list[float], damping: float = 0.0) -> list[float]:
    """Return (H + damping diag(H))^-1 g."""
    low = cholesky(h, damping)
    n = len(g)
    y = [0.0] * n
    for i in range(n):
        y[i] = (g[i] - sum(low[i][p] * y[p] for p in range(i))) / low[i][i]
    for i in range(n - 1, -1, -1):
        y[i] = (y[i] - sum(low[p][i] * y[p] for p in range(i + 1, n))) / low[i][i]
    return y
