"""Published flight recordings that are no ULogs, in the shape of one, as `feel` takes them.

Four data sets (docs/results/real_data.md), told apart by their columns:

- NanoBench: Crazyflie 2.1, one CSV a flight;
- nanodrone-sysid-benchmark: Crazyflie 2.1 Brushless, one CSV or parquet file a flight; its accelerometer is
  logged turned into the room's frame by the attitude beside it, and is turned back;
- Quadrotor Dead Reckoning with Multiple Inertial Sensors: Xsens DOT sensors on a DJI Phantom 4, `*IMU_n.csv`;
  no motors, and the whole file is in the air;
- CrazyPAD: Crazyflie 2.1 with damaged propellers, `motor_data`, one CSV a flight; accelerometer as in the
  second, no gyro, and of the attitude no pitch: it is taken for zero, so that a tilt is felt as a force.

All of them have x forward, y left, z up, which becomes PX4's forward, right, down and north, east, down.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.config.document import InputError
from dart_flight.recording.ulog import ULogFile

Array = NDArray[np.float64]
Table = dict[str, Array]

_FLIP = np.array([1.0, -1.0, -1.0])  # y left, z up <-> y right, z down
_OFF_THE_FLOOR_M = 0.15
_MOTORS_OFF = 0.02  # command
_GAP_TICKS = 3.0
_LINK_LOST_S = 1.0
_PWM = 65535.0
_STRAIGHT = 1e-5  # g and rad/s: the data set has six decimals
_UNEVEN = 1e-3  # share of a step: the stamps are not quite evenly spaced


class Flown(msgspec.Struct):
    """One recording: x forward, y left, z up; n samples at the times of the IMU.

    Attributes:
        time_s: stamps.
        specific_force: (n, 3), m/s², body.
        rate: (n, 3), rad/s, body.
        attitude: (n, 4), from body to world, w first.
        motors: (n, motors) commands from 0 to 1; None where they were not recorded.
        position: (n, 3), m, world; None where it is not known in the attitude's frame.
        velocity: (n, 3), m/s, world; likewise.
        volts: (n,) of the battery; None where it was not recorded.
    """

    time_s: Array
    specific_force: Array
    rate: Array
    attitude: Array
    motors: Array | None = None
    position: Array | None = None
    velocity: Array | None = None
    volts: Array | None = None


def open_other(path: str | Path) -> ULogFile:
    """A recording of one of the data sets above.

    Raises:
        InputError: it cannot be read, or its columns are not those of a known data set.
    """
    path = Path(path)
    table = _read_table(path)
    for needed, read in _READERS:
        if needed <= set(table):
            return as_ulog(str(path), read(table))
    raise InputError("has the columns of no data set that is known", source=str(path))


def as_ulog(source: str, flown: Flown) -> ULogFile:
    """The topics that `feel` reads.

    With a position the vehicle counts as landed within 0.15 m of the lowest one, and with its motors off;
    without, no land detector was logged, and the whole recording counts as flight.

    Raises:
        InputError: fewer than two samples, or stamps that go back.
    """
    t = flown.time_s - (flown.time_s[0] if len(flown.time_s) else 0.0)
    steps = np.diff(t)
    if len(t) < 2 or steps.min() < 0.0:
        raise InputError("stamps go back, or there are none", source=source)
    tick = float(np.median(steps))
    stamp = {"timestamp": np.round(t * 1e6).astype(np.int64) + 1}  # 0 is no stamp
    q = flown.attitude / np.linalg.norm(flown.attitude, axis=1, keepdims=True)
    topics: dict[str, dict[str, Any]] = {
        "sensor_combined": {
            **stamp,
            **_fields("accelerometer_m_s2", flown.specific_force * _FLIP),
            **_fields("gyro_rad", flown.rate * _FLIP),
            "accelerometer_integral_dt": np.full(len(t), tick * 1e6),
        },
        "vehicle_attitude": {**stamp, **_fields("q", q * np.array([1.0, *_FLIP]))},
    }
    if flown.motors is not None:
        topics["actuator_motors"] = {**stamp, **_fields("control", np.clip(flown.motors, 0.0, 1.0))}
    if flown.volts is not None:
        topics["battery_status"] = {**stamp, "voltage_v": flown.volts}
    if flown.position is not None and flown.velocity is not None:
        names, moved = ("x", "y", "z", "vx", "vy", "vz"), (flown.position * _FLIP, flown.velocity * _FLIP)
        table = np.concatenate(moved, axis=1)
        topics["vehicle_local_position"] = {**stamp, **{n: table[:, i] for i, n in enumerate(names)}}
        height = flown.position[:, 2]
        landed = height < height.min() + _OFF_THE_FLOOR_M
        if flown.motors is not None and flown.motors.max() > _MOTORS_OFF:
            landed |= (flown.motors < _MOTORS_OFF).all(axis=1)  # an estimated height drifts
        changes = np.flatnonzero(np.concatenate(([True], landed[1:] != landed[:-1])))
        topics["vehicle_land_detected"] = {
            "timestamp": stamp["timestamp"][changes],
            "landed": landed[changes].astype(np.uint8),
        }
    lost = steps[steps > _GAP_TICKS * tick]
    return ULogFile(
        source=source,
        topics={name: {0: data} for name, data in topics.items()},
        parameters={},
        version=None,
        gaps_s=float((lost - tick).sum()),
    )


def _fields(name: str, values: Array) -> dict[str, Array]:
    return {f"{name}[{i}]": values[:, i] for i in range(values.shape[1])}


def _columns(table: Table, names: Sequence[str]) -> Array:
    return np.stack([table[n] for n in names], axis=1)


def _axes(table: Table, form: str, axes: str = "xyz") -> Array:
    return _columns(table, [form.format(a) for a in axes])


def _read_table(path: Path) -> Table:
    try:
        if path.suffix == ".parquet":
            return _read_parquet(path)
        with path.open(encoding="utf-8") as file:
            names = [n.strip() for n in file.readline().split(",")]
            rows = np.genfromtxt(file, delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read: {error}", source=str(path)) from None
    if rows.shape[1] != len(names):
        raise InputError(f"{len(names)} names over {rows.shape[1]} columns", source=str(path))
    return {n: rows[:, i] for i, n in enumerate(names)}


def _read_parquet(path: Path) -> Table:
    try:
        from pyarrow import parquet  # type: ignore[import-not-found]  # noqa: PLC0415  (no dependency)
    except ImportError:
        raise InputError("needs pyarrow: pip install pyarrow", source=str(path)) from None
    table = parquet.read_table(path).to_pydict()
    return {name: np.array(values, dtype=float) for name, values in table.items()}


def _chosen(table: Table, rows: NDArray[np.bool_]) -> Table:
    return {name: values[rows] for name, values in table.items()}


def filled_in(values: Array) -> NDArray[np.bool_]:
    """Rows (n,) that lie on a straight line between their neighbours in every column of `values` (n, k).

    They were not measured: what was lost on the radio link was interpolated, and extrapolated at the ends.
    """
    out = np.zeros(len(values), dtype=bool)
    if len(values) > 2:
        step = np.abs(np.diff(values, axis=0))[1:]
        out[1:-1] = (np.abs(np.diff(values, 2, axis=0)) < _STRAIGHT + _UNEVEN * step).all(axis=1)
        out[0], out[-1] = out[1], out[-2]
    return out


def alone(time_s: Array) -> NDArray[np.bool_]:
    """Samples (n,) with a gap on either side: where what was filled in bends, one is left."""
    gaps = np.diff(time_s) > _GAP_TICKS * np.median(np.diff(time_s))
    return np.concatenate(([True], gaps)) & np.concatenate((gaps, [True]))


def _nanobench(table: Table) -> Flown:
    measured = np.concatenate((_axes(table, "imu_acc_{}"), _axes(table, "imu_gyro_{}")), axis=1)
    table = _chosen(table, ~filled_in(measured))
    table = _chosen(table, ~alone(table["t"]))
    lost = np.flatnonzero(np.diff(table["t"]) > _LINK_LOST_S)
    if len(lost):  # nothing after it was measured
        table = _chosen(table, np.arange(len(table["t"])) <= lost[0])
    return Flown(
        time_s=table["t"],
        specific_force=_axes(table, "imu_acc_{}") * GRAVITY_M_S2,
        rate=_axes(table, "imu_gyro_{}"),
        attitude=_axes(table, "att_stateEstimate_q{}", "wxyz"),
        motors=_axes(table, "motor_motor_m{}", "1234") / _PWM,
        position=_axes(table, "p{}"),  # motion capture: the vehicle's own is lost where it tumbles
        velocity=_axes(table, "v{}"),
        volts=table["pwr_pm_vbat"],
    )


def _nanodrone(table: Table) -> Flown:
    measured = np.concatenate([_axes(table, form) for form in ("a{}", "w{}")], axis=1)
    known = np.isfinite(measured).all(axis=1) & np.isfinite(_axes(table, "q{}", "wxyz")).all(axis=1)
    known[1:] &= (measured[1:] != measured[:-1]).any(axis=1)  # what was lost is the value before it
    table = _chosen(table, known)
    attitude = _axes(table, "q{}", "wxyz")
    return Flown(
        time_s=table["t"],
        specific_force=turned_back(attitude, _axes(table, "a{}")),
        rate=_axes(table, "w{}"),
        attitude=attitude,
        motors=_axes(table, "m{}_thrust", "1234"),
        position=_axes(table, "{}"),
        velocity=_axes(table, "v{}"),
        volts=table["Vbat"],
    )


def _xsens_dot(table: Table) -> Flown:
    return Flown(
        time_s=table["time"],
        specific_force=_axes(table, "Acc_{}", "XYZ"),
        rate=np.radians(_axes(table, "Gyr_{}", "XYZ")),
        attitude=from_euler(np.radians(_axes(table, "Euler_{}", "XYZ"))),
    )


def _crazypad(table: Table) -> Flown:
    turned = np.radians(_columns(table, ("stateEstimate.roll", "stateEstimate.yaw")))
    attitude = from_euler(np.stack([turned[:, 0], np.zeros(len(turned)), turned[:, 1]], axis=1))
    felt = (_axes(table, "stateEstimate.a{}") + np.array([0.0, 0.0, 1.0])) * GRAVITY_M_S2
    return Flown(
        time_s=table["timestamp"] * 1e-3,
        specific_force=turned_back(attitude, felt),
        rate=np.zeros_like(felt),
        attitude=attitude,
        motors=_axes(table, "motor.m{}", "1234") / _PWM,
        position=_axes(table, "stateEstimate.{}"),
        velocity=_axes(table, "stateEstimate.v{}"),
        volts=table["pm.vbatMV"] * 1e-3,
    )


def turned_back(attitude: Array, world: Array) -> Array:
    """Vectors of the world in the body's frame; attitudes (n, 4) from body to world, w first."""
    w, u = attitude[:, :1], -attitude[:, 1:]
    t = 2.0 * np.cross(u, world)
    return np.asarray(world + w * t + np.cross(u, t))


def from_euler(angles: Array) -> Array:
    """Attitudes (n, 4), w first, of roll, pitch and yaw (n, 3) in rad; yaw turns first, then pitch."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(0.5 * angles).T, np.sin(0.5 * angles).T
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=1,
    )


_READERS: tuple[tuple[set[str], Callable[[Table], Flown]], ...] = (
    ({"imu_acc_x", "att_stateEstimate_qw", "motor_motor_m1"}, _nanobench),
    ({"ax", "qw", "m1_thrust", "Vbat"}, _nanodrone),
    ({"Acc_X", "Gyr_X", "Euler_X"}, _xsens_dot),
    ({"stateEstimate.ax", "stateEstimate.roll", "stateEstimate.yaw", "motor.m1"}, _crazypad),
)
