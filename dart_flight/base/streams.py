"""The telemetry streams: MAVLink message, record, requested rate, and lowest rate for a mission.

`vehicle` requests the rates, and `check` compares the measured rates with the required rates. The guard
checks the age of samples in host time. `vehicle.messages` decides whose message is accepted. PX4 rounds the
interval between two messages to a multiple of 4 ms. Therefore the requested rate of the IMU is 250 Hz, not
200 Hz.
"""

from __future__ import annotations

from typing import Final

import msgspec

from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    EscSample,
    EstimatorSample,
    ImuSample,
    OdometrySample,
    Record,
    StatusSample,
)


class Stream(msgspec.Struct, frozen=True):
    """One telemetry stream.

    Attributes:
        number: MAVLink message id.
        record: type of the record that the message becomes or updates.
        rate_hz: requested rate.
        expected_hz: lowest rate that a mission needs; 0 if a mission does not need the stream.
    """

    name: str
    message: str
    number: int
    record: type[Record]
    rate_hz: float
    expected_hz: float

    @property
    def watched_hz(self) -> float:
        """Rate for commands that do not fly: `rate_hz` for the IMU, at most 62.5 Hz for other streams."""
        return self.rate_hz if self.name == "imu" else min(self.rate_hz, 62.5)


# Streams whose samples have stamps; each stream is one message.
SAMPLED: Final = (
    Stream("imu", "HIGHRES_IMU", 105, ImuSample, 250.0, 150.0),
    Stream("attitude", "ATTITUDE_QUATERNION", 31, AttitudeSample, 125.0, 45.0),
    Stream("odometry", "ODOMETRY", 331, OdometrySample, 125.0, 30.0),
    Stream("actuator", "ACTUATOR_OUTPUT_STATUS", 375, ActuatorSample, 125.0, 45.0),
)
STREAMS: Final = (*SAMPLED, Stream("landed", "EXTENDED_SYS_STATE", 245, StatusSample, 5.0, 1.0))

# Motor speeds, if the configuration uses them; the estimator's status and the flight mode, for the guard.
# PX4 sends the status at 1 Hz by default. This is too slow: a drifting position errs by 1 m in a second. The
# heartbeat shows the mode only once a second and may miss a pilot's brief change.
OPTIONAL: Final = (
    Stream("esc", "ESC_STATUS", 291, EscSample, 125.0, 45.0),
    Stream("estimator", "ESTIMATOR_STATUS", 230, EstimatorSample, 10.0, 0.0),
    Stream("mode", "CURRENT_MODE", 436, StatusSample, 10.0, 0.0),  # from PX4 v1.15 on
)

BY_NAME: Final = {stream.name: stream for stream in (*STREAMS, *OPTIONAL)}
BY_MESSAGE: Final = {stream.message: stream for stream in (*STREAMS, *OPTIONAL)}
SAMPLED_NAME: Final[dict[type, str]] = {stream.record: stream.name for stream in SAMPLED}
