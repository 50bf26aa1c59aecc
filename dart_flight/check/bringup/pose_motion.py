"""Estimates of age, axes, scale and handedness of motion-capture poses.

The operator moves the vehicle by hand. Gyro and accelerometer are the reference, because they depend neither
on the room's axes nor on the cameras' clock.

Let R be the attitude (FRD to NED), f the specific force and w the body rate. If the room is rotated by A and
the marker body by B, the poses show the attitude A R B, the rate B^-1 w and the acceleration A (R f + g).
Matching the rates to the gyro therefore gives the age and B. The accelerations then give the scale and A g,
the room's vertical. A mirrored room does not change the rates, because a rate is an axial vector. But the
mirroring reverses the accelerations, so a negative correlation of the accelerations reveals a mirrored room.

Gyro and accelerometer pass through the same Gaussian filters as the poses. A convolution with the second
derivative of the Gaussian filters the noisy positions and differentiates them twice. The mean of each
acceleration is subtracted, because the accelerometer also measures gravity.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_STEP_S: Final = 0.005
_RATE_FILTER_S: Final = 0.04  # standard deviation of the Gaussian
_FORCE_FILTER_S: Final = 0.12
_LATENCY_S: Final = (-0.1, 0.5)  # search range of the latency
_COARSE_S: Final = 0.01
_GAP_S: Final = 0.1  # maximum gap between poses that is interpolated
_MIN_S: Final = 5.0  # minimum duration of comparable motion


class MotionEstimate(NamedTuple):
    """The result of `estimate_motion`.

    Attributes:
        latency_s: time of receipt of a pose minus the time at which the vehicle had this pose.
        rate_correlation: correlation of the poses' rates with the gyro's rates, after correction by
            `latency_s`, -1 to 1.
        turned_rad_s: root mean square of the gyro's rates about the axes, FRD.
        body_to_frd: rotation from the pose's body axes to the gyro's axes, 3 x 3; identity if the axes agree.
        up_room: upward vertical in the poses' frame; (0, 0, -1) if this frame is NED.
        force_correlation: correlation of the accelerations; negative if the room is mirrored.
        carried_m_s2: root mean square of the horizontal acceleration measured by the IMU.
        scale: ratio of a length in the poses to the same length measured by the accelerometer; valid only if
            the accelerations correlate.
    """

    latency_s: float
    rate_correlation: float
    turned_rad_s: tuple[float, float, float]
    body_to_frd: Array
    up_room: tuple[float, float, float]
    force_correlation: float
    carried_m_s2: float
    scale: float


class NotEnoughMotionError(ValueError):
    """The samples cannot be compared; the text names the missing data."""


def estimate_motion(
    pose_s: Array, position: Array, q_body: Array, imu_s: Array, rate_frd: Array, force_frd: Array
) -> MotionEstimate:
    """Estimate how poses relate to the gyro and accelerometer readings of the same motion.

    Args:
        pose_s: time at which each pose was received, on the IMU's clock, seconds, (n,).
        position: positions in the poses' frame, metres, (n, 3).
        q_body: attitudes, body to the poses' frame, (n, 4).
        imu_s: stamps of the IMU's samples, seconds, (m,).
        rate_frd: body rates, rad/s, (m, 3).
        force_frd: accelerometer readings, m/s2, (m, 3).

    Raises:
        NotEnoughMotionError: the poses and the IMU samples overlap for too short a time.
    """
    pose_s, unique = np.unique(pose_s, return_index=True)
    position, q_body = position[unique], _continuous(q_body[unique])
    imu_s, unique = np.unique(imu_s, return_index=True)
    rate_frd, force_frd = rate_frd[unique], force_frd[unique]
    reach_s = 4.0 * _FORCE_FILTER_S
    if len(pose_s) < 10 or len(imu_s) < 10:
        raise NotEnoughMotionError("too few poses or IMU samples arrived")
    start = max(pose_s[0], imu_s[0] + _LATENCY_S[1]) + reach_s
    end = min(pose_s[-1], imu_s[-1] + _LATENCY_S[0]) - reach_s
    if end - start < _MIN_S:
        raise NotEnoughMotionError(f"poses and IMU samples overlap for only {max(0.0, end - start):.1f} s")
    grid = np.arange(pose_s[0], pose_s[-1], _STEP_S)
    whole = _without_gaps(grid, pose_s, reach_s) & (grid >= start) & (grid <= end)
    if whole.sum() * _STEP_S < _MIN_S:
        raise NotEnoughMotionError("the poses have too many gaps")
    turned = _rates_of(grid, _resample(grid, pose_s, q_body))
    pose_rate = _smooth(turned, _RATE_FILTER_S)[whole]
    times = grid[whole]
    imu_grid = np.arange(imu_s[0], imu_s[-1], _STEP_S)
    gyro = _smooth(_resample(imu_grid, imu_s, rate_frd), _RATE_FILTER_S)

    def gyro_at(latency_s: float) -> Array:
        return _resample(times - latency_s, imu_grid, gyro)

    latency_s = _best_latency(pose_rate, gyro_at)
    reference = gyro_at(latency_s)
    body_to_frd = _rotation_between(pose_rate, reference)
    correlation = _correlation(pose_rate @ body_to_frd.T, reference)

    force = _resample(grid - latency_s, imu_s, force_frd)
    attitude = _resample(grid, pose_s, q_body)
    frd_to_room = _matrices(attitude) @ body_to_frd.T
    by_imu = _smooth(np.einsum("nij,nj->ni", frd_to_room, force), _FORCE_FILTER_S)[whole]
    by_pose = _second_derivative(_resample(grid, pose_s, position), _FORCE_FILTER_S)[whole]
    mean_force = by_imu.mean(axis=0)
    up = mean_force / max(1e-9, float(np.linalg.norm(mean_force)))
    by_imu, by_pose = by_imu - mean_force, by_pose - by_pose.mean(axis=0)
    power = float((by_imu**2).sum())
    # The poses' acceleration has most of the noise, so regress it on the IMU's acceleration.
    scale = float((by_imu * by_pose).sum()) / max(1e-9, power)
    sideways = by_imu - np.outer(by_imu @ up, up)
    turned_rad_s = np.sqrt((reference**2).mean(axis=0))
    return MotionEstimate(
        latency_s,
        correlation,
        (float(turned_rad_s[0]), float(turned_rad_s[1]), float(turned_rad_s[2])),
        body_to_frd,
        (float(up[0]), float(up[1]), float(up[2])),
        _correlation(by_imu, by_pose),
        math.sqrt(float((sideways**2).sum(axis=1).mean())),
        abs(scale),
    )


def heading_offset_deg(pose_s: Array, q_body: Array, attitude_s: Array, q_frd: Array) -> float | None:
    """Return the median of the vehicle's heading minus the poses' heading, degrees.

    The result is None if the poses and the attitudes do not overlap.

    Args:
        pose_s: times at which the vehicle had the poses, seconds, (n,).
        q_body: attitudes of the poses, (n, 4).
        attitude_s: stamps of the vehicle's attitudes, seconds, (m,), increasing.
        q_frd: the vehicle's attitudes, (m, 4).
    """
    if len(pose_s) < 2 or len(attitude_s) < 2:
        return None
    within = (attitude_s >= pose_s[0]) & (attitude_s <= pose_s[-1])
    if not within.any():
        return None
    shown = _resample(attitude_s[within], pose_s, _continuous(q_body))
    forward, own = _matrices(shown)[:, :2, 0], _matrices(q_frd[within])[:, :2, 0]
    across = forward[:, 0] * own[:, 1] - forward[:, 1] * own[:, 0]
    along = (forward * own).sum(axis=1)
    # The median of angles is undefined across a full turn, so rotate the mean direction to zero first.
    mean = math.atan2(float(across.sum()), float(along.sum()))
    apart = np.angle(np.exp(1j * (np.arctan2(across, along) - mean)))
    return math.degrees(mean + float(np.median(apart)))


def _best_latency(pose_rate: Array, gyro_at: Callable[[float], Array]) -> float:
    """Return the latency, seconds, at which a rotation of the poses' rates best matches the gyro's rates."""

    def agreement(latency_s: float) -> float:
        # Kabsch: the best inner product is the sum of the singular values, signed for a proper rotation.
        reference = gyro_at(latency_s)
        u, s, vt = np.linalg.svd(reference.T @ pose_rate)
        s[2] *= np.sign(np.linalg.det(u @ vt))
        return float(s.sum() / max(1e-12, np.linalg.norm(reference)))

    coarse = np.arange(_LATENCY_S[0], _LATENCY_S[1] + 0.5 * _COARSE_S, _COARSE_S)
    best = coarse[int(np.argmax([agreement(x) for x in coarse]))]
    step = _COARSE_S
    for _ in range(3):  # fit a parabola through three points, and repeat this with a smaller step
        before, here, after = (agreement(best + k * step) for k in (-1, 0, 1))
        curvature = before - 2.0 * here + after
        if curvature < 0.0:
            best += step * max(-1.0, min(1.0, 0.5 * (before - after) / curvature))
        step *= 0.5
    return float(best)


def _rotation_between(a: Array, b: Array) -> Array:
    """Return the proper rotation that best maps the vectors `a` to `b` (Kabsch)."""
    u, _, vt = np.linalg.svd(b.T @ a)
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt, dtype=np.float64)


def _correlation(a: Array, b: Array) -> float:
    return float((a * b).sum() / max(1e-12, math.sqrt(float((a**2).sum() * (b**2).sum()))))


def _resample(at_s: Array, times_s: Array, values: Array) -> Array:
    return np.column_stack([np.interp(at_s, times_s, column) for column in values.T])


def _without_gaps(grid: Array, times_s: Array, reach_s: float) -> NDArray[np.bool_]:
    """Return a mask of the times at least `reach_s` (half the filter's width) away from every gap."""
    whole = np.ones(len(grid), dtype=np.bool_)
    for k in np.flatnonzero(np.diff(times_s) > _GAP_S):
        whole &= (grid < times_s[k] - reach_s) | (grid > times_s[k + 1] + reach_s)
    return whole


def _continuous(q: Array) -> Array:
    """Return the quaternions with signs chosen so that consecutive quaternions are close."""
    signs = np.sign((q[1:] * q[:-1]).sum(axis=1))
    signs[signs == 0.0] = 1.0
    return np.asarray(q * np.concatenate([[1.0], np.cumprod(signs)])[:, None], dtype=np.float64)


def _normalised(q: Array) -> Array:
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True), dtype=np.float64)


