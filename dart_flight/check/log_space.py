"""The check that the disk has room for the log of the mission's longest possible flight."""

from __future__ import annotations

import shutil
from pathlib import Path

from dart_flight.check.findings import CheckFinding
from dart_flight.config.mission import Mission
from dart_flight.core.mission.approach import plan_transit, transit_segments
from dart_flight.recording.writer import BYTES_PER_S

_WAITS_FIRST = 4  # number of timeouts before the mission: for telemetry, offboard mode, arming and climb
_LANDING_S = 60.0


def check_log_space(mission: Mission, log_dir: Path) -> CheckFinding:
    """Check that the disk of the log folder has room for the log of the longest flight."""
    there = next(folder for folder in (log_dir.absolute(), *log_dir.absolute().parents) if folder.exists())
    try:
        left = shutil.disk_usage(there).free
    except OSError as error:
        return CheckFinding("log_space", False, f"{log_dir}: {error.strerror}")
    longest_s = longest_flight_s(mission)
    needed = BYTES_PER_S * longest_s
    message = (
        f"{_megabytes(left)} free for the log in {log_dir}; "
        f"the longest flight, {longest_s / 60.0:.1f} minutes, needs {_megabytes(needed)}"
    )
    return CheckFinding("log_space", left >= needed, message)


def longest_flight_s(mission: Mission) -> float:
    """Return the duration of a mission in which every phase lasts until its timeout, seconds."""
    vehicle, limits = mission.vehicle, mission.limits
    wait_s = vehicle.flying.ready_timeout_s
    lock_s = 0.0 if vehicle.lock is None else vehicle.lock.timeout_s
    ways_s = sum(
        plan_transit(mission, leg, leg.begin).duration_s
        for leg in transit_segments(mission)
        if leg.begin is not None
    )
    stops_s = sum(w.hold_s + (wait_s if w.position is not None else 0.0) for w in mission.waypoints)
    hits_s = len(mission.collisions) * (wait_s + lock_s + limits.collision_timeout_s)
    goal_s = limits.collision_timeout_s + mission.goal.hold_s
    return _WAITS_FIRST * wait_s + ways_s + stops_s + hits_s + goal_s + _LANDING_S


def _megabytes(size: float) -> str:
    return f"{size / 1e6:.{0 if size >= 1e7 else 1}f} MB"
