"""Control allocation: how much of roll, pitch, yaw and lift each motor gives, by PX4's pseudo-inverse."""

from __future__ import annotations

from collections.abc import Sequence

from dart_flight.config.vehicle import Motor
from dart_flight.sim.pseudo_inverse import scaled_mix


class Allocation:
    """Shares of the thrust of each motor.

    Args:
        motors: of the airframe, which can be turned about every axis (`config.vehicle.configuration`).
    """

    def __init__(self, motors: Sequence[Motor]) -> None:
        self._largest, self._rows = scaled_mix(motors)
        self._lift = [row[3] for row in self._rows]

    def shares(self, roll: float, pitch: float, yaw: float, up: float) -> list[float]:
        """Share of its full thrust that each motor is to give; where one saturates, lift gives way.

        Args:
            roll, pitch, yaw: normalised torques, FRD.
            up: normalised collective thrust.

        Returns:
            In the motors' order; below 0 or above 1 only where the torques alone ask for more than the range.
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
