"""Thrust curve of the motors from the hover segments of flights (docs/force.md).

While the vehicle flies slowly and steadily its thrust is mass times the specific force along its thrust
axis, so every quiet stretch of a log is one point of the curve: commands in, force out. The curve

    T = full_n * sum over the motors of (factor u^2 + (1 - factor) u)

is linear in full_n * factor and full_n * (1 - factor). Hover alone is one operating point: it gives full_n
and says nothing of the factor, which is fitted only where climbs, descents or pay-loads spread the commands.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.config.document import InputError
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.geometry import GRAVITY_M_S2
from dart_flight.recording.reader import NothingInItError, read_log
from dart_flight.samples import (
    MOTOR_FULL_US,
    MOTOR_STOP_US,
    ActuatorSample,
    FlightMode,
    ImuSample,
    LandedState,
    OdometrySample,
    StatusSample,
)

Array = NDArray[np.float64]

WINDOW_S = 0.5
_MOST_RATE_RAD_S = 0.6
_MOST_LATERAL_M_S2 = 1.5  # across the thrust axis: more is drag, wind or a contact
_MOST_COMMAND_SPREAD = 0.06
_LEAST_COMMAND, _MOST_COMMAND = 0.1, 0.98
_MOST_SPEED_M_S = 1.5
_LEAST_POINTS = 6
_FACTOR_ERROR = 0.1  # a factor less certain than this is not taken from the flight
_LEAST_VOLTAGE_SPREAD = 0.02  # relative standard deviation


class Track(msgspec.Struct):
    """What the calibration needs of one flight, arrays over time in seconds; empty where not recorded."""

    source: str
    imu_s: Array
    specific_force: Array  # (n, 3), FRD, m/s2
    rate: Array  # (n, 3), rad/s
    motor_s: Array
    motors: Array  # (m, 4), 0 to 1
    speed_s: Array
    speed: Array  # m/s
    voltage_s: Array
    voltage: Array
    ground: list[tuple[float, float]]  # from, to: on the ground


class Points(msgspec.Struct):
    """Quiet stretches: mean of u^2 and of u summed over the motors, force in newton, volts (nan unknown)."""

    square: Array
    linear: Array
    force: Array
    volts: Array


class ThrustCalibration(msgspec.Struct):
    """Thrust curve and how well it fits; standard errors of what was fitted, null for what was kept."""

    segments: int
    full_n: float
    full_n_error: float
    model_factor: float
    model_factor_error: float | None
    battery_exponent: float
    battery_exponent_error: float | None
    reference_v: float | None
    hover_command: float
    command_range: tuple[float, float]
    residual_rms_n: float
    residual_worst_n: float
    residual_percent: float
    residuals: list[tuple[float, float, float]]  # command, force, force less curve


def read_track(path: str | Path) -> Track:
    """One flight: our own log (`.mcap`) or a PX4 ULog (`.ulg`).

    Raises:
        InputError: it cannot be read or lacks what is needed.
    """
    return _read_ulog(Path(path)) if Path(path).suffix.lower() == ".ulg" else _read_own(path)


def _read_own(path: str | Path) -> Track:
    records = [entry.record for entry in read_log(path).entries]
    imu = [r for r in records if isinstance(r, ImuSample)]
    motors = [r for r in records if isinstance(r, ActuatorSample)]
    odometry = [r for r in records if isinstance(r, OdometrySample)]
    status = [r for r in records if isinstance(r, StatusSample)]
    if not imu or not motors:
        raise NothingInItError("has no IMU samples or no motor commands", source=str(path))
    volts = [(r.t_us, r.battery_v) for r in status if r.battery_v is not None]
    # A landing may touch the ground half a second before PX4's land detector says so: leave it out whole.
    grounded = [
        (r.t_us * 1e-6, r.landed is LandedState.ON_GROUND or r.flight_mode is FlightMode.LAND) for r in status
    ]
    return Track(
        source=str(path),
        imu_s=np.array([r.t_us * 1e-6 for r in imu]),
        specific_force=np.array([r.specific_force_frd for r in imu]),
        rate=np.array([r.rate_frd for r in imu]),
        motor_s=np.array([r.t_us * 1e-6 for r in motors]),
        motors=np.array([r.motors for r in motors]),
        speed_s=np.array([r.t_us * 1e-6 for r in odometry]),
        speed=np.array([np.linalg.norm(r.velocity_ned) for r in odometry]),
        voltage_s=np.array([t * 1e-6 for t, _ in volts]),
        voltage=np.array([v for _, v in volts], dtype=float),
        ground=_intervals(grounded),
    )


def _intervals(states: list[tuple[float, bool]]) -> list[tuple[float, float]]:
    """Stretches in which a state holds; it holds until the next is reported."""
    out = []
    for (begin, holds), end in zip(states, [*(t for t, _ in states[1:]), np.inf], strict=True):
        if holds:
            out.append((begin, float(end)))
    return out


def _read_ulog(path: Path) -> Track:
    source = str(path)
    try:
        from pyulog import ULog  # noqa: PLC0415  (an extra)
    except ImportError:
        raise InputError("needs pyulog: pip install dart-flight[identify]", source=source) from None
    wanted = [
        "sensor_combined",
        "actuator_motors",
        "actuator_outputs",
        "vehicle_local_position",
        "battery_status",
        "vehicle_land_detected",
    ]
    try:
        log = ULog(source, wanted)
    except OSError as error:
        raise InputError(f"cannot read: {error.strerror or error}", source=source) from None
    except Exception:
        # pyulog raises whatever its parsing stumbles over.
        raise InputError("not a readable ULog", source=source) from None
    topics = {entry.name: entry.data for entry in log.data_list if entry.multi_id == 0}
    if "sensor_combined" not in topics:
        raise InputError("has no sensor_combined", source=source)
    imu = topics["sensor_combined"]
    motor_s, motors = _ulog_motors(topics, source)
    empty = np.empty(0)
    position, battery = topics.get("vehicle_local_position"), topics.get("battery_status")
    landed = topics.get("vehicle_land_detected")
    return Track(
        source=source,
        imu_s=_seconds(imu),
        specific_force=_columns(imu, "accelerometer_m_s2", 3),
        rate=_columns(imu, "gyro_rad", 3),
        motor_s=motor_s,
        motors=motors,
        speed_s=_seconds(position) if position is not None else empty,
        speed=np.hypot(np.hypot(position["vx"], position["vy"]), position["vz"])
        if position is not None
        else empty,
        voltage_s=_seconds(battery) if battery is not None else empty,
        voltage=np.asarray(battery["voltage_v"], dtype=float) if battery is not None else empty,
        ground=_intervals(
            [(float(t), bool(g)) for t, g in zip(_seconds(landed), landed["landed"], strict=True)]
        )
        if landed is not None
        else [],
    )


def _ulog_motors(topics: dict[str, Any], source: str) -> tuple[Array, Array]:
    if "actuator_motors" in topics:
        data = topics["actuator_motors"]
        return _seconds(data), np.clip(_columns(data, "control", 4), 0.0, 1.0)
    if "actuator_outputs" in topics:
        data = topics["actuator_outputs"]
        pwm = _columns(data, "output", 4)
        return _seconds(data), np.clip((pwm - MOTOR_STOP_US) / (MOTOR_FULL_US - MOTOR_STOP_US), 0.0, 1.0)
    raise InputError("has neither actuator_motors nor actuator_outputs", source=source)


def _seconds(data: Any) -> Array:
    return np.asarray(data["timestamp"], dtype=float) * 1e-6


def _columns(data: Any, name: str, count: int) -> Array:
    return np.stack([np.asarray(data[f"{name}[{i}]"], dtype=float) for i in range(count)], axis=1)


def quiet_points(track: Track, mass_kg: float, lag_s: float) -> Points:
    """The quiet stretches of a flight, half a second each.

    Args:
        track: the flight.
        mass_kg: of the vehicle as it flew.
        lag_s: of the motors; commands are moved by it.
    """
    rows = []
    begin, end = track.imu_s[0], track.imu_s[-1]
    for start in np.arange(begin, end - WINDOW_S, WINDOW_S):
        point = _point(track, float(start), mass_kg, lag_s)
        if point is not None:
            rows.append(point)
    table = np.array(rows, dtype=float).reshape(-1, 4)
    return Points(table[:, 0], table[:, 1], table[:, 2], table[:, 3])


def _point(
    track: Track, start: float, mass_kg: float, lag_s: float
) -> tuple[float, float, float, float] | None:
    stop = start + WINDOW_S
    if any(a < stop and b > start for a, b in track.ground):
        return None
    imu = slice(*np.searchsorted(track.imu_s, (start, stop)))
    motor = slice(*np.searchsorted(track.motor_s, (start - lag_s, stop - lag_s)))
    f, u = track.specific_force[imu], track.motors[motor]
    if len(f) < 10 or len(u) < 5 or not np.isfinite(u).all():
        return None
    speed = track.speed[slice(*np.searchsorted(track.speed_s, (start, stop)))]
    mean = u.mean(axis=1)
    quiet = (
        np.abs(track.rate[imu]).max() < _MOST_RATE_RAD_S
        and np.hypot(f[:, 0], f[:, 1]).mean() < _MOST_LATERAL_M_S2
        and mean.std() < _MOST_COMMAND_SPREAD
        and u.min() > _LEAST_COMMAND
        and u.max() < _MOST_COMMAND
        and (not len(speed) or speed.max() < _MOST_SPEED_M_S)
    )
    if not quiet:
        return None
    volts = float("nan")
    if len(track.voltage):
        volts = float(np.interp(0.5 * (start + stop), track.voltage_s, track.voltage))
    return (
        float((u * u).sum(axis=1).mean()),
        float(u.sum(axis=1).mean()),
        float(-mass_kg * f[:, 2].mean()),
        volts,
    )


def calibrate_thrust(tracks: Iterable[Track], vehicle: VehicleConfig) -> ThrustCalibration:
    """Fit the thrust curve to the quiet stretches of some flights.

    Raises:
        InputError: too few quiet stretches.
    """
    tracks = list(tracks)
    mass, lag = vehicle.airframe.mass_kg, vehicle.thrust.motor_lag_s
    parts = [quiet_points(track, mass, lag) for track in tracks]
    p = Points(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in Points.__struct_fields__)
    )
    if len(p.force) < _LEAST_POINTS:
        raise InputError(
            f"{len(p.force)} quiet half seconds of hover, at least {_LEAST_POINTS} are needed",
            source=", ".join(track.source for track in tracks),
        )
    exponent, exponent_error, reference = _battery(p, vehicle)
    scaled = p.force
    if reference is not None and exponent > 0.0:
        scaled = p.force / (p.volts / reference) ** exponent
    full, full_error, factor, factor_error = _curve(p, scaled, vehicle)
    shape = factor * p.square + (1.0 - factor) * p.linear
    residual = scaled - full * shape
    command = p.linear / 4.0
    return ThrustCalibration(
        segments=len(p.force),
        full_n=full,
        full_n_error=full_error,
        model_factor=factor,
        model_factor_error=factor_error,
        battery_exponent=exponent,
        battery_exponent_error=exponent_error,
        reference_v=reference,
        hover_command=_hover_command(full, factor, mass),
        command_range=(float(command.min()), float(command.max())),
        residual_rms_n=float(np.sqrt(np.mean(residual**2))),
        residual_worst_n=float(np.abs(residual).max()),
        residual_percent=float(100.0 * np.sqrt(np.mean(residual**2)) / p.force.mean()),
        residuals=[
            (float(a), float(b), float(c)) for a, b, c in zip(command, p.force, residual, strict=True)
        ],
    )


def _hover_command(full_n: float, factor: float, mass_kg: float) -> float:
    relative = mass_kg * GRAVITY_M_S2 / (4.0 * full_n)
    if factor < 1e-6:
        return relative
    b = 1.0 - factor
    return float((-b + np.sqrt(b * b + 4.0 * factor * relative)) / (2.0 * factor))


def _battery(p: Points, vehicle: VehicleConfig) -> tuple[float, float | None, float | None]:
    """Exponent of the voltage with its error, and the reference voltage: the mean over the flights."""
    kept = vehicle.estimation.battery.exponent
    if not np.isfinite(p.volts).all():
        return kept, None, None
    reference = float(p.volts.mean())
    if p.volts.std() < _LEAST_VOLTAGE_SPREAD * reference:
        return kept, None, reference
    a = vehicle.thrust.model_factor
    ratio = np.log(p.force / (a * p.square + (1.0 - a) * p.linear))
    slope, error = _line(np.log(p.volts / reference), ratio)
    return max(0.0, slope), error, reference


def _line(x: Array, y: Array) -> tuple[float, float]:
    """Slope of the least-squares line and its standard error."""
    dx = x - x.mean()
    slope = float((dx * y).sum() / (dx * dx).sum())
    rest = y - y.mean() - slope * dx
    return slope, float(np.sqrt((rest**2).sum() / max(1, len(x) - 2) / (dx * dx).sum()))


def _curve(p: Points, force: Array, vehicle: VehicleConfig) -> tuple[float, float, float, float | None]:
    """full_n and factor with their errors; the configured factor where the flights cannot tell."""
    design = np.stack([p.square, p.linear], axis=1)
    solution, _, rank, _ = np.linalg.lstsq(design, force, rcond=None)
    full = float(solution.sum())
    if rank == 2 and full > 0.0:
        rest = force - design @ solution
        covariance = np.linalg.inv(design.T @ design) * (rest @ rest) / max(1, len(force) - 2)
        factor = float(solution[0] / full)
        # d(factor) = (1 - factor, -factor) / full of the two.
        g = np.array([1.0 - factor, -factor]) / full
        factor_error = float(np.sqrt(g @ covariance @ g))
        if factor_error < _FACTOR_ERROR and 0.0 <= factor <= 1.0:
            return full, float(np.sqrt(covariance.sum())), factor, factor_error
    factor = vehicle.thrust.model_factor
    shape = factor * p.square + (1.0 - factor) * p.linear
    full = float((shape * force).sum() / (shape * shape).sum())
    rest = force - full * shape
    return full, float(np.sqrt((rest @ rest) / max(1, len(force) - 1) / (shape @ shape))), factor, None
