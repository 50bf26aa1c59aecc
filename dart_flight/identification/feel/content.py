"""What a ULog has to be felt from: topics and their rates, and the stretches in the air."""

from __future__ import annotations

import numpy as np

from dart_flight.config.document import InputError
from dart_flight.identification.thrust_curve import Track, ground_of
from dart_flight.recording.ulog import ULogFile, columns

TOPICS = (
    "sensor_combined",
    "vehicle_attitude",
    "vehicle_local_position",
    "actuator_motors",
    "actuator_outputs",
    "vehicle_land_detected",
    "battery_status",
)
# Topic -> rate in Hz from which on nothing is lost by it; below it is named.
WANTED_HZ = {
    "sensor_combined": 190.0,
    "vehicle_attitude": 15.0,
    "vehicle_local_position": 9.0,
    "actuator": 50.0,
}
_LEAST_IMU_HZ = 90.0  # below it a rigid contact is four samples
_RISEN_M = 0.3  # above the ground: taken off
_TAKEOFF_S = 5.0  # ... where the height is not known
_PROFILE = (
    "SDLOG_PROFILE 17, the default (bit 0) with high rate (bit 4): motors and attitude as fast as they are "
    "computed"
)


def missing(log: ULogFile) -> list[str]:
    """Topics that are not there or too slow, in words.

    Raises:
        InputError: without IMU or attitude nothing can be felt.
    """
    for name in ("sensor_combined", "vehicle_attitude"):
        if log.first(name) is None:
            raise InputError(f"has no {name}: nothing can be felt", source=log.source)
    rate = log.rate_hz("sensor_combined") or 0.0
    if rate < _LEAST_IMU_HZ:
        raise InputError(
            f"sensor_combined at {rate:.0f} Hz: a rigid contact of 50 ms needs {_LEAST_IMU_HZ:.0f}; log with "
            f"{_PROFILE}",
            source=log.source,
        )
    out, slow = [], False
    for name, wanted in WANTED_HZ.items():
        topics = ("actuator_motors", "actuator_outputs") if name == "actuator" else (name,)
        rates = [r for topic in topics if (r := log.rate_hz(topic)) is not None]
        if not rates:
            out.append(f"no {' or '.join(topics)}")
            slow = True
        elif max(rates) < wanted:
            out.append(f"{' or '.join(topics)} at {max(rates):.0f} Hz, {wanted:.0f} would do")
            slow = True
    if log.first("vehicle_land_detected") is None:
        out.append("no vehicle_land_detected: the whole log counts as flight")
    if log.gaps_s > 0.0:
        out.append(f"{log.gaps_s:.2f} s that the logger lost")
    return out + [f"what would help: {_PROFILE}"] * slow


def track_without_motors(log: ULogFile) -> Track:
    """The track of a log whose motor commands cannot be read."""
    imu = log.first("sensor_combined")
    assert imu is not None
    empty = np.empty(0)
    return Track(
        source=log.source,
        imu_s=np.asarray(imu["timestamp"], dtype=float) * 1e-6,
        specific_force=columns(imu, "accelerometer_m_s2", 3),
        rate=columns(imu, "gyro_rad", 3),
        motor_s=empty,
        motors=np.empty((0, 4)),
        velocity_s=empty,
        velocity=np.empty((0, 3)),
        voltage_s=empty,
        voltage=empty,
        ground=ground_of(log),
    )


def flights_of(log: ULogFile, track: Track) -> list[tuple[float, float]]:
    """From, to in seconds: in the air, from 0.3 m up to what PX4 calls landed."""
    begin, end = float(track.imu_s[0]), float(track.imu_s[-1])
    landed = log.first("vehicle_land_detected")
    if landed is None:
        return [(begin, end)]
    stamps = np.asarray(landed["timestamp"], dtype=float) * 1e-6
    air: list[list[float]] = []
    for t, state, until in zip(stamps, landed["landed"], [*stamps[1:], end], strict=True):
        if state:
            continue
        if air and air[-1][1] == t:
            air[-1][1] = float(until)
        else:
            air.append([float(t), float(until)])
    # What is in the air when the log begins has taken off before.
    taken_off = [(a if a <= begin + 0.1 else _off_the_ground(log, a, b), b) for a, b in air]
    return [(a, b) for a, b in taken_off if b > a]


def _off_the_ground(log: ULogFile, begin: float, end: float) -> float:
    """When a flight has risen a little: PX4's land detector says "in the air" at the first thrust."""
    position = log.first("vehicle_local_position")
    if position is None:
        return begin + _TAKEOFF_S
    t = np.asarray(position["timestamp"], dtype=float) * 1e-6
    inside = (t >= begin) & (t <= end)
    height = -np.asarray(position["z"], dtype=float)[inside]
    if not len(height):
        return begin + _TAKEOFF_S
    risen = np.flatnonzero(height > height[0] + _RISEN_M)
    return float(t[inside][risen[0]]) if len(risen) else end
