"""Figures from PX4's own log, read from a synthetic ULog of a flight with an impact."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from dart_flight.lab.inspect.px4_log import read_px4_log
from dart_flight.recording.verdict import Px4Figures

pytest.importorskip("pyulog")

FORMATS = (
    "vehicle_status:uint64_t timestamp;uint8_t arming_state;bool failsafe;",
    "vehicle_local_position:uint64_t timestamp;uint8_t xy_reset_counter;uint8_t z_reset_counter;"
    "uint8_t vxy_reset_counter;uint8_t vz_reset_counter;",
    "vehicle_imu_status:uint64_t timestamp;uint32_t[3] accel_clipping;",
    "failure_detector_status:uint64_t timestamp;bool fd_roll;bool fd_pitch;",
)


def message(kind: bytes, body: bytes) -> bytes:
    return struct.pack("<H", len(body)) + kind + body


def ulog(path: Path, rows: list[tuple[int, bytes]]) -> Path:
    """Write a ULog file; a row is (message id, its packed fields)."""
    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    data += message(b"B", bytes(40))
    for text in FORMATS:
        data += message(b"F", text.encode())
    for i, text in enumerate(FORMATS):
        data += message(b"A", struct.pack("<BH", 0, i) + text.partition(":")[0].encode())
    for number, body in rows:
        data += message(b"D", struct.pack("<H", number) + body)
    path.write_bytes(data)
    return path


def flight_rows(failsafe: bool) -> list[tuple[int, bytes]]:
    """Return rows of a flight armed from 10 to 20 s; resets and clipping outside do not count."""
    s = 1_000_000
    return [
        (0, struct.pack("<QBB", 1 * s, 1, 0)),
        (1, struct.pack("<QBBBB", 2 * s, 255, 3, 0, 0)),
        (2, struct.pack("<Q3I", 3 * s, 7, 0, 0)),
        (0, struct.pack("<QBB", 10 * s, 2, 0)),
        (3, struct.pack("<QBB", 11 * s, 0, 0)),
        (1, struct.pack("<QBBBB", 12 * s, 0, 3, 1, 0)),  # the 8-bit xy counter overflows: 1 reset, 1 of vxy
        (2, struct.pack("<Q3I", 13 * s, 12, 1, 0)),
        (0, struct.pack("<QBB", 15 * s, 2, int(failsafe))),
        (3, struct.pack("<QBB", 16 * s, 0, int(failsafe))),
        (0, struct.pack("<QBB", 20 * s, 2, 0)),
        (0, struct.pack("<QBB", 21 * s, 1, 0)),
        (2, struct.pack("<Q3I", 25 * s, 99, 0, 0)),  # carried by hand after the flight
    ]


@pytest.mark.parametrize("failsafe", [False, True])
def test_figures_cover_only_the_armed_time(tmp_path: Path, failsafe: bool) -> None:
    figures = read_px4_log(ulog(tmp_path / "one.ulg", flight_rows(failsafe)), "1.16.0")
    assert figures == Px4Figures("1.16.0", 2, 6, failsafe, failsafe)


def test_an_unreadable_log_has_no_figures(tmp_path: Path) -> None:
    assert read_px4_log(tmp_path / "none.ulg", "1.16.0") == Px4Figures("1.16.0")
    bad = tmp_path / "bad.ulg"
    bad.write_bytes(b"not a log")
    assert read_px4_log(bad) == Px4Figures()
    assert read_px4_log(ulog(tmp_path / "ground.ulg", flight_rows(False)[:3])) == Px4Figures()
