"""Stamps that leap ahead: they are from another vehicle, or the clock has jumped."""

from __future__ import annotations

from typing import Final

LEAP_US: Final = 1_000_000
FASTEST: Final = 20  # speed of the fastest simulation, simulated seconds per second


def leaps(ahead_us: int, elapsed_us: int = 0) -> bool:
    """Return whether a stamp is too far ahead of an earlier one for the host time `elapsed_us` between them.

    The sample may then come from another vehicle.
    """
    return ahead_us > LEAP_US and ahead_us > LEAP_US + FASTEST * elapsed_us


class LeapFilter:
    """Rejects stamps that leap, until so many in a row leap that the clock itself must have jumped."""

    def __init__(self, accepted_after: int) -> None:
        self._accepted_after = accepted_after
        self._count = 0

    def rejects(self, ahead_us: int, elapsed_us: int = 0) -> bool:
        if leaps(ahead_us, elapsed_us):
            self._count += 1
            if self._count < self._accepted_after:
                return True
        self._count = 0
        return False
