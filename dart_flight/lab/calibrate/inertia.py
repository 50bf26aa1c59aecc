"""Estimate of the inertia about the three axes from a vehicle's rotation in flight (docs/torque.md).

Over a short window the motors' torque changes the rates:

    change of w = (1/J) integral of (motors - w x J w) dt + drift

The motors' torque follows from their commands through the thrust curve, their lag, their positions and the
propellers' drag. If the rate change of each window is plotted over the window's integral, the slope is
therefore 1/J. The rates have errors from the gyro and from disturbances, and the torques have errors from
motor behaviour between the recorded commands. If all errors are assigned to the rates, the fit gives the
upper bound of J; if they are assigned to the torques, it gives the lower bound. The estimate lies between the
two bounds, and its interval contains both.

The rates at a window's ends are averages over some samples, because a controller responds to the noise of a
single sample. The fit tries several lags of the motors and keeps the lag that leaves the least variance
unexplained. If the torques about an axis are too small, or the two bounds differ too much, the axis gets no
estimate.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.config.document import InputError
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.lab.track import Track

Array = NDArray[np.float64]

AXES = ("roll", "pitch", "yaw")
WINDOW_S = 0.1
_END_SAMPLES = 3  # number of samples averaged on each side of a window's end
_MIN_HZ = 50.0  # minimum rate of gyro and motor samples; a lower rate misses the controller's action
_MAX_GAP_S = 0.05
_MAX_SIDEWAYS_M_S2 = 5.0  # limit of the mean force per kg across the thrust axis; contacts exceed this limit
_MIN_WINDOWS = 40
_MAX_ERROR = 0.1  # maximum relative standard error of a slope
_MAX_RATIO = 1.3  # maximum ratio of the inertia's upper bound to its lower bound
_GROUND_MARGIN_S = 1.0
_LAGS = (0.4, 0.55, 0.7, 0.85, 1.0, 1.2, 1.45, 1.75, 2.1)  # tried multiples of the configured lag
_SIGMA_95 = 1.96
_MEDIAN_OF_SQUARE = 0.4549  # median of the square of a standard normal variable
_ROUNDS = 3  # number of fits; the gyroscopic term of a fit uses the inertia of the previous fit


class AxisInertia(msgspec.Struct):
    """Inertia about one axis, kg m2.

    Attributes:
        axis: roll, pitch or yaw, about the axes forward, right and down. value, low, high: the estimate and
        its 95 % interval, or None if the flights do not determine the inertia.
        torque_nm: standard deviation, over all windows, of a window's mean motor torque.
        rate_change_rad_s: standard deviation, over all windows, of the rate change in a window.
        explained: fraction of the variance of the rate's change that the motors explain.
        refused: the reason why there is no value; empty if there is a value.
    """

    axis: str
    value: float | None
    low: float | None
    high: float | None
    torque_nm: float
    rate_change_rad_s: float
    explained: float
    refused: str = ""


class InertiaCalibration(msgspec.Struct):
    """Inertia about the three axes, and the data from which it was estimated.

    Attributes:
        windows: number of windows of `WINDOW_S` seconds.
        axes: roll, pitch, yaw.
        motor_lag_s: motor lag for which the motors explain the largest part of the rate changes.
        drift_rad_s2: angular acceleration without motor torque, for example because of an offset centre of
            mass.
        notes: remarks on the logs.
    """

    windows: int
    axes: list[AxisInertia]
    motor_lag_s: float
    drift_rad_s2: tuple[float, float, float]
    notes: list[str]

    @property
    def inertia_kg_m2(self) -> tuple[float | None, float | None, float | None]:
        x, y, z = (axis.value for axis in self.axes)
        return (x, y, z)


class _Windows(msgspec.Struct):
    """The rate changes and the integrals that cause them; one row per window, without overlap.

    Attributes:
        change: change of the rates, (n, 3).
        impulse: integral of the motors' torque, (n, 3).
        products: integral of (wy wz, wz wx, wx wy), (n, 3).
        duration: (n,), s.
        noise: variance of a rate change due to the gyro's white noise, (3,).
    """

    change: Array
    impulse: Array
    products: Array
    duration: Array
    noise: Array


def calibrate_inertia(tracks: Iterable[Track], vehicle: VehicleConfig) -> InertiaCalibration:
    """Fit the moments of inertia to the rotations in flights of one vehicle.

    `vehicle` supplies the thrust curve, the motors' positions and a first value of the motors' lag.
    """
    tracks = list(tracks)
    for track in tracks:
        _refuse_unsuited(track, len(vehicle.airframe.motors))
    best: tuple[float, float, list[AxisInertia], tuple[float, float, float], int] | None = None
    for factor in _LAGS:
        lag_s = factor * vehicle.thrust.motor_lag_s
        parts = [_windows(track, vehicle, lag_s) for track in tracks]
        joined = _joined(parts)
        if len(joined.duration) < _MIN_WINDOWS:
            raise InputError(
                f"{len(joined.duration)} windows of {WINDOW_S:g} s in flight without a contact, but at least "
                f"{_MIN_WINDOWS} are needed",
                source=", ".join(t.source for t in tracks),
            )
        axes, drift, unexplained = _fit(joined, vehicle)
        if best is None or unexplained < best[0]:
            best = (unexplained, lag_s, axes, drift, len(joined.duration))
    assert best is not None
    _, lag_s, axes, drift, count = best
    if all(axis.value is None for axis in axes):
        raise InputError(
            "no axis is excited: " + "; ".join(f"{axis.axis}: {axis.refused}" for axis in axes),
            source=", ".join(t.source for t in tracks),
        )
    notes = [note for track in tracks for note in track.notes]
    return InertiaCalibration(count, axes, lag_s, drift, notes)


def _joined(parts: list[_Windows]) -> _Windows:
    return _Windows(
        np.concatenate([p.change for p in parts]),
        np.concatenate([p.impulse for p in parts]),
        np.concatenate([p.products for p in parts]),
        np.concatenate([p.duration for p in parts]),
        np.mean([p.noise for p in parts], axis=0),
    )


def _refuse_unsuited(track: Track, motors: int) -> None:
    if track.motors.shape[1:] != (motors,):
        raise InputError(
            f"the log has {track.motors.shape[1]} motors, but the configured airframe has {motors}",
            source=track.source,
        )
    for what, stamps in (("gyro", track.imu_s), ("motor commands", track.motor_s)):
        rate = (len(stamps) - 1) / max(stamps[-1] - stamps[0], 1e-6)
        if rate < _MIN_HZ:
            more = "; set bit 4 (high rate) of SDLOG_PROFILE" if track.source.endswith(".ulg") else ""
            raise InputError(
                f"{what} at {rate:.0f} Hz, at least {_MIN_HZ:.0f} Hz is needed{more}", source=track.source
            )


def _windows(track: Track, vehicle: VehicleConfig, lag_s: float) -> _Windows:
    """Return the windows in which the vehicle is in the air and has no contact."""
    t, w = track.imu_s, track.rate
    torque = _motor_torque(track, vehicle, lag_s)
    step = np.diff(t)
    impulse, products = _integral(torque, step), _integral(np.roll(w, -1, 1) * np.roll(w, -2, 1), step)
    size = 2 * _END_SAMPLES + 1
    kernel = np.full(size, 1.0 / size)
    smooth = np.stack([np.convolve(w[:, i], kernel, mode="same") for i in range(3)], axis=1)
    # Average the integrals over the same samples as the rates, so that both have the same filter.
    impulse, products = (
        np.stack([np.convolve(x[:, i], kernel, mode="same") for i in range(3)], axis=1)
        for x in (impulse, products)
    )
    across = [np.convolve(track.specific_force[:, i], kernel, mode="same") for i in range(2)]
    sideways = np.hypot(*across)
    stride = max(1, round(WINDOW_S / float(np.median(step))))
    rows: list[tuple[int, int]] = []
    for a in range(_END_SAMPLES, len(t) - stride - _END_SAMPLES, stride):
        b = a + stride
        from_s, to_s = t[a - _END_SAMPLES], t[b + _END_SAMPLES]
        if any(x - _GROUND_MARGIN_S < to_s and y + _GROUND_MARGIN_S > from_s for x, y in track.ground):
            continue
        inside = slice(a - _END_SAMPLES, b + _END_SAMPLES)
        if step[inside].max() > _MAX_GAP_S or sideways[inside].max() > _MAX_SIDEWAYS_M_S2:
            continue
        motors = track.motors[slice(*np.searchsorted(track.motor_s, (from_s, to_s)))]
        if len(motors) < WINDOW_S * _MIN_HZ * 0.8 or motors.max() >= 0.999 or motors.min() <= 0.001:
            continue
        rows.append((a, b))
    # Second differences measure the gyro's noise, because motion hardly contributes to them.
    bend = w[2:] - 2.0 * w[1:-1] + w[:-2]
    noise = np.median(bend**2, axis=0) / _MEDIAN_OF_SQUARE / 6.0 * 2.0 / size
    ends = np.array(rows, dtype=int).reshape(-1, 2)
    first, last = ends[:, 0], ends[:, 1]
    return _Windows(
        smooth[last] - smooth[first],
        impulse[last] - impulse[first],
        products[last] - products[first],
        t[last] - t[first],
        noise,
    )


def _motor_torque(track: Track, vehicle: VehicleConfig, lag_s: float) -> Array:
    """Return the motors' torque at the gyro's stamps, (n, 3), FRD."""
    held = np.clip(np.searchsorted(track.motor_s, track.imu_s, side="right") - 1, 0, None)
    commands = track.motors[held]
    lagged = np.empty_like(commands)
    value = commands[0]
    steps = np.diff(track.imu_s, prepend=track.imu_s[0])
    left = np.exp(-steps / max(lag_s, 1e-4))
    for i, (command, keep) in enumerate(zip(commands, left, strict=True)):
        # A command acts from its stamp to the next one, so it acted during the step that ends here.
        value = command + (value - command) * keep
        lagged[i] = value
    thrust = np.array(vehicle.thrust.forces_n(lagged.ravel().tolist())).reshape(lagged.shape)
    arms = np.array([(-m.y_m, m.x_m, m.yaw_torque_per_thrust_m) for m in vehicle.airframe.motors])
    return np.asarray(thrust @ arms, dtype=float)


def _integral(values: Array, step: Array) -> Array:
    parts = 0.5 * (values[1:] + values[:-1]) * step[:, None]
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(parts, axis=0)])


def _fit(
    windows: _Windows, vehicle: VehicleConfig
) -> tuple[list[AxisInertia], tuple[float, float, float], float]:
    """Return inertias, drift, and the sum over the axes of the unexplained fraction of the variance."""
    inertia = np.array(vehicle.airframe.inertia_kg_m2)
    axes: list[AxisInertia] = []
    drift = np.zeros(3)
    unexplained = 0.0
    for _ in range(_ROUNDS):
        axes, unexplained = [], 0.0
        # About x: J w' = motors - (Jz - Jy) wy wz; the other axes follow cyclically.
        gyroscopic = (np.roll(inertia, -2) - np.roll(inertia, -1)) * windows.products
        for i, name in enumerate(AXES):
            axis, drift[i], rest = _line(name, windows, windows.impulse[:, i] - gyroscopic[:, i], i)
            axes.append(axis)
            unexplained += rest
            if axis.value is not None:
                inertia[i] = axis.value
    return axes, (float(drift[0]), float(drift[1]), float(drift[2])), unexplained


def _line(name: str, windows: _Windows, impulse: Array, i: int) -> tuple[AxisInertia, float, float]:
    duration = float(windows.duration.mean())
    y = windows.change[:, i] - windows.change[:, i].mean()
    x = impulse - impulse.mean()
    n, xx, xy, yy = len(x), float(x @ x), float(x @ y), float(y @ y)
    explained = xy * xy / (xx * yy) if xx > 0.0 and yy > 0.0 else 0.0
    axis = AxisInertia(
        axis=name,
        value=None,
        low=None,
        high=None,
        torque_nm=math.sqrt(xx / n) / duration,
        rate_change_rad_s=math.sqrt(yy / n),
        explained=explained,
    )
    drift = float(windows.change[:, i].mean()) / duration
    if xy <= 0.0:
        axis.refused = f"no excitation: torques of {axis.torque_nm:.4f} N m cause no rotation"
        return axis, drift, 1.0
    drift -= xy / xx * float(impulse.mean()) / duration
    # The upper bound assigns all errors to the rates; the lower bound assigns errors beyond the gyro's noise
    # to the torques.
    noise = min(n * float(windows.noise[i]), yy - xy * xy / xx)
    most, least = xx / xy, xy / (yy - noise)
    error = math.sqrt((1.0 - explained) / max(1, n - 2) / explained)
    value = math.sqrt(most * least)
    if error > _MAX_ERROR:
        axis.refused = (
            f"too little excitation: torques of {axis.torque_nm:.4f} N m leave an error of "
            f"{100.0 * error:.0f} %, limit {100.0 * _MAX_ERROR:.0f} %"
        )
    elif most > _MAX_RATIO * least:
        axis.refused = (
            f"the motors explain only {100.0 * explained:.0f} % of the angular-rate changes, so the inertia "
            f"is uncertain ({least:.4f} to {most:.4f} kg m2): fly in still air with larger inputs, and check "
            "motor order and positions"
        )
    else:
        axis.value = value
        axis.low, axis.high = least / (1.0 + _SIGMA_95 * error), most * (1.0 + _SIGMA_95 * error)
    return axis, drift, 1.0 - explained
