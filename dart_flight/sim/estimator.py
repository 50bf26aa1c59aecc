"""The embedded autopilot's state estimator: dead reckoning on the IMU, corrected by delayed poses.

It stands where PX4 has its EKF2, with fixed gains: enough to have PX4's kinds of error (noise, delay, the
velocity error that a clipped accelerometer leaves behind), not a copy of it.
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
    advance_attitude,
    quaternion_conjugate,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    quaternion_normalise,
    rotate,
    scale,
    subtract,
)

# Per pose update at 100 Hz: about 0.1 s to follow a position error, 0.2 s for a velocity error.
_POSITION_GAIN: Final = 0.12
_VELOCITY_GAIN: Final = 0.8
_ATTITUDE_GAIN: Final = 0.05
_HISTORY_S: Final = 0.25


class Estimator:
    """Position, velocity (NED) and attitude (FRD to NED)."""

    def __init__(self) -> None:
        self.position: Vec3 = (0.0, 0.0, 0.0)
        self.velocity: Vec3 = (0.0, 0.0, 0.0)
        self.q: Quaternion = IDENTITY
        self.rate: Vec3 = (0.0, 0.0, 0.0)
        self.ok = False
        self.resets = 0  # ODOMETRY's reset counter
        self._history: deque[tuple[float, Vec3, Quaternion]] = deque()
        self._updates = 0

    def predict(self, t_s: float, specific_force_frd: Vec3, rate_frd: Vec3, dt_s: float) -> None:
        """One IMU tick ending at `t_s`."""
        if not self._updates:
            return
        self.rate = rate_frd
        self.q = quaternion_normalise(advance_attitude(self.q, rate_frd, dt_s))
        ax, ay, az = rotate(self.q, specific_force_frd)
        az += GRAVITY_M_S2
        (x, y, z), (vx, vy, vz) = self.position, self.velocity
        h, g = dt_s, 0.5 * dt_s * dt_s
        self.position = (x + (vx * h + ax * g), y + (vy * h + ay * g), z + (vz * h + az * g))
        self.velocity = (vx + ax * h, vy + ay * h, vz + az * h)
        self._history.append((t_s, self.position, self.q))
        while self._history[0][0] < t_s - _HISTORY_S:
            self._history.popleft()

    def shift(self, by_ned: Vec3) -> None:
        """Jump, as an EKF does at a reset."""
        self.resets += 1
        self.position = add(self.position, by_ned)
        self._history = deque((t, add(p, by_ned), q) for t, p, q in self._history)

    def correct(self, t_s: float, position_ned: Vec3, q: Quaternion) -> None:
        """A pose measured at `t_s`, which may lie in the past."""
        self._updates += 1
        if self._updates == 1 or not self._history:
            self.position, self.q = position_ned, q
            return
        # Poses come in the order in which they were measured: what lies before this one is done with, and the
        # few entries that are left are cheap to move.
        history = self._history
        while len(history) > 1 and abs(history[1][0] - t_s) < abs(history[0][0] - t_s):
            history.popleft()
        then = history[0]
        innovation = subtract(position_ned, then[1])
        self.position = add(self.position, scale(innovation, _POSITION_GAIN))
        self.velocity = add(self.velocity, scale(innovation, _VELOCITY_GAIN))
        error = quaternion_multiply(quaternion_conjugate(then[2]), q)
        sign = 2.0 if error[0] >= 0.0 else -2.0
        twist = scale((error[1], error[2], error[3]), sign * _ATTITUDE_GAIN)
        self.q = quaternion_normalise(quaternion_multiply(self.q, quaternion_from_rotation_vector(twist)))
        shift = scale(innovation, _POSITION_GAIN)
        # Old predictions move with the correction, so that one error is not corrected twice.
        self._history = deque((t, add(p, shift), q_then) for t, p, q_then in history)
        self.ok = self._updates > 50
