"""Thrust curve of the motors from the hover segments of flights (docs/force.md).

While the vehicle flies slowly and steadily its thrust is mass times the specific force along its thrust
axis, so every quiet stretch of a log is one point of the curve: commands in, force out. Whether a stretch is
quiet is judged by means over it, never by single samples: the readings of a real vehicle shake by several
m/s2 while it hovers. The curve

    T = full_n * sum over the motors of (factor u^2 + (1 - factor) u)

is linear in full_n * factor and full_n * (1 - factor). Hover alone is one operating point: it gives full_n
and says nothing of the factor, which is fitted only where climbs, descents or pay-loads spread the commands.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.base.records import (
    ActuatorSample,
    FlightMode,
    ImuSample,
    LandedState,
    OdometrySample,
    StatusSample,
)
from dart_flight.config.document import InputError
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.lab.ulog import ULogFile, battery, columns, motor_commands, open_ulog, seconds
from dart_flight.recording.reader import NothingInItError, read_log

Array = NDArray[np.float64]

WINDOW_S = 0.5
_PART_S = 0.1  # a window's parts: long beside the vibration, short beside a bump
_GROUND_MARGIN_S = 1.0  # PX4's land detector is that late; what it calls ground begins earlier
_LEAST_IMU, _LEAST_MOTOR = 10, 3  # samples of a window; default logging has motors at 10 Hz
_MOST_RATE_RAD_S = 0.6
_MOST_LATERAL_M_S2 = 1.5  # across the thrust axis: more is drag, wind or a contact
_MOST_JOLT_M_S2 = 3.0  # a part's mean away from the window's: a bump, a touch-down
_MOST_ACCELERATION_M_S2 = 1.5
_MOST_COMMAND_CHANGE = 0.06  # from the first half of a window to the second, mean over the motors
_LEAST_COMMAND, _MOST_COMMAND = 0.05, 0.98  # of any motor's mean
_MOST_SPEED_M_S = 1.5
_LEAST_POINTS = 6
_FACTOR_ERROR = 0.1  # a factor less certain than this is not taken from the flight
_LEAST_VOLTAGE_SPREAD = 0.02  # relative standard deviation
_TOPICS = (
    "sensor_combined",
    "actuator_motors",
    "actuator_outputs",
    "vehicle_local_position",
    "battery_status",
    "vehicle_land_detected",
)

# Tests of a window, in the order in which they are made, with what they mean.
TESTS = {
    "ground": "on the ground or within a second of it",
    "gap": "too few samples",
    "turning": "mean rate of turning",
    "sideways": "mean force across the thrust axis: wind, drag or a contact",
    "jolt": "a bump within the window",
    "fast": "mean speed",
    "accelerating": "change of velocity",
    "unsteady": "commands change",
    "limit": "a motor near standstill or full",
}


class Track(msgspec.Struct):
    """What the calibration needs of one flight, arrays over time in seconds; empty where not recorded."""

    source: str
    imu_s: Array
    specific_force: Array  # (n, 3), FRD, m/s2
    rate: Array  # (n, 3), rad/s
    motor_s: Array
    motors: Array  # (m, motors), 0 to 1
    velocity_s: Array
    velocity: Array  # (k, 3), m/s, NED
    voltage_s: Array
    voltage: Array
    ground: list[tuple[float, float]]  # from, to: on the ground
    notes: tuple[str, ...] = ()  # how it was read, what was left out


class Points(msgspec.Struct):
    """Quiet stretches: mean of u^2 and of u summed over the motors, force in newton, volts (nan unknown).

    Attributes:
        start_s: when each begins.
        motors: how many motors the sums go over.
        rejected: test (`TESTS`) -> how many windows it was the first to reject.
    """

    square: Array
    linear: Array
    force: Array
    volts: Array
    start_s: Array
    motors: int
    rejected: dict[str, int]

    def chosen(self, which: NDArray[np.bool_]) -> Points:
        """Some of the stretches."""
        return msgspec.structs.replace(self, **{name: getattr(self, name)[which] for name in _BY_STRETCH})


_BY_STRETCH = ("square", "linear", "force", "volts", "start_s")  # the arrays of `Points`


class ThrustCalibration(msgspec.Struct):
    """Thrust curve and how well it fits; standard errors of what was fitted, null for what was kept."""

    segments: int
    rejected: dict[str, int]  # test -> windows that it rejected
    notes: list[str]  # how the logs were read
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
        velocity_s=np.array([r.t_us * 1e-6 for r in odometry]),
        velocity=np.array([r.velocity_ned for r in odometry]).reshape(-1, 3),
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
    return track_of(open_ulog(path, _TOPICS))


def track_of(log: ULogFile) -> Track:
    """What the calibration needs, of an opened ULog.

    Raises:
        InputError: it has no IMU or no motor commands.
    """
    imu = log.first("sensor_combined")
    if imu is None:
        raise InputError("has no sensor_combined", source=log.source)
    motors, volts = motor_commands(log), battery(log)
    position, landed = log.first("vehicle_local_position"), log.first("vehicle_land_detected")
    moving = np.empty((0, 3))
    if position is not None:
        moving = np.stack([np.asarray(position[n], dtype=float) for n in ("vx", "vy", "vz")], axis=1)
    known = np.isfinite(moving).all(axis=1)
    return Track(
        source=log.source,
        imu_s=np.asarray(imu["timestamp"], dtype=float) * 1e-6,
        specific_force=columns(imu, "accelerometer_m_s2", 3),
        rate=columns(imu, "gyro_rad", 3),
        motor_s=motors.time_s,
        motors=motors.values,
        velocity_s=seconds(position)[known] if position is not None else np.empty(0),
        velocity=moving[known],
        voltage_s=volts.time_s,
        voltage=volts.volts,
        ground=ground_of(log),
        notes=tuple(
            [motors.said]
            + [volts.said] * bool(volts.said)
            + ["no vehicle_land_detected: what is on the ground is not known"] * (landed is None)
        ),
    )


def ground_of(log: ULogFile) -> list[tuple[float, float]]:
    """From, to in seconds: PX4's land detector says landed, or close to it."""
    landed = log.first("vehicle_land_detected")
    if landed is None:
        return []
    near = np.asarray(landed["landed"], dtype=bool)
    for name in ("maybe_landed", "ground_contact"):
        if name in landed:
            near = near | np.asarray(landed[name], dtype=bool)
    stamps = np.asarray(landed["timestamp"], dtype=float) * 1e-6
    return _intervals([(float(t), bool(g)) for t, g in zip(stamps, near, strict=True)])


