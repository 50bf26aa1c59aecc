"""Fit of the motors' thrust curve to the hover segments of flights (docs/force.md).

During slow, steady flight the thrust equals the mass times the specific force along the thrust axis. Each
quiet segment of a log therefore gives one point of the curve: the commands and the force. Vibration changes
single samples in a real hover by several m/s2, so averages decide whether a segment is quiet. The curve

    T = full_n * sum over the motors of (factor u^2 + (1 - factor) u)

is linear in full_n * factor and full_n * (1 - factor). Hover is one operating point, so it determines full_n
but not the factor. The factor is fitted only if climbs, descents or payloads spread the commands.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.config.document import InputError
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.lab.track import Track

Array = NDArray[np.float64]

WINDOW_S = 0.5
_PART_S = 0.1  # length of a window's part, longer than a vibration's period and shorter than a bump
_GROUND_MARGIN_S = 1.0  # maximum delay of PX4's land detector
_MIN_IMU, _MIN_MOTOR = 10, 3  # minimum samples in a window; by default PX4 logs motors at 10 Hz
_MAX_RATE_RAD_S = 0.6
_MAX_LATERAL_M_S2 = 1.5  # limit of the mean force per kg across the thrust axis; contacts and wind exceed it
_MAX_JOLT_M_S2 = 3.0  # maximum difference between a part's mean and the window's mean; a bump exceeds it
_MAX_ACCELERATION_M_S2 = 1.5
_MAX_COMMAND_CHANGE = 0.06  # maximum change of the mean motor command between the two halves of a window
_MIN_COMMAND, _MAX_COMMAND = 0.05, 0.98  # limits of each motor's mean command
_MAX_SPEED_M_S = 1.5
MIN_POINTS = 8
_FACTOR_ERROR = 0.1  # maximum standard error of a fitted factor
_MIN_VOLTAGE_SPREAD = 0.02  # minimum relative standard deviation of the voltage for a fit of the exponent
_MIN_SPREAD_V = 1e-6  # a smaller spread counts as constant voltage
_MAX_EXPONENT = 3.0  # maximum exponent of the voltage ratio
_FOLDS = 4  # number of parts for cross-validation
_BLOCK = 5  # number of consecutive windows that are held out together (2.5 s in all)
_MAX_ERROR = 0.1  # maximum error on held-out segments, as a fraction of the thrust

# Tests of a window in their order, with the reason for rejection.
TESTS = {
    "ground": "the vehicle is on the ground, or within 1 s of take-off or landing",
    "gap": "too few samples",
    "turning": "the vehicle turns too fast on average",
    "sideways": "the mean force across the thrust axis is too large: wind, drag or a contact",
    "jolt": "the window contains a bump",
    "fast": "the mean speed is too high",
    "accelerating": "the velocity changes too much",
    "unsteady": "the commands change too much",
    "limit": "a motor is near standstill or near full command",
}


class Points(msgspec.Struct):
    """Mean values of quiet segments, each a point of the thrust curve; arrays with one entry per segment.

    Attributes:
        square, linear: sums of u^2 and of u over the motors' commands u.
        force, volts: thrust, N, and battery voltage, V; the voltage is NaN if unknown.
        start_s: start of each segment.
        motors: number of motors that are added up in `square` and `linear`.
        rejected: test (`TESTS`) -> number of windows that failed this test and passed the earlier tests.
    """

    square: Array
    linear: Array
    force: Array
    volts: Array
    start_s: Array
    motors: int
    rejected: dict[str, int]

    def chosen(self, which: NDArray[np.bool_]) -> Points:
        return msgspec.structs.replace(self, **{name: getattr(self, name)[which] for name in _BY_STRETCH})


_BY_STRETCH = ("square", "linear", "force", "volts", "start_s")  # names of the arrays in `Points`


class ThrustCalibration(msgspec.Struct):
    """A thrust curve and its quality of fit. A standard error is None if the value was not fitted."""

    segments: int
    rejected: dict[str, int]  # test -> number of rejected windows
    notes: list[str]  # remarks on the logs
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
    residuals: list[tuple[float, float, float]]  # per segment: command, force, force - curve(command)


def quiet_points(
    track: Track, mass_kg: float, lag_s: float, most_speed_m_s: float = _MAX_SPEED_M_S
) -> Points:
    """Return the quiet segments of a flight, half a second each.

    Args:
        mass_kg: mass of the vehicle in this flight; a mass of 1 kg gives the specific thrust.
        lag_s: lag of the motors; the commands are delayed by this time.
        most_speed_m_s: upper limit of a window's mean speed.
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
    """Return a window's point of the curve, or the test that rejects the window."""
    stop = start + WINDOW_S
    if any(a - _GROUND_MARGIN_S < stop and b + _GROUND_MARGIN_S > start for a, b in track.ground):
        return "ground"
    imu = slice(*np.searchsorted(track.imu_s, (start, stop)))
    motor = slice(*np.searchsorted(track.motor_s, (start - lag_s, stop - lag_s)))
    f, u = track.specific_force[imu], track.motors[motor]
    if len(f) < _MIN_IMU or len(u) < _MIN_MOTOR or not np.isfinite(u).all():
        return "gap"
    if np.linalg.norm(track.rate[imu].mean(axis=0)) > _MAX_RATE_RAD_S:
        return "turning"
    mean = f.mean(axis=0)
    if np.hypot(mean[0], mean[1]) > _MAX_LATERAL_M_S2:
        return "sideways"
    parts = np.array_split(f, round(WINDOW_S / _PART_S))
    if max(float(np.linalg.norm(part.mean(axis=0) - mean)) for part in parts) > _MAX_JOLT_M_S2:
        return "jolt"
    moving = track.velocity[slice(*np.searchsorted(track.position_s, (start, stop)))]
    moving = moving[np.isfinite(moving).all(axis=1)]
    if len(moving):
        if np.linalg.norm(moving.mean(axis=0)) > most_speed_m_s:
            return "fast"
        if np.linalg.norm(moving[-1] - moving[0]) > _MAX_ACCELERATION_M_S2 * WINDOW_S:
            return "accelerating"
    collective = u.mean(axis=1)
    half = len(collective) // 2
    if abs(collective[half:].mean() - collective[:half].mean()) > _MAX_COMMAND_CHANGE:
        return "unsteady"
    each = u.mean(axis=0)
    if each.min() < _MIN_COMMAND or each.max() > _MAX_COMMAND:
        return "limit"
    volts = float("nan")
    if len(track.voltage):
        volts = float(np.interp(0.5 * (start + stop), track.voltage_s, track.voltage))
    return (float((u * u).sum(axis=1).mean()), float(u.sum(axis=1).mean()), float(-mass_kg * mean[2]), volts)


