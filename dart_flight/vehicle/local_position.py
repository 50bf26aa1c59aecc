"""Whether PX4 has a local position: what it says of its estimator, beside what MAVSDK makes of it.

MAVSDK calls the local position good once one LOCAL_POSITION_NED has come, and PX4 sends that with whatever
it has: without motion capture and GPS, too, where its estimator only assumes that it stands still.
"""

from __future__ import annotations

import re

_FLAGS = re.compile(r'"flags":\s*(\d+)')
_ACCURACY = re.compile(r'"pos_horiz_accuracy":\s*([0-9.eE+-]+)')
_NEEDED = 1 | 2  # ESTIMATOR_STATUS_FLAGS: attitude, horizontal velocity
_PLACED = 8 | 16  # horizontal position, relative or absolute


def is_healthy(fields_json: str) -> bool | None:
    """Whether ESTIMATOR_STATUS has attitude, horizontal velocity and position; None: no such message."""
    found = _FLAGS.search(fields_json)
    if found is None:
        return None
    flags = int(found[1])
    return flags & _NEEDED == _NEEDED and bool(flags & _PLACED)


def position_sd_m(fields_json: str) -> float | None:
    """Standard deviation of the horizontal position by PX4's own estimator, metres; None: not said."""
    found = _ACCURACY.search(fields_json)
    return float(found[1]) if found is not None else None


class LocalPosition:
    """Put together from both messages, whichever comes first.

    Attributes:
        sent: MAVSDK has seen a position. Beside a good ESTIMATOR_STATUS it is not believed when it takes that
            back: in hardware in the loop its flag was seen to drop for seconds while the estimator was good
            throughout. That positions no longer come is a rule of the guard's (`odometry_silent`).
        healthy: what ESTIMATOR_STATUS said last; None: a vehicle that has not sent it.
    """

    def __init__(self) -> None:
        self.sent = self._was_sent = False
        self.healthy: bool | None = None

    @property
    def ok(self) -> bool:
        """Whether there is one to fly by."""
        self._was_sent = self._was_sent or self.sent
        return self.sent if self.healthy is None else self._was_sent and self.healthy