def quiet_points(
    track: Track, mass_kg: float, lag_s: float, most_speed_m_s: float = _MOST_SPEED_M_S
) -> Points:
    """The quiet stretches of a flight, half a second each.

    Args:
        track: the flight.
        mass_kg: of the vehicle as it flew; 1 gives specific thrust.
        lag_s: of the motors; commands are moved by it.
        most_speed_m_s: a faster window is rejected.
    """
    rows: list[tuple[float, float, float, float, float]] = []
    rejected = dict.fromkeys(TESTS, 0)
    begin, end = track.imu_s[0], track.imu_s[-1]
    for start in np.arange(begin, end - WINDOW_S, WINDOW_S):
        found = _point(track, float(start), mass_kg, lag_s, most_speed_m_s)
        if isinstance(found, str):
            rejected[found] += 1
        else:
            rows.append((*found, float(start)))
    table = np.array(rows, dtype=float).reshape(-1, 5)
    square, linear, force, volts, start_s = table.T
    return Points(square, linear, force, volts, start_s, track.motors.shape[1], rejected)


def _point(
    track: Track, start: float, mass_kg: float, lag_s: float, most_speed_m_s: float
) -> tuple[float, float, float, float] | str:
    """A window's point of the curve, or the test that rejects it."""
    stop = start + WINDOW_S
    if any(a - _GROUND_MARGIN_S < stop and b + _GROUND_MARGIN_S > start for a, b in track.ground):
        return "ground"
    imu = slice(*np.searchsorted(track.imu_s, (start, stop)))
    motor = slice(*np.searchsorted(track.motor_s, (start - lag_s, stop - lag_s)))
    f, u = track.specific_force[imu], track.motors[motor]
    if len(f) < _LEAST_IMU or len(u) < _LEAST_MOTOR or not np.isfinite(u).all():
        return "gap"
    if np.linalg.norm(track.rate[imu].mean(axis=0)) > _MOST_RATE_RAD_S:
        return "turning"
    mean = f.mean(axis=0)
    if np.hypot(mean[0], mean[1]) > _MOST_LATERAL_M_S2:
        return "sideways"
    parts = np.array_split(f, round(WINDOW_S / _PART_S))
    if max(float(np.linalg.norm(part.mean(axis=0) - mean)) for part in parts) > _MOST_JOLT_M_S2:
        return "jolt"
    moving = track.velocity[slice(*np.searchsorted(track.velocity_s, (start, stop)))]
    if len(moving):
        if np.linalg.norm(moving.mean(axis=0)) > most_speed_m_s:
            return "fast"
        if np.linalg.norm(moving[-1] - moving[0]) > _MOST_ACCELERATION_M_S2 * WINDOW_S:
            return "accelerating"
    collective = u.mean(axis=1)
    half = len(collective) // 2
    if abs(collective[half:].mean() - collective[:half].mean()) > _MOST_COMMAND_CHANGE:
        return "unsteady"
    each = u.mean(axis=0)
    if each.min() < _LEAST_COMMAND or each.max() > _MOST_COMMAND:
        return "limit"
    volts = float("nan")
    if len(track.voltage):
        volts = float(np.interp(0.5 * (start + stop), track.voltage_s, track.voltage))
    return (float((u * u).sum(axis=1).mean()), float(u.sum(axis=1).mean()), float(-mass_kg * mean[2]), volts)


