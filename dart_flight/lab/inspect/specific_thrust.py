"""Specific thrust and drag of an unknown vehicle, fitted to the vehicle's own log."""

from __future__ import annotations

import msgspec
import numpy as np

from dart_flight.config.vehicle import VehicleConfig
from dart_flight.lab.calibrate.thrust_curve import (
    MIN_POINTS,
    best_fit,
    fit_problem,
    format_rejected,
    quiet_points,
)
from dart_flight.lab.track import Track

_MAX_DRAG_PER_S = 1.0
# Within a contact (50 to 180 ms), the thrust of a fast vehicle may change and return, because its motors
# follow commands in 100 ms. Resolving such a change needs at least two motor outputs in 100 ms.
_THRUST_CHANGES_S = 0.1
THRUST_KNOWN_HZ = 2.0 / _THRUST_CHANGES_S
_JITTER = 1.5  # if an interval between motor outputs has more periods, an output is missing
_FAST_M_S = 99.0


class SpecificThrust(msgspec.Struct):
    """Thrust over mass at full command, with the other parameters of the thrust curve.

    `held_out_percent` is the error of the thrust on held-out segments. `said` describes the fitted segments.
    """

    full_m_s2: float
    model_factor: float
    battery_exponent: float
    reference_v: float | None
    windows: int
    held_out_percent: float
    said: str


def fit_specific_thrust(track: Track, vehicle: VehicleConfig) -> SpecificThrust | str:
    """Fit the specific thrust to the quiet segments of a flight, or return why there is no curve."""
    lag = vehicle.thrust.motor_lag_s
    points = quiet_points(track, 1.0, lag)
    source = "slow flight"
    if len(points.force) < MIN_POINTS:
        slow, points = points, quiet_points(track, 1.0, lag, _FAST_M_S)
        source = "slow and fast flight, so the residual includes the effect of speed on the propellers"
        if len(points.force) < MIN_POINTS:
            return (
                f"{len(points.force)} quiet segments of 0.5 s, but {MIN_POINTS} are needed; rejected: "
                f"{format_rejected(slow.rejected) or 'none'}"
            )
    error, best = best_fit(points, vehicle.thrust.square_share)
    problem = fit_problem(error)
    if problem:
        return f"the fit to {len(points.force)} segments of 0.5 s ({source}) is rejected: {problem}"
    curve = best(points)
    return SpecificThrust(
        full_m_s2=curve.full * points.motors,
        model_factor=curve.factor,
        battery_exponent=curve.exponent,
        reference_v=curve.reference,
        windows=len(points.force),
        held_out_percent=100.0 * error,
        said=source,
    )


def is_thrust_known(track: Track, curve: SpecificThrust | None, t_s: float) -> bool:
    """Return whether the thrust is known around a time on the log's clock.

    This requires a curve, and motor outputs that are logged often enough to resolve a change of the thrust.
    """
    if curve is None:
        return False
    before = int(np.searchsorted(track.motor_s, t_s - _THRUST_CHANGES_S, side="right")) - 1
    after = int(np.searchsorted(track.motor_s, t_s + _THRUST_CHANGES_S))
    if before < 0 or after >= len(track.motor_s):
        return False
    return not _is_too_far(float(np.diff(track.motor_s[before : after + 1]).max()))


def are_motors_slow(track: Track) -> bool:
    """Return whether a log has too few motor outputs per second to interpolate the thrust between them."""
    return len(track.motor_s) < 2 or _is_too_far(float(np.median(np.diff(track.motor_s))))


def _is_too_far(apart_s: float) -> bool:
    return apart_s * THRUST_KNOWN_HZ >= _JITTER


def fit_drag(track: Track, flying: list[tuple[float, float]]) -> float:
    """Fit the drag, 1/s: the horizontal specific force across the thrust axis divided by the velocity.

    The fit is robust, ignores wind, and uses half-second means over the whole flight. If the flight is too
    slow, the drag is 0.
    """
    if not track.attitude_s.size or not track.position_s.size:
        return 0.0
    across = track.to_ned(track.specific_force * (1.0, 1.0, 0.0))[:, :2]
    pairs = []
    for begin, end in flying:
        for start in np.arange(begin, end - 0.5, 0.5):
            inside = slice(*np.searchsorted(track.imu_s, (start, start + 0.5)))
            moving = np.searchsorted(track.position_s, start + 0.25)
            if inside.stop - inside.start < 10 or moving >= len(track.position_s):
                continue
            velocity = track.velocity[moving, :2]
            speed = float(np.hypot(*velocity))
            if speed > 1.0:
                pairs.append((-float(across[inside].mean(axis=0) @ velocity) / speed, speed))
    if len(pairs) < MIN_POINTS:
        return 0.0
    table = np.array(pairs)
    return float(np.clip(np.median(table[:, 0] / table[:, 1]), 0.0, _MAX_DRAG_PER_S))