def _rates_of(grid: Array, q: Array) -> Array:
    """Return the body rates of a series of attitudes: 2 conj(q) dq/dt."""
    q = _normalised(q)
    dq = np.gradient(q, grid[1] - grid[0], axis=0)
    w, v, dw, dv = q[:, :1], q[:, 1:], dq[:, :1], dq[:, 1:]
    return np.asarray(2.0 * (w * dv - dw * v - np.cross(v, dv)), dtype=np.float64)


def _matrices(q: Array) -> Array:
    w, x, y, z = _normalised(q).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _kernel(sigma_s: float) -> tuple[Array, Array]:
    steps = round(4.0 * sigma_s / _STEP_S)
    t = np.linspace(-steps * _STEP_S, steps * _STEP_S, 2 * steps + 1)
    gaussian = np.exp(-0.5 * (t / sigma_s) ** 2)
    return t, np.asarray(gaussian / gaussian.sum(), dtype=np.float64)


def _filtered(values: Array, kernel: Array) -> Array:
    return np.column_stack([np.convolve(column, kernel, mode="same") for column in values.T])


def _smooth(values: Array, sigma_s: float) -> Array:
    return _filtered(values, _kernel(sigma_s)[1])


def _second_derivative(values: Array, sigma_s: float) -> Array:
    t, gaussian = _kernel(sigma_s)
    kernel = gaussian * (t**2 / sigma_s**4 - 1.0 / sigma_s**2)
    # Scale the truncated kernel so that the derivative of a parabola is exact.
    kernel -= kernel.mean()
    kernel /= 0.5 * float((kernel * t**2).sum())
    return _filtered(values - values[0], kernel)
