"""Figures of a flight that only PX4's own log contains: EKF resets, clipping and failsafes."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

from dart_flight.config.document import InputError
from dart_flight.lab.ulog import open_ulog
from dart_flight.recording.verdict import Px4Figures

_ARMED = 2  # vehicle_status.arming_state
_RESET_COUNTERS = ("xy_reset_counter", "z_reset_counter", "vxy_reset_counter", "vz_reset_counter")
_TOPICS = ["vehicle_status", "vehicle_local_position", "vehicle_imu_status", "failure_detector_status"]


def read_px4_log(path: str | Path, version: str | None = None) -> Px4Figures:
    """Return the figures of one ULog; a figure that is missing or unreadable is None.

    Without pyulog (extra `sim`), only the version is known.
    """
    figures = Px4Figures(version)
    try:
        log = open_ulog(path, _TOPICS)
    except InputError:
        # Without pyulog or a readable file the verdict is still valid.
        return figures
    topics = {name: instances[0] for name, instances in log.topics.items() if 0 in instances}
    status = topics.get("vehicle_status")
    if status is None:
        return figures
    armed = status["timestamp"][status["arming_state"] == _ARMED]
    if not len(armed):
        return figures
    begin, end = int(armed[0]), int(armed[-1])
    figures.failsafe = bool(_within(status, begin, end, "failsafe").any())
    if "vehicle_local_position" in topics:
        position = topics["vehicle_local_position"]
        figures.ekf_resets = sum(_rise(_within(position, begin, end, name)) for name in _RESET_COUNTERS)
    if "vehicle_imu_status" in topics:
        imu = topics["vehicle_imu_status"]
        figures.clipped_samples = sum(
            _rise(_within(imu, begin, end, f"accel_clipping[{axis}]")) for axis in range(3)
        )
    if "failure_detector_status" in topics:
        failure = topics["failure_detector_status"]
        figures.attitude_failure = bool(
            _within(failure, begin, end, "fd_roll").any() or _within(failure, begin, end, "fd_pitch").any()
        )
    return figures


def _within(topic: dict[str, Any], begin_us: int, end_us: int, field: str) -> Any:
    """Return a field's samples between two times, preceded by the last sample before the first time."""
    stamps = topic["timestamp"]
    first = max(0, int((stamps < begin_us).sum()) - 1)
    last = int((stamps <= end_us).sum())
    return topic[field][first:last]


def _rise(counter: Any) -> int:
    """Return the increase of a counter, which may overflow at 8 or 32 bits."""
    if len(counter) < 2:
        return 0
    values = [int(value) for value in counter]
    width = 256 if counter.dtype.itemsize == 1 else 1 << 32
    return sum((after - before) % width for before, after in itertools.pairwise(values))
