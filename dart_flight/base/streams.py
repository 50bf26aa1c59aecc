"""The telemetry streams: MAVLink messages, requested rates, lowest rates, and stamps that leap ahead.

`vehicle` requests the rates, and `check` compares the measured rates with the required rates. The guard
checks the age of samples in host time. PX4 rounds the interval between two messages to a multiple of 4 ms.
Therefore the requested rate of the IMU is 250 Hz, not 200 Hz.
"""

from __future__ import annotations

from typing import Final

import msgspec

LEAP_US: Final = 1_000_000
FASTEST: Final = 20  # speed of the fastest simulation, simulated seconds per second


class Stream(msgspec.Struct, frozen=True):
    """One telemetry stream: `rate_hz` is requested, `expected_hz` is the lowest rate that a mission needs."""

    name: str
    message: str
    rate_hz: float
    expected_hz: float

    @property
    def watched_hz(self) -> float:
        """Rate requested by a command that does not fly: `rate_hz` for the IMU, else at most 62.5 Hz."""
        return self.rate_hz if self.name == "imu" else min(self.rate_hz, 62.5)


STREAMS: tuple[Stream, ...] = (
    Stream("imu", "HIGHRES_IMU", 250.0, 150.0),
    Stream("attitude", "ATTITUDE_QUATERNION", 125.0, 45.0),
    Stream("odometry", "ODOMETRY", 125.0, 30.0),
    Stream("actuator", "ACTUATOR_OUTPUT_STATUS", 125.0, 45.0),
    Stream("landed", "EXTENDED_SYS_STATE", 5.0, 1.0),
)

# Optional streams: motor speeds if the configuration uses them, and the estimator's status and the flight
# mode for the guard. PX4's default of 1 Hz for the status is too slow: a drifting position is wrong by a
# metre after a second. The heartbeat shows the mode once a second and misses a pilot's short change.
# MAVSDK cannot set their rates; SET_MESSAGE_INTERVAL does, by MAVLink message number.
ESC = Stream("esc", "ESC_STATUS", 125.0, 45.0)
ESTIMATOR = Stream("estimator", "ESTIMATOR_STATUS", 10.0, 0.0)
MODE = Stream("mode", "CURRENT_MODE", 10.0, 0.0)  # from PX4 v1.15 on
MESSAGE_ID = {ESC.message: 291, ESTIMATOR.message: 230, MODE.message: 436}

BY_NAME = {stream.name: stream for stream in STREAMS}


def leaps(ahead_us: int, elapsed_us: int = 0) -> bool:
    """Return whether a stamp is too far ahead of an earlier one for the host time `elapsed_us` between them.

    The sample may then come from another vehicle.
    """
    return ahead_us > LEAP_US and ahead_us > LEAP_US + FASTEST * elapsed_us


class LeapFilter:
    """Rejects stamps that leap, until so many leap in a row that the clock itself must have jumped."""

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
