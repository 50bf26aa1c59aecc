"""The embedded autopilot's state estimator: it integrates the IMU and is corrected by poses or GPS fixes.

With motion capture, the gains are fixed. With GPS, they come from a small Kalman filter with PX4's noise
parameters. The estimator is not a copy of EKF2, but has the same kinds of error. Poses and fixes are noisy
and late, and a clipped accelerometer causes a velocity error. With GPS, the receiver's slowly varying
position error enters the estimate, and a wrong measured velocity makes the estimate drift.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from dart_flight.base.geometry import (
    GRAVITY_M_S2,
    IDENTITY,
    Quaternion,
    Vec3,
    add,
    integrate_rate,
    quaternion_conjugate,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    quaternion_normalise,
    rotate,
    scale,
    subtract,
)
from dart_flight.sim.gps_filter import GpsFilter, GpsWeights

# Gains per pose at 100 Hz; the time constants are about 0.1 s for position and 0.2 s for velocity.
_POSITION_GAIN: Final = 0.12
_VELOCITY_GAIN: Final = 0.8
_ATTITUDE_GAIN: Final = 0.05
_HISTORY_S: Final = 0.25


class Estimator:
    """The state estimator.

    Attributes:
        position: NED, metres.
        velocity: NED, m/s.
        q: attitude, FRD to NED.
        rate: body rate, FRD, rad/s.
        ok: whether the estimate has converged.
        resets: ODOMETRY's reset counter.
        updates: number of poses or GPS fixes so far.
    """

    def __init__(self) -> None:
        self.position: Vec3 = (0.0, 0.0, 0.0)
        self.velocity: Vec3 = (0.0, 0.0, 0.0)
        self.q: Quaternion = IDENTITY
        self.rate: Vec3 = (0.0, 0.0, 0.0)
        self.ok = False
        self.resets = 0
        self._history: deque[tuple[float, Vec3, Vec3, Quaternion]] = deque()
        self.updates = 0
        self._gps: GpsFilter | None = None
        self._bias: Vec3 = (0.0, 0.0, 0.0)  # accelerometer bias, NED, m/s2

    @property
    def position_sd_m(self) -> float | None:
        """The filter's standard deviation of the horizontal position; None with motion capture."""
        return None if self._gps is None else self._gps.position_sd_m

    def predict(self, t_s: float, specific_force_frd: Vec3, rate_frd: Vec3, dt_s: float) -> None:
        """Advance the state by one IMU tick, which ends at `t_s`."""
        if not self.updates:
            return
        self.rate = rate_frd
        if self._gps is not None:
            self._gps.predict(dt_s)
        self.position, self.velocity, self.q = integrate_imu(
            self.position, self.velocity, self.q, specific_force_frd, rate_frd, dt_s, self._bias
        )
        self._history.append((t_s, self.position, self.velocity, self.q))
        while self._history[0][0] < t_s - _HISTORY_S:
            self._history.popleft()

    def shift(self, by_ned: Vec3) -> None:
        """Shift the position in one step, like a reset of an EKF."""
        self.resets += 1
        self.position = add(self.position, by_ned)
        self._history = deque((t, add(p, by_ned), v, q) for t, p, v, q in self._history)

    def turn(self, by_rad: float) -> None:
        """Turn the heading in one step, like a reset of an EKF; seen from above, clockwise is positive."""
        self.resets += 1
        turn = quaternion_from_rotation_vector((0.0, 0.0, by_rad))
        self.q = quaternion_multiply(turn, self.q)
        self._history = deque((t, p, v, quaternion_multiply(turn, q)) for t, p, v, q in self._history)

    def correct(self, t_s: float, position_ned: Vec3, q: Quaternion | None) -> None:
        """Correct the estimate with a pose measured at `t_s`, possibly some time ago; `q` may be None."""
        self.updates += 1
        if self.updates == 1 or not self._history:
            self.position, self.q = position_ned, q or self.q
            return
        then = self._at(t_s)
        if q is not None:
            self._correct_attitude(then[3], q)
        innovation = subtract(position_ned, then[1])
        self._move(scale(innovation, _POSITION_GAIN), scale(innovation, _VELOCITY_GAIN))
        self.ok = self.updates > 50

    def correct_attitude(self, t_s: float, q: Quaternion) -> None:
        """Correct the attitude; this replaces measurements of gravity and of the magnetic field.

        Keep the predictions before `t_s`: the next GPS fix may be older.
        """
        if self._history:
            then = min(reversed(self._history), key=lambda one: abs(one[0] - t_s))
            self._correct_attitude(then[3], q)
        else:
            self.q = q

    def correct_gps(self, t_s: float, position_ned: Vec3, velocity_ned: Vec3, weights: GpsWeights) -> None:
        """Correct the estimate with a fix measured at `t_s`, possibly some time ago."""
        self.updates += 1
        if self._gps is None or not self._history:
            self._gps, self._bias = GpsFilter(weights), weights.standing_bias_ned
            self.position = position_ned
            return
        then = self._at(t_s)
        away, faster = subtract(position_ned, then[1]), subtract(velocity_ned, then[2])
        gains = self._gps.correct()
        moved, pushed, learnt = (add(scale(away, by_p), scale(faster, by_v)) for by_p, by_v in gains)
        self._move(moved, pushed)
        self._bias = subtract(self._bias, learnt)
        self.ok = self.updates > 5

    def _at(self, t_s: float) -> tuple[float, Vec3, Vec3, Quaternion]:
        """Return the prediction nearest to a time; discard older ones, as measurements arrive in order."""
        history = self._history
        while len(history) > 1 and abs(history[1][0] - t_s) < abs(history[0][0] - t_s):
            history.popleft()
        return history[0]

    def _correct_attitude(self, then: Quaternion, q: Quaternion) -> None:
        twist = scale(small_rotation(then, q), _ATTITUDE_GAIN)
        self.q = quaternion_normalise(quaternion_multiply(self.q, quaternion_from_rotation_vector(twist)))

    def _move(self, by_ned: Vec3, faster_ned: Vec3) -> None:
        """Correct the state and the stored predictions, so that no error is corrected twice."""
        self.position = add(self.position, by_ned)
        self.velocity = add(self.velocity, faster_ned)
        if self._gps is None:
            faster_ned = (0.0, 0.0, 0.0)  # the gains at 100 Hz already account for the change of velocity
        (n, e, d), (vn, ve, vd) = by_ned, faster_ned
        # Written out for speed: every pose corrects every stored prediction.
        self._history = deque(
            [
                (t, (p[0] + n, p[1] + e, p[2] + d), (v[0] + vn, v[1] + ve, v[2] + vd), q)
                for t, p, v, q in self._history
            ]
        )


def integrate_imu(
    p: Vec3, v: Vec3, q: Quaternion, f: Vec3, rate: Vec3, dt_s: float, bias: Vec3
) -> tuple[Vec3, Vec3, Quaternion]:
    """Return `p`, `v` and `q` (NED) after `dt_s`, with constant specific force `f` and `rate` (FRD).

    `bias` is the accelerometer bias, NED.
    """
    q = integrate_rate(q, rate, dt_s)
    (ax, ay, az), (bx, by, bz) = rotate(q, f), bias
    ax, ay, az = ax - bx, ay - by, az - bz + GRAVITY_M_S2
    (x, y, z), (vx, vy, vz) = p, v
    h, g = dt_s, 0.5 * dt_s * dt_s
    moved = (x + (vx * h + ax * g), y + (vy * h + ay * g), z + (vz * h + az * g))
    return moved, (vx + ax * h, vy + ay * h, vz + az * h), q


def small_rotation(a: Quaternion, b: Quaternion) -> Vec3:
    """Return the rotation vector from `a` to `b`, in the axes of `a`, for a small angle."""
    w, x, y, z = quaternion_multiply(quaternion_conjugate(a), b)
    return scale((x, y, z), 2.0 if w >= 0.0 else -2.0)
