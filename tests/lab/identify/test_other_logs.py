"""Recordings that are no ULogs, read into the shape of one: frames, units, what was not measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from dart_flight.base.geometry import GRAVITY_M_S2, Vec3, rotate
from dart_flight.config.document import InputError
from dart_flight.lab.inspect.content import flights_of, track_without_motors
from dart_flight.recording.ulog import ULogFile, columns
from tools.other_logs import filled_in, from_euler, open_other

Array = NDArray[np.float64]
_RATE_HZ = 100.0
_TILT = np.radians([20.0, -10.0, 60.0])  # roll, pitch, yaw; y left, z up
_WORLD = np.array([1.0, 2.0, GRAVITY_M_S2 + 0.5])  # what is felt, x forward, y left, z up


def _write(path: Path, table: dict[str, Array]) -> Path:
    np.savetxt(
        path,
        np.stack(list(table.values()), axis=1),
        delimiter=",",
        header=",".join(table),
        comments="",
        fmt="%.9f",
    )
    return path


def _turn(angles: Array) -> Array:
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


def _felt_ned(log: ULogFile, i: int) -> Vec3:
    imu, attitude = log.first("sensor_combined"), log.first("vehicle_attitude")
    assert imu is not None
    assert attitude is not None
    w, x, y, z = columns(attitude, "q", 4)[i]
    fx, fy, fz = columns(imu, "accelerometer_m_s2", 3)[i]
    return rotate((w, x, y, z), (fx, fy, fz))


def _nanobench(count: int = 600) -> dict[str, Array]:
    rng = np.random.default_rng(1)
    t = np.arange(count) / _RATE_HZ
    body = _turn(_TILT).T @ _WORLD / GRAVITY_M_S2
    q = from_euler(_TILT[None, :])[0]
    up = np.clip(t - 1.0, 0.0, 1.0)
    names = {"t": t + 1.7e9, "pwr_pm_vbat": np.full(count, 3.9)}
    names |= {f"imu_acc_{a}": body[i] + rng.normal(0.0, 0.01, count) for i, a in enumerate("xyz")}
    names |= {f"imu_gyro_{a}": 0.1 * (i + 1) + rng.normal(0.0, 0.01, count) for i, a in enumerate("xyz")}
    names |= {f"att_stateEstimate_q{a}": np.full(count, q[i]) for i, a in enumerate("wxyz")}
    names |= {f"motor_motor_m{i}": np.full(count, 32767.5) for i in range(1, 5)}
    names |= {"px": t, "py": 2.0 * t, "pz": 0.05 + up}
    return names | {"vx": np.full(count, 1.0), "vy": np.full(count, 2.0), "vz": np.zeros(count)}


def test_nanobench_comes_in_px4s_frames_and_units(tmp_path: Path) -> None:
    log = open_other(_write(tmp_path / "flight.csv", _nanobench()))

    felt = np.mean([_felt_ned(log, i) for i in range(0, 600, 3)], axis=0)
    assert felt == pytest.approx(_WORLD * (1, -1, -1), abs=0.05)
    imu, position = log.first("sensor_combined"), log.first("vehicle_local_position")
    assert imu is not None
    assert position is not None
    assert columns(imu, "gyro_rad", 3).mean(axis=0) == pytest.approx([0.1, -0.2, -0.3], abs=0.005)
    assert (position["vx"][0], position["vy"][0]) == (1.0, -2.0)
    motors = log.first("actuator_motors")
    assert motors is not None
    assert motors["control[3]"][0] == pytest.approx(0.5, abs=1e-4)
    # Off the floor from 0.15 m on, and taken off 0.3 m higher.
    ((begin, end),) = flights_of(log, track_without_motors(log))
    assert begin == pytest.approx(1.0 + 0.15 + 0.3, abs=0.03)
    assert end == pytest.approx(5.99, abs=0.02)


def test_with_its_motors_off_it_has_landed_whatever_the_height(tmp_path: Path) -> None:
    table = _nanobench()
    for i in range(1, 5):
        table[f"motor_motor_m{i}"][400:] = 0.0
    log = open_other(_write(tmp_path / "flight.csv", table))

    ((_, end),) = flights_of(log, track_without_motors(log))
    assert end == pytest.approx(4.0, abs=0.02)


def test_samples_that_were_filled_in_are_left_out(tmp_path: Path) -> None:
    table = _nanobench()
    for name, values in table.items():
        if name.startswith("imu_"):
            values[200:220] = np.linspace(values[200], values[219], 20)
            values[450:] = values[450] + np.arange(150) * (values[451] - values[450])
    log = open_other(_write(tmp_path / "flight.csv", table))

    imu = log.first("sensor_combined")
    assert imu is not None
    t = (imu["timestamp"] - imu["timestamp"][0]) * 1e-6
    assert not ((t > 2.005) & (t < 2.185)).any()
    assert t[-1] <= 4.505
    assert log.gaps_s == pytest.approx(0.18, abs=0.011)


def test_noise_is_not_taken_for_filled_in() -> None:
    assert not filled_in(np.random.default_rng(2).normal(0.0, 0.003, (5000, 6))).any()


def test_nanodrones_accelerometer_is_turned_back(tmp_path: Path) -> None:
    count = 300
    rng = np.random.default_rng(3)
    q = from_euler(_TILT[None, :])[0]
    table = {"t": np.arange(count) / _RATE_HZ, "Vbat": np.full(count, 3.7)}
    table |= {a: np.zeros(count) for a in "xyz"} | {f"v{a}": np.zeros(count) for a in "xyz"}
    table |= {f"q{a}": np.full(count, q[i]) for i, a in enumerate("wxyz")}
    table |= {f"a{a}": _WORLD[i] + rng.normal(0.0, 0.01, count) for i, a in enumerate("xyz")}
    table |= {f"w{a}": rng.normal(0.0, 0.01, count) for a in "xyz"}
    table |= {f"m{i}_thrust": np.full(count, 0.6) for i in range(1, 5)}
    for name in ("ax", "ay", "az", "wx", "wy", "wz"):
        table[name][100:104] = table[name][99]  # lost: the value before it
    log = open_other(_write(tmp_path / "flight.csv", table))

    felt = np.mean([_felt_ned(log, i) for i in range(200)], axis=0)
    assert felt == pytest.approx(_WORLD * (1, -1, -1), abs=0.02)
    imu = log.first("sensor_combined")
    assert imu is not None
    body = columns(imu, "accelerometer_m_s2", 3).mean(axis=0)
    assert body == pytest.approx(_turn(_TILT).T @ _WORLD * (1, -1, -1), abs=0.02)
    assert len(body) == 3
    assert len(imu["timestamp"]) == count - 4


def test_a_sensor_without_a_position_is_in_the_air_throughout(tmp_path: Path) -> None:
    count = 240
    body = _turn(_TILT).T @ _WORLD
    table = {"time": np.arange(count) / 120.0}
    table |= {f"Euler_{a}": np.full(count, np.degrees(_TILT[i])) for i, a in enumerate("XYZ")}
    table |= {f"Acc_{a}": np.full(count, body[i]) for i, a in enumerate("XYZ")}
    table |= {f"Gyr_{a}": np.full(count, 90.0) for a in "XYZ"}
    log = open_other(_write(tmp_path / "IMU_1.csv", table))

    assert _felt_ned(log, 10) == pytest.approx(_WORLD * (1, -1, -1), abs=1e-6)
    imu = log.first("sensor_combined")
    assert imu is not None
    assert columns(imu, "gyro_rad", 3)[0] == pytest.approx(np.pi / 2.0 * np.array([1, -1, -1]))
    ((begin, end),) = flights_of(log, track_without_motors(log))
    assert end - begin == pytest.approx((count - 1) / 120.0, abs=1e-5)


def test_crazypads_accelerometer_is_in_g_without_gravity(tmp_path: Path) -> None:
    count = 200
    table = {"timestamp": np.arange(count) * 10.0, "pm.vbatMV": np.full(count, 3800.0)}
    table |= {f"motor.m{i}": np.full(count, 32767.5) for i in range(1, 5)}
    table |= {f"stateEstimate.{a}": np.zeros(count) for a in ("x", "y", "vx", "vy", "vz")}
    table |= {"stateEstimate.z": np.minimum(np.arange(count) * 0.01, 1.0)}
    felt = _WORLD / GRAVITY_M_S2 - (0.0, 0.0, 1.0)
    table |= {f"stateEstimate.a{a}": np.full(count, felt[i]) for i, a in enumerate("xyz")}
    table |= {"stateEstimate.roll": np.full(count, 20.0), "stateEstimate.yaw": np.full(count, 60.0)}
    log = open_other(_write(tmp_path / "E8_log00.csv", table))

    assert _felt_ned(log, 10) == pytest.approx(_WORLD * (1, -1, -1), abs=1e-6)
    imu = log.first("sensor_combined")
    assert imu is not None
    body = _turn(_TILT * (1, 0, 1)).T @ _WORLD
    assert columns(imu, "accelerometer_m_s2", 3)[10] == pytest.approx(body * (1, -1, -1), abs=1e-6)


@pytest.mark.parametrize(
    ("text", "said"),
    [("a,b\n1,2\n3,4\n", "no data set"), ("time,Acc_X\n1\n2\n", "2 names over 1 columns")],
)
def test_what_is_no_known_recording_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "other.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        open_other(path)


def test_stamps_that_go_back_are_refused(tmp_path: Path) -> None:
    table = _nanobench()
    table["t"][300:] -= 10.0
    with pytest.raises(InputError, match="stamps go back"):
        open_other(_write(tmp_path / "flight.csv", table))
