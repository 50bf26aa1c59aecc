"""The content of a ULog that detection needs: topics, their rates, and the intervals in the air."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from dart_flight.config.document import InputError
from dart_flight.lab.holes import describe_cut_end, describe_holes
from dart_flight.lab.track import Track
from dart_flight.lab.ulog import ARMED, ULogFile, seconds

TOPICS = (
    "sensor_combined",
    "vehicle_attitude",
    "vehicle_local_position",
    "actuator_motors",
    "actuator_outputs",
    "vehicle_land_detected",
    "vehicle_status",
    "battery_status",
)
# Topic -> rate that detection needs, Hz; `missing` reports a lower rate.
WANTED_HZ = {
    "sensor_combined": 190.0,
    "vehicle_attitude": 15.0,
    "vehicle_local_position": 9.0,
    "actuator": 50.0,
}
_MIN_IMU_HZ = 90.0  # minimum IMU rate; at a lower rate, a rigid contact has at most four samples
_RISEN_M = 0.3  # height above the ground at which a flight begins
_TAKEOFF_S = 5.0  # assumed duration of the take-off if the height is unknown
_LANDED_S = 1.0  # above `_HIGH_M`, a shorter landed state means that the motors were cut in the air
_HIGH_M = 2.0
_LOW_M = 0.5
_PROFILE = (
    "SDLOG_PROFILE 17 (bits 0 and 4: default and high rate), which logs motors and attitude at their full "
    "rate"
)


def missing(log: ULogFile) -> list[str]:
    """Describe the topics that are missing or too slow; reject a log without IMU or attitude."""
    for name in ("sensor_combined", "vehicle_attitude"):
        if log.first(name) is None:
            raise InputError(f"the log has no {name}: impacts cannot be detected", source=log.source)
    rate = log.rate_hz("sensor_combined") or 0.0
    if rate < _MIN_IMU_HZ:
        raise InputError(
            f"sensor_combined is logged at {rate:.0f} Hz, but a rigid contact of 50 ms needs at least "
            f"{_MIN_IMU_HZ:.0f} Hz; log with {_PROFILE}",
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
            out.append(f"{' or '.join(topics)} at {max(rates):.0f} Hz, recommended {wanted:.0f} Hz")
            slow = True
    if log.first("vehicle_land_detected") is None:
        out.append("no vehicle_land_detected: the whole log counts as flight")
    if log.gaps_s > 0.0:
        out.append(f"{log.gaps_s:.2f} s lost by the logger")
    for name in ("sensor_combined", "vehicle_attitude"):
        out += describe_holes(_stamps(log, name), name)
    if log.first("vehicle_status") is None:
        out.append("no vehicle_status: vehicle type and arming are unknown")
    return [*out, *[f"recommended logging: {_PROFILE}"] * slow, *log.damage]


def _stamps(log: ULogFile, name: str) -> NDArray[np.float64]:
    data = log.first(name)
    return np.empty(0) if data is None else seconds(data)


def landings_of(log: ULogFile, track: Track) -> list[tuple[float, float]]:
    """Return start and end (s) of the intervals on the ground; each starts at PX4's first sign of landing."""
    close = track.ground
    landed = [(min([a, *(x for x, y in close if x <= a <= y)]), b) for a, b in _landed(log, track)]
    return landed + [(a, b) for a, b in close if height_at(track, a) < _LOW_M]


def _landed(log: ULogFile, track: Track) -> list[tuple[float, float]]:
    """Return start and end (s) of PX4's landed states.

    A short landed state high above the ground means that the motors were cut in the air, and is omitted.
    """
    found = _stretches(log, "vehicle_land_detected", "landed")
    return [(a, b) for a, b in found if b - a >= _LANDED_S or not height_at(track, a) > _HIGH_M]


def height_at(track: Track, t_s: float) -> float:
    """Return the height above the first position in the log, m; NaN if PX4 has no estimate."""
    if not track.position_s.size:
        return math.nan
    down = track.position[:, 2]
    return float(down[0] - np.interp(t_s, track.position_s, down))


def flights_of(log: ULogFile, track: Track) -> list[tuple[float, float]]:
    """Return start and end (s) of each flight during which the vehicle was armed.

    A flight starts at 0.3 m height and ends when PX4 reports a landing.
    """
    begin, end = float(track.imu_s[0]), float(track.imu_s[-1])
    armed = _stretches(log, "vehicle_status", "arming_state", ARMED)
    detected = log.first("vehicle_land_detected")
    if detected is None:
        return _clipped(armed, begin, end) if log.first("vehicle_status") is not None else [(begin, end)]
    first = float(seconds(detected)[0])
    edges = [min(first, end), *(t for stretch in _landed(log, track) for t in stretch), end]
    air = _clipped(zip(edges[::2], edges[1::2], strict=True), begin, end)
    if log.first("vehicle_status") is not None:
        # A vehicle disarmed in the air still has to fall, so the flight continues.
        air = [(a, b) for a, b in air if any(x < b and y > a for x, y in armed)]
    # A vehicle that is in the air at the start of the log, or at PX4's first estimate, took off earlier.
    known = max(first, begin + 0.1)
    taken_off = [(begin if a <= known else _off_the_ground(track, a, b), b) for a, b in air]
    return [(a, b) for a, b in taken_off if b > a]


def describe_cut(log: ULogFile, track: Track, flying: list[tuple[float, float]]) -> list[str]:
    """Return a line if the log begins in the air, and a line if it ends in the air.

    Without PX4's land detector there are no lines.
    """
    if not flying or log.first("vehicle_land_detected") is None:
        return []
    begin, end = float(track.imu_s[0]), float(track.imu_s[-1])
    lines = []
    if flying[0][0] <= begin:
        lines.append("cut: the log begins in the air")
    if flying[-1][1] >= end:
        lines.append(describe_cut_end(end - begin, "in the air"))
    return lines


def _clipped(stretches: Iterable[tuple[float, float]], begin: float, end: float) -> list[tuple[float, float]]:
    inside = [(max(a, begin), min(b, end)) for a, b in stretches]
    return [(a, b) for a, b in inside if b > a]


def _stretches(log: ULogFile, topic: str, field: str, value: int = 1) -> list[tuple[float, float]]:
    """Return start and end (s) of the intervals in which a field has a value.

    The value of a sample is valid until the next sample.
    """
    data = log.first(topic)
    if data is None:
        return []
    holds = np.asarray(data[field]).astype(int) == value
    stamps = [*seconds(data), math.inf]
    turns = np.flatnonzero(np.diff(np.concatenate(([False], holds, [False])).astype(int)))
    return [(float(stamps[a]), float(stamps[b])) for a, b in zip(turns[::2], turns[1::2], strict=True)]


def _off_the_ground(track: Track, begin: float, end: float) -> float:
    """Return the time at which the vehicle has risen by 0.3 m.

    PX4's land detector is too early: it reports flight at the first thrust.
    """
    inside = (track.position_s >= begin) & (track.position_s <= end)
    height = -track.position[inside, 2]
    if not len(height):
        return begin + _TAKEOFF_S
    risen = np.flatnonzero(height > height[0] + _RISEN_M)
    return float(track.position_s[inside][risen[0]]) if len(risen) else end
