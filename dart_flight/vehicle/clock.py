"""The autopilot's clock seen from the host."""

from __future__ import annotations

import time
from collections import deque

_WINDOW = 8  # seconds, one best value each
_STEP_US = 200  # smaller changes of the estimate are not worth an input


def host_us() -> int:
    """The host's monotonic time in microseconds."""
    return time.monotonic_ns() // 1000


class ClockEstimate:
    """Autopilot time minus host time, from stamps and receipts.

    Every message is late by an unknown, positive delay, so the largest difference of the last seconds is the
    nearest to the truth; the window lets it follow a drifting clock.
    """

    def __init__(self) -> None:
        self.offset_us: int | None = None
        self._best: deque[int] = deque(maxlen=_WINDOW)
        self._second = 0
        self._reported: int | None = None

    def update(self, t_us: int, received_us: int) -> int | None:
        """Take one stamped message; returns the new estimate where it has changed noticeably."""
        difference = t_us - received_us
        second = received_us // 1_000_000
        if second != self._second or not self._best:
            self._second = second
            self._best.append(difference)
        elif difference > self._best[-1]:
            self._best[-1] = difference
        self.offset_us = max(self._best)
        if self._reported is None or abs(self.offset_us - self._reported) >= _STEP_US:
            self._reported = self.offset_us
            return self.offset_us
        return None

    def to_autopilot(self, host_time_us: int) -> int:
        """Host time as autopilot time; the host's own until the first stamp has come."""
        return host_time_us + (self.offset_us or 0)
