"""Momentum-based observer of the external force (Tomic's form), for slow, sustained contact.

    p(t) = integral of (known force + estimate) dt,    estimate = K (m v - p)

with v the velocity that PX4 estimates, K the bandwidth in 1/s (Tomic, Ott, Haddadin, *External Wrench
Estimation, Collision Detection, and Reflex Reaction for Flying Robots*, IEEE T-RO 2017). The estimate follows
the force as a first-order low-pass of time constant 1/K. It needs no accelerometer: a bias there does not
matter, and a force that lasts is not lost in its noise; but it is as late and as smooth as PX4's velocity.
"""

from __future__ import annotations

from collections import deque

from dart_flight.base.geometry import Vec3
from dart_flight.base.records import OdometrySample

_HISTORY = 64  # ticks: the odometry is at most this late


class MomentumObserver:
    """External force in the mission frame from momentum.

    Args:
        mass_kg: of the vehicle.
        gain_per_s: K.
    """

    def __init__(self, mass_kg: float, gain_per_s: float) -> None:
        self._mass, self._gain = mass_kg, gain_per_s
        self._momentum: Vec3 | None = None
        self._history: deque[tuple[int, Vec3]] = deque(maxlen=_HISTORY)
        self._used_us = -1
        self.force: Vec3 = (0.0, 0.0, 0.0)

    def update(
        self, t_us: int, dt_s: float, known: Vec3, odometry: OdometrySample | None, velocity: Vec3
    ) -> Vec3:
        """Force in newton, mission frame, at `t_us`.

        Args:
            t_us: of the IMU's tick.
            dt_s: since the tick before.
            known: thrust, gravity and drag, mean over the tick, mission frame, newton.
            odometry: the newest; its stamp says when `velocity` was true.
            velocity: its velocity in the mission frame, m/s.
        """
        if odometry is None:
            return self.force
        if self._momentum is None:
            self._momentum = (self._mass * velocity[0], self._mass * velocity[1], self._mass * velocity[2])
            self._used_us = odometry.t_us
        p, f = self._momentum, self.force
        self._momentum = p = (
            p[0] + (known[0] + f[0]) * dt_s,
            p[1] + (known[1] + f[1]) * dt_s,
            p[2] + (known[2] + f[2]) * dt_s,
        )
        self._history.append((t_us, p))
        if odometry.t_us > self._used_us:
            self._used_us = odometry.t_us
            then = self._at(odometry.t_us)
            k, m = self._gain, self._mass
            self.force = (
                k * (m * velocity[0] - then[0]),
                k * (m * velocity[1] - then[1]),
                k * (m * velocity[2] - then[2]),
            )
        return self.force

    def _at(self, t_us: int) -> Vec3:
        """The observer's momentum at a moment of its recent past."""
        later_us, later = self._history[-1]
        for stamp, momentum in reversed(self._history):
            if stamp <= t_us:
                if later_us == stamp:
                    return momentum
                share = min(1.0, (t_us - stamp) / (later_us - stamp))
                return (
                    momentum[0] + share * (later[0] - momentum[0]),
                    momentum[1] + share * (later[1] - momentum[1]),
                    momentum[2] + share * (later[2] - momentum[2]),
                )
            later_us, later = stamp, momentum
        return later
