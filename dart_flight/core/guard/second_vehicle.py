"""Detection of a second vehicle that shares the link and the system id.

In MAVLink the two vehicles are one system, so their samples alternate between two clocks or two positions. A
single vehicle does not alternate. After a clock reset, restart or jump of its estimate, the old clock or
position does not return. The detectors need every sample, in the order of receipt.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from dart_flight.base.geometry import norm
from dart_flight.base.records import OdometrySample
from dart_flight.base.stamps import leaps
from dart_flight.base.streams import SAMPLED_NAME
from dart_flight.core.guard.stream_watch import STAMP_TOLERANCE_S, Stamped

POSITION_JUMP_M: Final = 0.3  # larger than an estimator's correction; the flown distance is added to it
_TURNS: Final = 3  # alternations within `_WINDOW_US` that prove a second source
_WINDOW_US: Final = 2_000_000  # host time
_REACH_US: Final = 1_000_000  # longest gap between samples of one source
_SUSPECT_US: Final = 250_000  # time of suspicion after an unexpected sample; proof arrives sooner


class SecondClockDetector:
    """Detects a second clock in the stamps of one stream.

    If a stamp is older than the newest stamp by at most `tolerance_us`, a late datagram explains it.
    """

    def __init__(self, tolerance_us: float) -> None:
        self._tolerance_us = tolerance_us
        self._newest_us: int | None = None
        self._received_us = 0
        self._behind_us: int | None = None  # newest stamp of a suspected second clock
        self._was_behind = False
        self.odd_us: int | None = None  # receipt of the last sample that may come from another vehicle
        self._turns: deque[int] = deque(maxlen=_TURNS)  # receipts, host time

    def update(self, t_us: int, received_us: int) -> None:
        newest = self._newest_us
        if newest is None or t_us > newest:
            goes_on = newest is None or not leaps(t_us - newest, received_us - self._received_us)
            if self._was_behind and goes_on:
                self._turns.append(received_us)
            elif not goes_on:  # this stamp may come from the other clock
                self._behind_us, self.odd_us = newest, received_us
            self._newest_us, self._received_us, self._was_behind = t_us, received_us, False
            return
        if newest - t_us <= self._tolerance_us:
            return
        before = self._behind_us
        if before is not None and not 0 < t_us - before < _REACH_US:
            self._turns.clear()  # not a second clock: one clock jumps back repeatedly or stands still
        if not self._was_behind:
            self.odd_us = received_us
        self._behind_us, self._was_behind = t_us, True

    def clock_difference_s(self, now_us: int) -> float | None:
        """Return the difference of the two clocks, or None for one clock; `now_us` is host time."""
        if len(self._turns) < _TURNS or now_us - self._turns[0] > _WINDOW_US:
            return None
        assert self._newest_us is not None
        assert self._behind_us is not None
        return (self._newest_us - self._behind_us) * 1e-6


class SecondPositionDetector:
    """Detects a second vehicle in the positions of ODOMETRY.

    `jump_m` is the largest step between two positions of one vehicle, beyond the distance flown.
    """

    def __init__(self, jump_m: float) -> None:
        self._jump_m = jump_m
        self._here: OdometrySample | None = None
        self._other: OdometrySample | None = None
        self.odd_us: int | None = None  # receipt of the last sample that may come from another vehicle
        self._turns: deque[int] = deque(maxlen=_TURNS)  # receipts, host time

    def update(self, sample: OdometrySample) -> None:
        """Process a sample, even if its stamp is old."""
        here, other = self._here, self._other
        self._here = sample
        if here is None or sample.received_us - here.received_us > _REACH_US:
            self._other = None  # the vehicle may be anywhere after a gap
            return
        if self._is_same_vehicle(sample, here):
            return
        self._other, self.odd_us = here, sample.received_us
        if other is not None and self._is_same_vehicle(sample, other):
            self._turns.append(sample.received_us)

    def position_difference_m(self, now_us: int) -> float | None:
        """Return the distance between the two positions, or None for one vehicle; `now_us` is host time."""
        if len(self._turns) < _TURNS or now_us - self._turns[0] > _WINDOW_US:
            return None
        assert self._here is not None
        assert self._other is not None
        return math.dist(self._here.position_ned, self._other.position_ned)

    def _is_same_vehicle(self, sample: OdometrySample, before: OdometrySample) -> bool:
        age_us = sample.received_us - before.received_us
        if age_us > _REACH_US:
            return False
        speed = max(norm(sample.velocity_ned), norm(before.velocity_ned))
        return math.dist(sample.position_ned, before.position_ned) <= self._jump_m + speed * age_us * 1e-6


class OtherVehicles:
    """Other vehicles on the link: those with another system id, and one that shares the vehicle's id.

    `same_system` describes the evidence of a second vehicle with the same system id, and is never cleared.
    """

    def __init__(self) -> None:
        self.same_system: str | None = None
        self._clocks = {name: SecondClockDetector(1e6 * STAMP_TOLERANCE_S) for name in SAMPLED_NAME.values()}
        self._places = SecondPositionDetector(POSITION_JUMP_M)
        self._other_system: int | None = None

    def add_sample(self, name: str, item: Stamped) -> None:
        if self.same_system is not None:
            return
        received_us, clocks = item.received_us, self._clocks[name]
        clocks.update(item.t_us, received_us)
        if clocks.odd_us is not None:
            # One stream may arrive by two routes, one of them late; a second vehicle sends all streams.
            apart_s = [c.clock_difference_s(received_us) for c in self._clocks.values()]
            found = [seconds for seconds in apart_s if seconds is not None]
            if len(found) > 1 and max(found) - min(found) < STAMP_TOLERANCE_S:
                self.same_system = f"two clocks alternate, {found[0]:.1f} s apart"
        if type(item) is OdometrySample:
            self._places.update(item)
            apart_m = self._places.position_difference_m(received_us)
            if apart_m is not None:
                self.same_system = f"two positions alternate in the odometry, {apart_m:.1f} m apart"

    def add_system(self, system: int) -> None:
        self._other_system = system

    @property
    def other_system(self) -> str | None:
        if self._other_system is None:
            return None
        return f"system {self._other_system} sends on the same link"

    @property
    def any_system(self) -> str | None:
        """Description of another vehicle on the link, with any system id, or None."""
        return self.other_system or self.same_system

    def is_suspected(self, host_us: int) -> bool:
        """Return whether a second vehicle is detected or suspected; `host_us` is the newest receipt."""
        if self.same_system is not None:
            return True
        odd = (*[clocks.odd_us for clocks in self._clocks.values()], self._places.odd_us)
        return any(odd_us is not None and host_us - odd_us < _SUSPECT_US for odd_us in odd)
