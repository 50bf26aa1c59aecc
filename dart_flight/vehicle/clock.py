"""The relation of the autopilot's clock to the host's clock.

In real flight these are two clocks. In lockstep with the application there is a single clock.
"""

from __future__ import annotations

import time
from collections import deque
from typing import Protocol

from dart_flight.base.records import RoundTrip
from dart_flight.base.stamps import LeapFilter

_WINDOW = 8  # seconds; the estimate keeps the largest difference of each second
_LOCKSTEP_STEP_US = 2000
_LEAPS_ACCEPTED = 50  # this many consecutive leaping stamps, counted over all streams, confirm a leap
_STEP_US = 200  # smaller changes of the estimate are not reported


def host_us() -> int:
    """Return the host's monotonic time."""
    return time.monotonic_ns() // 1000


class Clock(Protocol):
    """The relation of autopilot time to host time."""

    def host_us(self) -> int:
        """Return the host's monotonic time, or in lockstep the simulated time."""

    def round_trip(self, sent_us: int, received_us: int, autopilot_us: int | None) -> RoundTrip:
        """Return the record of a TIMESYNC round trip; `sent_us` and `received_us` are host times."""

    def receive(self, t_us: int, received_us: int) -> int:
        """Return the host time to use as time of receipt of a message with stamp `t_us`."""

    @property
    def offset_us(self) -> int | None:
        """Autopilot time minus host time, or None before the first stamp."""

    def update(self, t_us: int, received_us: int) -> int | None:
        """Process a stamped message; return the new offset if it has changed noticeably."""

    def to_autopilot(self, host_time_us: int) -> int:
        """Convert a host time; before the first stamp, return it unchanged."""


class _RealHost:
    """A clock whose host time is the computer's monotonic time."""

    host_us = staticmethod(host_us)
    _PACE_KNOWN = True  # whether the autopilot's clock runs at the rate of the host's clock

    def round_trip(self, sent_us: int, received_us: int, autopilot_us: int | None) -> RoundTrip:
        """Return the round trip; omit the autopilot's time if that clock may run at a different rate."""
        return RoundTrip(received_us, sent_us, autopilot_us if self._PACE_KNOWN else None)

    @staticmethod
    def receive(t_us: int, received_us: int) -> int:
        return received_us


class ClockEstimate(_RealHost):
    """An estimate of autopilot time minus host time, from stamps and times of receipt.

    Every message has an unknown positive delay, so the difference (stamp minus time of receipt) is too small.
    The largest difference in the last 8 s is therefore the best estimate. Older messages are not used, so
    that the estimate follows a drifting clock.
    """

    def __init__(self) -> None:
        self._offset_us: int | None = None
        self._best: deque[int] = deque(maxlen=_WINDOW)
        self._second = 0
        self._reported: int | None = None
        self._leap_filter = LeapFilter(_LEAPS_ACCEPTED)

    @property
    def offset_us(self) -> int | None:
        return self._offset_us

    def update(self, t_us: int, received_us: int) -> int | None:
        difference = t_us - received_us
        if self._offset_us is not None and self._leap_filter.rejects(difference - self._offset_us):
            return None
        second = received_us // 1_000_000
        if second != self._second or not self._best:
            self._second = second
            self._best.append(difference)
        elif difference > self._best[-1]:
            self._best[-1] = difference
        else:  # nearly every message
            return None
        offset = self._offset_us = max(self._best)
        if self._reported is None or abs(offset - self._reported) >= _STEP_US:
            self._reported = offset
            return offset
        return None

    def to_autopilot(self, host_time_us: int) -> int:
        return host_time_us + (self._offset_us or 0)


class SimulatedTime:
    """The single clock of a world that waits for the application; its time is the vehicle's newest stamp.

    Host time and autopilot time are equal, so a busy computer does not affect ages and timeouts.
    """

    def __init__(self) -> None:
        self._now_us: int | None = None
        self._reported = False

    def host_us(self) -> int:
        return self._now_us or 0

    def receive(self, t_us: int, received_us: int) -> int:
        """Advance the clock to the stamp, and return the clock's time as the time of receipt."""
        if self._now_us is None or t_us > self._now_us:
            self._now_us = t_us
        return self._now_us

    def round_trip(self, sent_us: int, received_us: int, autopilot_us: int | None) -> RoundTrip:
        """Return a round trip that takes no simulated time."""
        return RoundTrip(self.host_us(), self.host_us(), None)

    @property
    def offset_us(self) -> int | None:
        return None if self._now_us is None else 0

    def update(self, t_us: int, received_us: int) -> int | None:
        """Advance to a stamp; report the offset 0 once."""
        self.receive(t_us, received_us)
        if self._reported:
            return None
        self._reported = True
        return 0

    def to_autopilot(self, host_time_us: int) -> int:
        return host_time_us


class LockstepClock(_RealHost):
    """The clock of an autopilot that runs in lockstep with a simulator.

    The simulator does not wait for the application. The autopilot's clock runs at the simulator's rate and
    stops with the simulator. Its time is therefore estimated as the newest stamp plus an advance. The advance
    is the host time since the receipt of that stamp, multiplied by `speed`, the simulator's target real-time
    factor. The advance is at most 50 ms.
    """

    _REACH_US = 50_000
    _PACE_KNOWN = False

    def __init__(self, speed: float = 1.0) -> None:
        self._speed = speed
        self._newest: tuple[int, int] | None = None
        self._reported: int | None = None

    @property
    def offset_us(self) -> int | None:
        """Autopilot time minus host time at the newest stamp."""
        return self._newest[0] - self._newest[1] if self._newest is not None else None

    def update(self, t_us: int, received_us: int) -> int | None:
        if self._newest is not None and t_us <= self._newest[0]:
            return None
        self._newest = (t_us, received_us)
        offset = t_us - received_us
        if self._reported is None or abs(offset - self._reported) >= _LOCKSTEP_STEP_US:
            self._reported = offset
            return offset
        return None

    def to_autopilot(self, host_time_us: int) -> int:
        if self._newest is None:
            return host_time_us
        t_us, received_us = self._newest
        ahead = round(self._speed * max(0, host_time_us - received_us))
        return t_us + min(ahead, self._REACH_US)
