"""A small model of PX4's EKF2: it assumes that every pose arrives EKF2_EV_DELAY after its measurement.

`Estimator` uses the true age of every pose, so it cannot model a wrong delay. This filter works like EKF2. A
Kalman filter runs about 0.15 s behind the current time and fuses each pose at its time of arrival minus the
configured delay. An output predictor propagates the filter's state to the current time with the IMU. If the
configured delay is wrong, the filter attributes the error to velocity, tilt and accelerometer bias, and it
rejects poses beyond the gate. The estimate therefore oscillates. Gains, gates and time constants are from
PX4's defaults and `configs/px4/indoor.params`.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np
import numpy.typing as npt

from dart_flight.base.arithmetic import sum_in_order
from dart_flight.base.geometry import (
    Quaternion,
    Vec3,
    add,
    norm,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    quaternion_normalise,
    rotate,
    scale,
    subtract,
    wrap_angle,
    yaw_ned_of,
)
from dart_flight.sim.estimator import Estimator, integrate_imu, small_rotation

_Matrix = npt.NDArray[np.float64]

_TICKS: Final = 2  # ticks of 4 ms per filter step: EKF2_PREDICT_US 10000 at 250 Hz
_STEP_S: Final = 0.004 * _TICKS
_PREDICT_S: Final = 0.01
_DELAY_MAX_S: Final = 0.2  # EKF2_DELAY_MAX; if EKF2_EV_DELAY is longer, EKF2_EV_DELAY applies instead
_REACH_S: Final = 0.1  # a pose that is this much older than the filter's state is not fused
_ACCELERATION_M_S2, _RATE_RAD_S, _BIAS_M_S3 = 0.35, 0.015, 0.003  # EKF2_ACC_NOISE, GYR_NOISE, ACC_B_NOISE
_POSITION_M, _YAW_RAD = 0.01, 0.02  # EKF2_EVP_NOISE, EKF2_EVA_NOISE
_POSITION_GATE, _YAW_GATE = 5.0, 2.6  # EKF2_EVP_GATE and EKF2_HDG_GATE, in standard deviations
_RESET_AFTER_S: Final = 1.0  # if no pose is within the gate for this time, the position is reset
_INVALID_AFTER_S: Final = 5.0  # EKF2_NOAID_TOUT: after this time without a pose, the estimate is invalid
_BIAS_MOST_M_S2: Final = 0.4  # EKF2_ABL_LIM
_BIAS_LEARNT_BELOW_M_S2, _BIAS_MEMORY_S = 25.0, 0.5  # EKF2_ABL_ACCLIM, EKF2_ABL_TAU
_OUTPUT_S: Final = 0.25  # EKF2_TAU_POS, EKF2_TAU_VEL
_START_SD: Final = np.repeat((0.01, 0.05, 0.02, 0.05), 3)  # of position, velocity, tilt and bias
_NO_BIAS: Final = (0.0, 0.0, 0.0)  # the filter's own bias (FRD) is already subtracted
_P, _V, _R, _B = (slice(3 * i, 3 * i + 3) for i in range(4))


class DelayedFilter:
    """A filter that assumes the same age for every arriving pose, and writes an estimator's state.

    Args:
        estimator: the filter writes this estimator's state, so do not call the estimator's own `predict`,
            `correct` and `shift` any more.
        delay_s: assumed age of a pose on arrival (EKF2_EV_DELAY).
    """

    def __init__(self, estimator: Estimator, now_s: float, delay_s: float) -> None:
        self._of = estimator
        self._now_s, self._delay_s = now_s, delay_s
        # The filter runs this many steps behind the current time.
        self._behind = int(np.ceil(max(_DELAY_MAX_S, delay_s) / _PREDICT_S))
        self._at_p, self._at_v, self._at_q = estimator.position, estimator.velocity, estimator.q
        self._accelerometer_bias: Vec3 = (0.0, 0.0, 0.0)  # FRD
        self._covariance: _Matrix = np.diag(_START_SD**2)
        self._steps: deque[tuple[float, Vec3, Vec3]] = deque()  # end time, mean specific force, mean rate
        self._outputs: deque[tuple[Vec3, Vec3, Quaternion]] = deque()  # outputs at the end of each step
        self._poses: deque[tuple[float, Vec3, Quaternion | None]] = deque()  # with assumed times
        self._ticks: list[tuple[Vec3, Vec3]] = []
        self._turn: Vec3 = (0.0, 0.0, 0.0)  # rate that corrects the output's attitude, rad/s
        self._off_v: Vec3 = (0.0, 0.0, 0.0)  # integrated errors of the output
        self._off_p: Vec3 = (0.0, 0.0, 0.0)
        self._fused_s = now_s
        self._strongest_m_s2 = 0.0

    def predict(self, t_s: float, specific_force_frd: Vec3, rate_frd: Vec3, dt_s: float) -> None:
        """Advance the output predictor by an IMU tick to `t_s`; in every second tick, also run the filter."""
        self._now_s = t_s
        if not self._of.updates:
            return
        if t_s - self._fused_s > _INVALID_AFTER_S:
            self._of.ok = False
        self._of.rate = rate_frd
        f = subtract(specific_force_frd, self._accelerometer_bias)
        self._of.position, self._of.velocity, self._of.q = integrate_imu(
            self._of.position, self._of.velocity, self._of.q, f, add(rate_frd, self._turn), dt_s, _NO_BIAS
        )
        self._ticks.append((specific_force_frd, rate_frd))
        if len(self._ticks) < _TICKS:
            return
        forces, rates = zip(*self._ticks, strict=True)
        self._ticks.clear()
        self._steps.append((t_s, _mean(forces), _mean(rates)))
        self._outputs.append((self._of.position, self._of.velocity, self._of.q))
        if len(self._steps) > self._behind:
            self._step(*self._steps.popleft())
            self._follow(self._outputs.popleft())

    def correct(self, t_s: float, position_ned: Vec3, q: Quaternion | None) -> None:
        """Queue a pose that arrives now; like EKF2, ignore its true time `t_s`."""
        self._of.updates += 1
        if self._of.updates == 1:
            self._of.position, self._of.q = position_ned, q or self._of.q
            self._at_p, self._at_q = self._of.position, self._of.q
        self._poses.append((self._now_s - self._delay_s - 0.5 * _STEP_S, position_ned, q))
        self._of.ok = self._of.ok or (
            self._of.updates > 50 and self._now_s - self._fused_s < _INVALID_AFTER_S
        )

    def shift(self, by_ned: Vec3) -> None:
        """Shift the position in one step, like a reset of EKF2."""
        self._of.resets += 1
        self._of.position, self._at_p = add(self._of.position, by_ned), add(self._at_p, by_ned)
        self._outputs = deque((add(p, by_ned), v, q) for p, v, q in self._outputs)
        self._poses = deque((t, add(p, by_ned), q) for t, p, q in self._poses)

    # -- the filter, in the past --

    def _step(self, t_s: float, specific_force_frd: Vec3, rate_frd: Vec3) -> None:
        f = subtract(specific_force_frd, self._accelerometer_bias)
        self._strongest_m_s2 = max(norm(f), self._strongest_m_s2 * (1.0 - _STEP_S / _BIAS_MEMORY_S))
        self._at_p, self._at_v, self._at_q = integrate_imu(
            self._at_p, self._at_v, self._at_q, f, rate_frd, _STEP_S, _NO_BIAS
        )
        self._grow(f)
        pose = None
        while self._poses and self._poses[0][0] <= t_s:
            pose = self._poses.popleft()
        if pose is not None and t_s - pose[0] < _REACH_S:
            self._fuse(t_s, pose[1], None if pose[2] is None else yaw_ned_of(pose[2]))

    def _grow(self, f: Vec3) -> None:
        body = np.array([rotate(self._at_q, axis) for axis in ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0))]).T
        x, y, z = rotate(self._at_q, f)
        step = np.eye(12)
        step[_P, _V] = _STEP_S * np.eye(3)
        # Rotating the estimate by r changes the specific force by r x f.
        step[_V, _R] = -_STEP_S * np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        step[_V, _B] = -_STEP_S * body
        grown = _STEP_S * np.repeat((0.0, _ACCELERATION_M_S2, _RATE_RAD_S, _BIAS_M_S3), 3)
        self._covariance = step @ self._covariance @ step.T + np.diag(grown**2)

    def _fuse(self, t_s: float, position_ned: Vec3, yaw_ned: float | None) -> None:
        if yaw_ned is not None:
            turned = wrap_angle(yaw_ned - yaw_ned_of(self._at_q))
            self._correct_by(8, turned, _YAW_RAD, _YAW_GATE)
        away = subtract(position_ned, self._at_p)
        sd = np.sqrt(np.diag(self._covariance)[:3] + _POSITION_M**2)
        near = [abs(away[axis]) <= _POSITION_GATE * sd[axis] for axis in range(3)]
        if near[2]:
            self._correct_by(2, away[2], _POSITION_M)
        if near[0] and near[1]:
            self._fused_s = t_s
            self._correct_by(0, position_ned[0] - self._at_p[0], _POSITION_M)
            self._correct_by(1, position_ned[1] - self._at_p[1], _POSITION_M)
        elif t_s - self._fused_s > _RESET_AFTER_S:
            self._fused_s = t_s
            self._jump_to(position_ned)

    def _correct_by(self, state: int, innovation: float, noise: float, gate: float = np.inf) -> None:
        p = self._covariance
        variance = p[state, state] + noise**2
        if innovation**2 > gate**2 * variance:
            return
        gain = p[:, state] / variance
        if self._strongest_m_s2 > _BIAS_LEARNT_BELOW_M_S2:
            gain[_B] = 0.0
        joseph = np.eye(12)
        joseph[:, state] -= gain
        self._covariance = joseph @ p @ joseph.T + noise**2 * np.outer(gain, gain)
        d = [float(one) for one in gain * innovation]
        self._at_p = add(self._at_p, (d[0], d[1], d[2]))
        self._at_v = add(self._at_v, (d[3], d[4], d[5]))
        turn = quaternion_from_rotation_vector((d[6], d[7], d[8]))
        self._at_q = quaternion_normalise(quaternion_multiply(turn, self._at_q))
        x, y, z = add(self._accelerometer_bias, (d[9], d[10], d[11]))
        self._accelerometer_bias = (_bounded(x), _bounded(y), _bounded(z))

    def _jump_to(self, position_ned: Vec3) -> None:
        """Reset the horizontal position to a pose; the queued poses stay unchanged."""
        by = (position_ned[0] - self._at_p[0], position_ned[1] - self._at_p[1], 0.0)
        waiting = self._poses
        self.shift(by)
        self._poses = waiting
        p = self._covariance
        for axis in (0, 1):
            p[axis, :] = p[:, axis] = 0.0
            p[axis, axis] = _POSITION_M**2

    # -- the output predictor, at the current time --

    def _follow(self, then: tuple[Vec3, Vec3, Quaternion]) -> None:
        """Correct the outputs towards the filter's state; `then` is the output stored at the state's time."""
        p, v, q = then
        self._turn = scale(small_rotation(self._at_q, q), -0.5 / (self._behind * _STEP_S))
        gain = _STEP_S / _OUTPUT_S
        off_v, off_p = subtract(self._at_v, v), subtract(self._at_p, p)
        self._off_v, self._off_p = add(self._off_v, off_v), add(self._off_p, off_p)
        by_v = add(scale(off_v, gain), scale(self._off_v, 0.1 * gain * gain))
        by_p = add(scale(off_p, gain), scale(self._off_p, 0.1 * gain * gain))
        self._outputs = deque((add(p, by_p), add(v, by_v), q) for p, v, q in self._outputs)
        self._of.position, self._of.velocity = add(self._of.position, by_p), add(self._of.velocity, by_v)


def _mean(vectors: tuple[Vec3, ...]) -> Vec3:
    x, y, z = (sum_in_order(axis) / len(vectors) for axis in zip(*vectors, strict=True))
    return (x, y, z)


def _bounded(bias_m_s2: float) -> float:
    return max(-_BIAS_MOST_M_S2, min(_BIAS_MOST_M_S2, bias_m_s2))
