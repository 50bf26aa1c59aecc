"""How old samples are when they come.

A delay that is always the same does not show in stamps: the offset between the clocks hides it. A round trip
bounds it: the time with which the autopilot answers lies between asking and hearing, so the offset that it
gives is wrong by half the round trip at most. The best one so far relates the stamp of an IMU sample to its
receipt.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from dart_flight.base.filters import kept_share
from dart_flight.base.records import RoundTrip

_SHARE: Final = 0.15  # of about the last second; what comes in one batch after a pause takes no time
_SHARE_US: Final = 1_000_000
_STEP_MAX_US: Final = 20_000  # a sample stands for the time since the one before, and for no more than this
_DRIFT: Final = 2e-4  # of two clocks against each other, seconds per second, at most
_LAST: Final = 3  # round trips, of which the shortest counts where the clocks cannot be compared


class TelemetryDelay:
    """Age of the samples of one vehicle; nothing is known of it before the first round trip.

    Args:
        limit_s: samples older than this are late.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_us = limit_s * 1e6
        self._offset_us: float | None = None  # autopilot's time less the host's
        self._error_us = 0.0  # of it, at most
        self._measured_us = 0  # host time
        self._last: deque[int] = deque(maxlen=_LAST)
        self._received_us = 0
        self._share = 0.0
        self.age_us = 0.0  # of the newest sample
        self.late = False

    def take_round_trip(self, trip: RoundTrip) -> None:
        """A request and its answer."""
        took_us = max(0, trip.received_us - trip.sent_us)
        self._last.append(took_us)
        if trip.autopilot_us is None:
            return
        offset_us = trip.autopilot_us - 0.5 * (trip.sent_us + trip.received_us)
        error_us = 0.5 * took_us
        if self._offset_us is not None:
            drifted_us = self._error_us + _DRIFT * (trip.received_us - self._measured_us)
            # Further apart than both can be wrong: the autopilot's clock has jumped.
            jumped = abs(offset_us - self._offset_us) > drifted_us + error_us
            if error_us > drifted_us and not jumped:
                return
        self._offset_us, self._error_us, self._measured_us = offset_us, error_us, trip.received_us

    def take_sample(self, t_us: int, received_us: int) -> None:
        """An IMU sample: when it was taken, and when it came."""
        if not self._last:
            return
        if self._offset_us is None:
            self.age_us = 0.5 * min(self._last)
        else:
            self.age_us = received_us + self._offset_us - t_us
        step_us = min(max(received_us - self._received_us, 0), _STEP_MAX_US)
        self._received_us = received_us
        kept = kept_share(step_us, _SHARE_US)
        self._share = kept * self._share + (1.0 - kept if self.age_us > self._limit_us else 0.0)
        self.late = self._share > _SHARE

    def describe(self) -> str:
        """What is known, in words."""
        shortest_us = min(self._last, default=0)
        also = f", round trip {shortest_us * 1e-3:.0f} ms" if shortest_us > self._limit_us else ""
        return f"telemetry arrives {self.age_us * 1e-3:.0f} ms after it was sampled{also}"
