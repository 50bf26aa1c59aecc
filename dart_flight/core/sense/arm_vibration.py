"""Filter that removes the vibration of the unlocked arms from the measured acceleration.

The arms have the fraction s of the mass and swing against the body: q'' = -w^2 q - 2 z w q' - a. Here q is
the displacement of the arms relative to the body, w is their natural frequency (rad/s) and z is their damping
ratio. The contact accelerates the common centre of mass by a. The IMU on the body reads a - s q''. Over one
tick T the mean of q'' is the change of q' divided by T. If a is constant over the tick, the reading is linear
in a:

    mean reading = a - s (q'(T) - q'(0)) / T,     (q, q')(T) = F (q, q')(0) + G a

F and G are the exact solution of the arms' equation over T. The filter solves the equation of the mean
reading for a. This solution is exact, and the filter is stable because s is less than 1. The force estimator
and the contact fit use the filter.
"""

from __future__ import annotations

import math
from typing import Final

from dart_flight.config.vehicle import ArmVibration

_MAX_TICKS: Final = 25  # after a longer gap in the stream, the arms have come to rest


class ArmFilter:
    """Inverse filter of the arms' vibration, for the x and y axes of a frame that does not rotate."""

    def __init__(self, arms: ArmVibration, tick_s: float) -> None:
        w, z = 2.0 * math.pi * arms.frequency_hz, arms.damping_ratio
        self._share, self._tick_s = arms.mass_fraction, tick_s
        sigma, wd = z * w, w * math.sqrt(max(1e-9, 1.0 - z * z))
        e, c, s = math.exp(-sigma * tick_s), math.cos(wd * tick_s), math.sin(wd * tick_s) / wd
        self._f11, self._f12 = e * (c + sigma * s), e * s
        self._f21, self._f22 = -e * w * w * s, e * (c - sigma * s)
        self._g1, self._g2 = -(1.0 - self._f11) / (w * w), -self._f12
        self._gain = 1.0 / (1.0 - self._share * self._g2 / tick_s)
        self._x = self._vx = self._y = self._vy = 0.0

    def reset(self) -> None:
        """Set the vibration to zero, because the lock holds the arms."""
        self._x = self._vx = self._y = self._vy = 0.0

    def add(self, ax: float, ay: float) -> tuple[float, float]:
        """Return the IMU reading, m/s2, when a contact accelerates the centre of mass by (ax, ay).

        This is the inverse of `remove`."""
        swing = self._share / self._tick_s
        out = (
            ax / self._gain - swing * (self._f21 * self._x + (self._f22 - 1.0) * self._vx),
            ay / self._gain - swing * (self._f21 * self._y + (self._f22 - 1.0) * self._vy),
        )
        self._swing(ax, ay)
        return out

    def remove(self, ax: float, ay: float, dt_s: float) -> tuple[float, float]:
        """Return the acceleration that the contact gives the centre of mass, m/s2, from an IMU reading."""
        ticks = max(1, round(dt_s / self._tick_s))
        if ticks > _MAX_TICKS:
            self.reset()
            ticks = 1
        for _ in range(ticks):
            swing = self._share / self._tick_s
            bx = self._gain * (ax + swing * (self._f21 * self._x + (self._f22 - 1.0) * self._vx))
            by = self._gain * (ay + swing * (self._f21 * self._y + (self._f22 - 1.0) * self._vy))
            self._swing(bx, by)
        return bx, by

    def _swing(self, bx: float, by: float) -> None:
        """Advance the arms by one tick, with the acceleration (`bx`, `by`) of the centre of mass."""
        self._x, self._vx = (
            self._f11 * self._x + self._f12 * self._vx + self._g1 * bx,
            self._f21 * self._x + self._f22 * self._vx + self._g2 * bx,
        )
        self._y, self._vy = (
            self._f11 * self._y + self._f12 * self._vy + self._g1 * by,
            self._f21 * self._y + self._f22 * self._vy + self._g2 * by,
        )
