"""Detection of stamps that leap ahead. Another vehicle may have sent them, or the clock may have jumped."""

from __future__ import annotations

from typing import Final

LEAP_US: Final = 1_000_000
FASTEST: Final = 20  # the fastest simulation runs this many times faster than real time


def leaps(ahead_us: int, elapsed_us: int = 0) -> bool:
    """Return whether a stamp leads an earlier one by more than the elapsed host time can explain.

    The sample may then come from another vehicle.
    """
    return ahead_us > LEAP_US and ahead_us > LEAP_US + FASTEST * elapsed_us


class LeapFilter:
    """Filter that rejects leaping stamps until several in a row show that the clock has jumped."""

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
