"""Control allocation by PX4's pseudo-inverse: the thrust of each motor for roll, pitch, yaw and lift."""

from __future__ import annotations

from collections.abc import Sequence

from dart_flight.config.vehicle import Motor
from dart_flight.sim.pseudo_inverse import scaled_mix


class Allocation:
    """Allocation of thrust to the motors, which together must control every axis."""

    def __init__(self, motors: Sequence[Motor]) -> None:
        self._largest, self._rows = scaled_mix(motors)
        self._lift = [row[3] for row in self._rows]

    def shares(self, roll: float, pitch: float, yaw: float, up: float) -> list[float]:
        """Return each motor's fraction of full thrust, from normalised torques (FRD) and collective thrust.

        If a motor saturates, the lift is reduced or raised so that the torques are achieved. If no lift
        achieves the torques, some of the returned fractions are below 0 or above 1.
        """
        largest = self._largest
        wanted = [up * u + largest * (r * roll + p * pitch) + y * yaw for r, p, y, u in self._rows]
        if min(wanted) >= 0.0 and max(wanted) <= 1.0:
            return wanted
        lift = self._lift
        down = min([(1.0 - w) / u for w, u in zip(wanted, lift, strict=True)])
        more = max([-w / u for w, u in zip(wanted, lift, strict=True)])
        shift = min(0.0, down) + max(0.0, more)
        return [w + shift * u for w, u in zip(wanted, lift, strict=True)]
