"""PX4's reasons for refusing to arm or to change mode, as text, from its arming checks or SYS_STATUS."""

from __future__ import annotations

from typing import Any

from dart_flight.vehicle.messages import SEVERITIES, Sensors

_BAD_AT_MAX = 4  # log level of a warning; 0 is an emergency
SEVERE = frozenset(SEVERITIES[: _BAD_AT_MAX + 1])
_PREARM = 1 << 28  # MAV_SYS_STATUS_PREARM_CHECK
# Bits of MAV_SYS_STATUS_SENSOR that apply to a multirotor.
_SENSORS = {
    0: "gyro",
    1: "accelerometer",
    2: "magnetometer",
    3: "barometer",
    5: "GPS",
    6: "optical flow",
    7: "position by vision",
    9: "external position",
    14: "position control",
    15: "motor outputs",
    16: "remote control",
    20: "geofence",
    21: "attitude and position estimate",
    25: "battery",
    29: "obstacle avoidance",
}

Report = tuple[bool, tuple[str, ...], tuple[str, ...]]  # can arm, blocking problems, other problems


def severity(log_level: Any) -> str:
    """Return the STATUSTEXT name of an event's log level."""
    level = int(log_level)
    return SEVERITIES[level] if 0 <= level < len(SEVERITIES) else "debug"


def report_from_checks(report: Any) -> Report:
    """Convert MAVSDK's report of PX4's health and arming checks; skip messages less severe than a warning."""
    mode = report.current_mode_intention
    blocking = () if mode.can_arm_or_run else _problem_texts(mode.problems)
    others = tuple(word for word in _problem_texts(report.all_problems) if word not in blocking)
    return bool(mode.can_arm_or_run), blocking, others


def report_from_sys_status(sensors: Sensors) -> Report:
    """Report the enabled but unhealthy sensors, for a PX4 that sends no health reports."""
    bad = sensors.enabled & ~sensors.healthy
    words = tuple(f"{name} not healthy" for bit, name in _SENSORS.items() if bad & 1 << bit)
    refused = not sensors.healthy & _PREARM  # PX4 v1.14 sets the pre-arm bit only in `healthy`
    # The checks may fail for a reason other than the unhealthy sensors.
    return not refused, ("preflight checks failed",) if refused else (), words


def _problem_texts(problems: Any) -> tuple[str, ...]:
    found = (p.message.strip() for p in problems if int(p.log_level) <= _BAD_AT_MAX)
    return tuple(dict.fromkeys(word for word in found if word))
