"""Figures from PX4's own log, read from a synthetic ULog of a flight with an impact."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from dart_flight.lab.inspect.px4_log import read_px4_log
from dart_flight.recording.verdict import Px4Figures
from tests.doubles.ulog_file import Topics, write_ulog

pytest.importorskip("pyulog")

S = 1_000_000  # microseconds


def flight_log(path: Path, failsafe: bool, until_s: float = math.inf) -> Path:
    """Write the log of a flight armed from 10 to 20 s; resets and clipping outside do not count."""
    topics: Topics = {
        ("vehicle_status", 0): (
            "uint8_t arming_state;bool failsafe;",
            [(1 * S, (1, 0)), (10 * S, (2, 0)), (15 * S, (2, failsafe)), (20 * S, (2, 0)), (21 * S, (1, 0))],
        ),
        ("vehicle_local_position", 0): (
            "uint8_t xy_reset_counter;uint8_t z_reset_counter;uint8_t vxy_reset_counter;"
            "uint8_t vz_reset_counter;",
            # The 8-bit xy counter overflows: one reset of xy, and one of vxy.
            [(2 * S, (255, 3, 0, 0)), (12 * S, (0, 3, 1, 0))],
        ),
        ("vehicle_imu_status", 0): (
            "uint32_t[3] accel_clipping;",
            # The vehicle is carried by hand after the flight.
            [(3 * S, (7, 0, 0)), (13 * S, (12, 1, 0)), (25 * S, (99, 0, 0))],
        ),
        ("failure_detector_status", 0): (
            "bool fd_roll;bool fd_pitch;",
            [(11 * S, (0, 0)), (16 * S, (0, failsafe))],
        ),
    }
    kept = {
        topic: (fields, [row for row in rows if row[0] <= until_s * S])
        for topic, (fields, rows) in topics.items()
    }
    return write_ulog(path, kept)


@pytest.mark.parametrize("failsafe", [False, True])
def test_figures_cover_only_the_armed_time(tmp_path: Path, failsafe: bool) -> None:
    figures = read_px4_log(flight_log(tmp_path / "one.ulg", failsafe), "1.16.0")
    assert figures == Px4Figures("1.16.0", 2, 6, failsafe, failsafe)


def test_an_unreadable_log_has_no_figures(tmp_path: Path) -> None:
    assert read_px4_log(tmp_path / "none.ulg", "1.16.0") == Px4Figures("1.16.0")
    bad = tmp_path / "bad.ulg"
    bad.write_bytes(b"not a log")
    assert read_px4_log(bad) == Px4Figures()
    assert read_px4_log(flight_log(tmp_path / "ground.ulg", False, until_s=5.0)) == Px4Figures()
