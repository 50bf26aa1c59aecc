"""The thrust curve of one motor, which converts between command and thrust. Two numbers define the curve.

This module is separate because it is compiled (docs/speed.md): the simulated vehicle evaluates the curve for
every motor, every millisecond.
"""

from __future__ import annotations

from typing import Final

_LINEAR: Final = 1e-6  # a curve with a smaller fraction of the square term counts as linear


class MotorCurve:
    """The curve `full_n` * (`square` * u^2 + (1 - `square`) * u), newton; the command u is from 0 to 1."""

    def __init__(self, full_n: float, square: float) -> None:
        self._full_n, self._square, self._linear = full_n, square, 1.0 - square

    def force_n(self, command: float) -> float:
        """Return the steady thrust in newton; commands outside the range are clipped."""
        u = 0.0 if command < 0.0 else 1.0 if command > 1.0 else command
        return self._full_n * (self._square * u * u + self._linear * u)

    def command_for(self, force_n: float) -> float:
        """Return the command for a steady thrust; commands outside 0 to 1 are clipped."""
        share = max(0.0, min(1.0, force_n / self._full_n))
        a, b = self._square, self._linear
        if a < _LINEAR:
            return share
        return float((-b + (b * b + 4.0 * a * share) ** 0.5) / (2.0 * a))