def format_rejected(rejected: dict[str, int]) -> str:
    return ", ".join(f"{count} {name} ({TESTS[name]})" for name, count in rejected.items() if count)


def _joined(parts: list[Points]) -> Points:
    rejected = {name: sum(part.rejected[name] for part in parts) for name in TESTS}
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _BY_STRETCH}
    return Points(**arrays, motors=parts[0].motors, rejected=rejected)


class Curve(msgspec.Struct):
    """A thrust curve with its standard errors; the error of a value that was not fitted is None.

    The thrust is the sum over the motors of

        full * (factor u^2 + (1 - factor) u) * (volts / reference)^exponent

    Without a reference voltage, the voltage term is 1.
    """

    full: float
    full_error: float
    factor: float
    factor_error: float | None
    exponent: float
    exponent_error: float | None
    reference: float | None

    def by_volts(self, p: Points) -> Array:
        return (
            np.ones(len(p.force)) if self.reference is None else (p.volts / self.reference) ** self.exponent
        )

    def force(self, p: Points) -> Array:
        shape: Array = self.factor * p.square + (1.0 - self.factor) * p.linear
        return self.full * shape * self.by_volts(p)


def fit_curve(p: Points, factor: float, exponent: float | None, *, fit_factor: bool = False) -> Curve:
    """Fit the voltage exponent, assuming `factor`; then fit the curve, whose reference is the mean voltage.

    Args:
        factor: value to use if the factor is not fitted, or if the points do not determine it.
        exponent: exponent of the voltage, or None to fit the exponent if the voltage varies. If the voltage
            is unknown, the exponent has no effect.
        fit_factor: whether to fit the factor. A result outside 0 to 1 is clipped and has no standard error.
    """
    reference = float(p.volts.mean()) if np.isfinite(p.volts).all() else None
    exponent_error = None
    if exponent is None:
        exponent = 0.0
        if reference is not None and p.volts.std() > _MIN_SPREAD_V:
            shape = factor * p.square + (1.0 - factor) * p.linear
            x, y = np.log(p.volts / reference), np.log(np.maximum(p.force, 1e-3) / np.maximum(shape, 1e-6))
            dx = x - x.mean()
            exponent = float((dx * y).sum() / (dx * dx).sum())
            rest = y - y.mean() - exponent * dx
            exponent_error = float(np.sqrt((rest @ rest) / max(1, len(x) - 2) / (dx @ dx)))
            exponent = min(max(exponent, 0.0), _MAX_EXPONENT)
    curve = Curve(1.0, 0.0, factor, None, exponent, exponent_error, reference)
    force = p.force / curve.by_volts(p)
    if fit_factor:
        design = np.stack([p.square, p.linear], axis=1)
        solution, _, rank, _ = np.linalg.lstsq(design, force, rcond=None)
        full = float(solution.sum())
        if rank == 2 and full > 0.0:
            found = float(solution[0] / full)
            curve.factor = min(max(found, 0.0), 1.0)
            if curve.factor == found:
                rest = force - design @ solution
                covariance = np.linalg.inv(design.T @ design) * (rest @ rest) / max(1, len(force) - 2)
                # Gradient of the factor with respect to the two solved terms: (1 - factor, -factor) / full.
                g = np.array([1.0 - found, -found]) / full
                curve.full, curve.full_error = full, float(np.sqrt(covariance.sum()))
                curve.factor_error = float(np.sqrt(g @ covariance @ g))
                return curve
    shape = curve.factor * p.square + (1.0 - curve.factor) * p.linear
    curve.full = float((shape * force).sum() / (shape * shape).sum())
    rest = force - curve.full * shape
    curve.full_error = float(np.sqrt((rest @ rest) / max(1, len(force) - 1) / (shape @ shape)))
    return curve