def said_of(rejected: dict[str, int]) -> str:
    """Which tests rejected how many windows, in words; empty where none was rejected."""
    return ", ".join(f"{count} {name} ({TESTS[name]})" for name, count in rejected.items() if count)


def _joined(parts: list[Points]) -> Points:
    rejected = {name: sum(part.rejected[name] for part in parts) for name in TESTS}
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _BY_STRETCH}
    return Points(**arrays, motors=parts[0].motors, rejected=rejected)


def calibrate_thrust(tracks: Iterable[Track], vehicle: VehicleConfig) -> ThrustCalibration:
    """Fit the thrust curve to the quiet stretches of some flights.

    Raises:
        InputError: too few quiet stretches.
    """
    tracks = list(tracks)
    mass, lag = vehicle.airframe.mass_kg, vehicle.thrust.motor_lag_s
    parts = [quiet_points(track, mass, lag) for track in tracks]
    if len({part.motors for part in parts}) > 1:
        raise InputError("logs of vehicles with different numbers of motors", source=_sources(tracks))
    p = _joined(parts)
    if len(p.force) < _LEAST_POINTS:
        raise InputError(
            f"{len(p.force)} quiet half seconds of hover, at least {_LEAST_POINTS} are needed; rejected: "
            f"{said_of(p.rejected) or 'none'}",
            source=_sources(tracks),
        )
    exponent, exponent_error, reference = _battery(p, vehicle)
    scaled = p.force
    if reference is not None and exponent > 0.0:
        scaled = p.force / (p.volts / reference) ** exponent
    full, full_error, factor, factor_error = _curve(p, scaled, vehicle)
    shape = factor * p.square + (1.0 - factor) * p.linear
    residual = scaled - full * shape
    command = p.linear / p.motors
    return ThrustCalibration(
        segments=len(p.force),
        rejected={name: count for name, count in p.rejected.items() if count},
        notes=[note for track in tracks for note in track.notes],
        full_n=full,
        full_n_error=full_error,
        model_factor=factor,
        model_factor_error=factor_error,
        battery_exponent=exponent,
        battery_exponent_error=exponent_error,
        reference_v=reference,
        hover_command=_hover_command(full, factor, mass, p.motors),
        command_range=(float(command.min()), float(command.max())),
        residual_rms_n=float(np.sqrt(np.mean(residual**2))),
        residual_worst_n=float(np.abs(residual).max()),
        residual_percent=float(100.0 * np.sqrt(np.mean(residual**2)) / p.force.mean()),
        residuals=[
            (float(a), float(b), float(c)) for a, b, c in zip(command, p.force, residual, strict=True)
        ],
    )


def _sources(tracks: list[Track]) -> str:
    return ", ".join(track.source for track in tracks)


def _hover_command(full_n: float, factor: float, mass_kg: float, motors: int) -> float:
    relative = mass_kg * GRAVITY_M_S2 / (motors * full_n)
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
    a = vehicle.thrust.square_share
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
    factor = vehicle.thrust.square_share
    shape = factor * p.square + (1.0 - factor) * p.linear
    full = float((shape * force).sum() / (shape * shape).sum())
    rest = force - full * shape
    return full, float(np.sqrt((rest @ rest) / max(1, len(force) - 1) / (shape @ shape))), factor, None
