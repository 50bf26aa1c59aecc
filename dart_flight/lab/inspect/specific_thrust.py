"""Specific thrust and drag of a vehicle of which nothing is known, fitted from its own log."""

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
# At speed a vehicle changes its thrust and back within the time of a contact: contacts last 50 to 180 ms,
# and motors that lag by 30 to 50 ms follow within 100 ms. Two motor outputs in such a change are the least
# that shows it; with fewer it may lie between two of them, and a line through them be off by all of it.
_THRUST_CHANGES_S = 0.1
THRUST_KNOWN_HZ = 2.0 / _THRUST_CHANGES_S
_JITTER = 1.5  # periods: longer than that a motor output is missing
_FAST_M_S = 99.0


class SpecificThrust(msgspec.Struct):
    """Thrust over mass at full command and the curve's factor.

    `held_out_percent` is the error of the thrust on stretches that were not used for the fit.
    """

    full_m_s2: float
    model_factor: float
    battery_exponent: float
    reference_v: float | None
    windows: int
    held_out_percent: float
    said: str


def fit_specific_thrust(track: Track, vehicle: VehicleConfig) -> SpecificThrust | str:
    """Specific thrust over the motor commands, from the quiet stretches of a flight.

    Returns:
        The curve, or why there is none.
    """
    lag = vehicle.thrust.motor_lag_s
    points = quiet_points(track, 1.0, lag)
    said = "slow flight"
    if len(points.force) < MIN_POINTS:
        slow, points = points, quiet_points(track, 1.0, lag, _FAST_M_S)
        said = "flight at any speed: what speed does to the propellers is in the residual"
        if len(points.force) < MIN_POINTS:
            return (
                f"{len(points.force)} quiet half seconds, needs at least {MIN_POINTS}; rejected: "
                f"{format_rejected(slow.rejected) or 'none'}"
            )
    error, best = best_fit(points, vehicle.thrust.square_share)
    problem = fit_problem(error)
    if problem:
        return f"fitted to {len(points.force)} half seconds of {said}, but {problem}"
    curve = best(points)
    return SpecificThrust(
        full_m_s2=curve.full * points.motors,
        model_factor=curve.factor,
        battery_exponent=curve.exponent,
        reference_v=curve.reference,
        windows=len(points.force),
        held_out_percent=100.0 * error,
        said=said,
    )


def is_thrust_known(track: Track, curve: SpecificThrust | None, t_s: float) -> bool:
    """Whether the thrust is known around a moment, on the log's clock.

    There has to be a curve, and motor outputs so close to one another that no change of it fits between two.
    """
    if curve is None:
        return False
    before = int(np.searchsorted(track.motor_s, t_s - _THRUST_CHANGES_S, side="right")) - 1
    after = int(np.searchsorted(track.motor_s, t_s + _THRUST_CHANGES_S))
    if before < 0 or after >= len(track.motor_s):
        return False
    return not _is_too_far(float(np.diff(track.motor_s[before : after + 1]).max()))


def are_motors_slow(track: Track) -> bool:
    """Whether the thrust is not known between a log's motor outputs, as a rule."""
    return len(track.motor_s) < 2 or _is_too_far(float(np.median(np.diff(track.motor_s))))


def _is_too_far(apart_s: float) -> bool:
    """Whether the thrust is not known between two motor outputs."""
    return apart_s * THRUST_KNOWN_HZ >= _JITTER


def fit_drag(track: Track, flying: list[tuple[float, float]]) -> float:
    """Drag in 1/s: horizontal specific force across the thrust against the velocity; wind is not known.

    Half-second means over the whole flight, robust; 0 where the flight is too slow to tell.
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