def best_fit(points: Points, square_share: float) -> tuple[float, Callable[[Points], Curve]]:
    """Return the cross-validation error of the best kind of curve, and the function that fits this kind.

    A kind of curve uses or ignores the voltage, and fits the factor or assumes `square_share` for it.
    """
    known = bool(np.isfinite(points.volts).all())
    choices = [
        _fitter(square_share, fitted, by_volts)
        for by_volts in ((False, True) if known else (False,))
        for fitted in (False, True)
    ]
    return min(((_held_out(points, fit), fit) for fit in choices), key=lambda scored: scored[0])


def fit_problem(error: float) -> str:
    """Return why a curve with this `_held_out` error is rejected; empty if the error is small enough."""
    if error <= _MAX_ERROR:
        return ""
    return f"the error on held-out segments is {100.0 * error:.0f} %, limit {100.0 * _MAX_ERROR:.0f} %"


def _fitter(factor: float, fitted: bool, by_volts: bool) -> Callable[[Points], Curve]:
    def fit(p: Points) -> Curve:
        curve = fit_curve(p, factor, None if by_volts else 0.0, fit_factor=fitted)
        # The median ignores a single window with an undetected bump.
        curve.full *= float(np.median(p.force / np.maximum(curve.force(p), 1e-6)))
        return curve

    return fit


def _held_out(points: Points, fit: Callable[[Points], Curve]) -> float:
    """Return the root mean square error on held-out segments, as a fraction of the mean thrust."""
    part = (np.arange(len(points.force)) // _BLOCK) % min(_FOLDS, max(2, len(points.force) // _BLOCK))
    squares = []
    for fold in np.unique(part):
        train, test = points.chosen(part != fold), points.chosen(part == fold)
        if len(train.force):
            squares.append((fit(train).force(test) - test.force) ** 2)
    return float(np.sqrt(np.concatenate(squares).mean()) / points.force.mean())


def calibrate_thrust(tracks: Iterable[Track], vehicle: VehicleConfig) -> ThrustCalibration:
    tracks = list(tracks)
    mass, lag = vehicle.airframe.mass_kg, vehicle.thrust.motor_lag_s
    parts = [quiet_points(track, mass, lag) for track in tracks]
    if len({part.motors for part in parts}) > 1:
        raise InputError(
            "the vehicles of these logs have different numbers of motors", source=_sources(tracks)
        )
    p = _joined(parts)
    if len(p.force) < MIN_POINTS:
        raise InputError(
            f"{len(p.force)} quiet segments of 0.5 s in hover, but {MIN_POINTS} are needed; rejected: "
            f"{format_rejected(p.rejected) or 'none'}",
            source=_sources(tracks),
        )
    problem = fit_problem(best_fit(p, vehicle.thrust.square_share)[0])
    if problem:
        raise InputError(
            f"the thrust fit to {len(p.force)} segments of 0.5 s is rejected: {problem}; verify the mass, "
            "and the type of the motor outputs (the motor_outputs finding of `check`)",
            source=_sources(tracks),
        )
    share, kept = vehicle.thrust.square_share, vehicle.estimation.battery.exponent
    flat = not p.volts.std() >= _MIN_VOLTAGE_SPREAD * p.volts.mean()
    curve = fit_curve(p, share, kept if flat else None, fit_factor=True)
    if curve.factor_error is None or curve.factor_error >= _FACTOR_ERROR:  # the factor is undetermined
        curve = fit_curve(p, share, kept if flat else None)
    residual = (p.force - curve.force(p)) / curve.by_volts(p)
    command = p.linear / p.motors
    return ThrustCalibration(
        segments=len(p.force),
        rejected={name: count for name, count in p.rejected.items() if count},
        notes=[note for track in tracks for note in track.notes],
        full_n=curve.full,
        full_n_error=curve.full_error,
        model_factor=curve.factor,
        model_factor_error=curve.factor_error,
        battery_exponent=curve.exponent,
        battery_exponent_error=curve.exponent_error,
        reference_v=curve.reference,
        hover_command=_hover_command(curve.full, curve.factor, mass, p.motors),
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
