"""The autopilot's clock seen from the host."""

from __future__ import annotations

import time
from collections import deque
from typing import Protocol

_WINDOW = 8  # seconds, one best value each
_LOCKSTEP_STEP_US = 2000
_LEAP_US = 1_000_000
_LEAPS_BELIEVED = 50
_STEP_US = 200  # smaller changes of the estimate are not worth an input


def host_us() -> int:
    """The host's monotonic time in microseconds."""
    return time.monotonic_ns() // 1000


class Clock(Protocol):
    """Relates autopilot time and host time.

    Attributes:
        runs_in_real_time: the autopilot's time goes as the host's does.
    """

    runs_in_real_time: bool

    @property
    def offset_us(self) -> int | None:
        """Autopilot time minus host time; None before the first stamp."""

    def update(self, t_us: int, received_us: int) -> int | None:
        """Take one stamped message; returns the new offset where it has changed noticeably."""

    def to_autopilot(self, host_time_us: int) -> int:
        """Host time as autopilot time."""


class ClockEstimate:
    """Autopilot time minus host time, from stamps and receipts.

    Every message is late by an unknown, positive delay, so the largest difference of the last seconds is the
    nearest to the truth; the window lets it follow a drifting clock.
    """

    runs_in_real_time = True

    def __init__(self) -> None:
        self._offset_us: int | None = None
        self._best: deque[int] = deque(maxlen=_WINDOW)
        self._second = 0
        self._reported: int | None = None
        self._leaps = 0

    @property
    def offset_us(self) -> int | None:
        """Autopilot time minus host time; None before the first stamp."""
        return self._offset_us

    def update(self, t_us: int, received_us: int) -> int | None:
        """Take one stamped message; returns the new estimate where it has changed noticeably."""
        difference = t_us - received_us
        if self._offset_us is not None and difference - self._offset_us > _LEAP_US:
            # Another vehicle's, on the same link, as long as ours comes in between.
            self._leaps += 1
            if self._leaps < _LEAPS_BELIEVED:
                return None
        self._leaps = 0
        second = received_us // 1_000_000
        if second != self._second or not self._best:
            self._second = second
            self._best.append(difference)
        elif difference > self._best[-1]:
            self._best[-1] = difference
        else:  # as of nearly every message
            return None
        offset = self._offset_us = max(self._best)
        if self._reported is None or abs(offset - self._reported) >= _STEP_US:
            self._reported = offset
            return offset
        return None

    def to_autopilot(self, host_time_us: int) -> int:
        """Host time as autopilot time; the host's own until the first stamp has come."""
        return host_time_us + (self._offset_us or 0)


class LockstepClock:
    """The clock of an autopilot in lockstep with a simulator.

    Its time goes at any pace and stands still when the simulator does, so the newest stamp is the best
    estimate, carried on at the wanted pace for a few milliseconds only.

    Args:
        speed: simulated seconds per second that the simulator aims at.
    """

    _REACH_US = 50_000
    runs_in_real_time = False

    def __init__(self, speed: float = 1.0) -> None:
        self._speed = speed
        self._newest: tuple[int, int] | None = None
        self._reported: int | None = None

    @property
    def offset_us(self) -> int | None:
        """Autopilot time minus host time at the newest stamp; None before the first."""
        return self._newest[0] - self._newest[1] if self._newest is not None else None

    def update(self, t_us: int, received_us: int) -> int | None:
        """Take one stamped message; returns the new offset where it has changed noticeably."""
        if self._newest is not None and t_us <= self._newest[0]:
            return None
        self._newest = (t_us, received_us)
        offset = t_us - received_us
        if self._reported is None or abs(offset - self._reported) >= _LOCKSTEP_STEP_US:
            self._reported = offset
            return offset
        return None

    def to_autopilot(self, host_time_us: int) -> int:
        """Host time as autopilot time; the host's own until the first stamp has come."""
        if self._newest is None:
            return host_time_us
        t_us, received_us = self._newest
        ahead = round(self._speed * max(0, host_time_us - received_us))
        return t_us + min(ahead, self._REACH_US)
