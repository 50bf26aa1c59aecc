"""Steady thrust of one motor over its command, and back: the curve of `thrust:` that has two numbers.

In a module of its own because it is compiled (docs/speed.md): the simulated vehicle asks for every motor,
every millisecond.
"""

from __future__ import annotations

from typing import Final

_LINEAR: Final = 1e-6  # a smaller share of the square term is none


class MotorCurve:
    """full_n * (square u^2 + (1 - square) u), u the command from 0 to 1.

    Args:
        full_n: thrust at full command.
        square: share of the square term.
    """

    def __init__(self, full_n: float, square: float) -> None:
        self._full_n, self._square, self._linear = full_n, square, 1.0 - square

    def force_n(self, command: float) -> float:
        """Steady thrust in newton; commands beyond the range count as its ends."""
        u = 0.0 if command < 0.0 else 1.0 if command > 1.0 else command
        return self._full_n * (self._square * u * u + self._linear * u)

    def command_for(self, force_n: float) -> float:
        """The command that gives a steady thrust; saturates."""
        share = max(0.0, min(1.0, force_n / self._full_n))
        a, b = self._square, self._linear
        if a < _LINEAR:
            return share
        return float((-b + (b * b + 4.0 * a * share) ** 0.5) / (2.0 * a))
