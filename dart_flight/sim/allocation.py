"""Control allocation: how much of roll, pitch, yaw and lift each motor gives, as PX4's pseudo-inverse has it.

PX4 builds the effectiveness of the motors from their places and yaw torques (CA_ROTOR*), takes the
pseudo-inverse and scales its columns: roll and pitch by the larger of both (the root of twice the mean
square), yaw by its largest entry, lift to a mean of one (`ControlAllocationPseudoInverse`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dart_flight.config.vehicle import Motor, effectiveness

Array = NDArray[np.float64]

_SCALE_DIGITS = 4  # a quadrotor's 0.7071, with which every recorded flight has flown
_SHAPE_DIGITS = 9  # what is beyond is rounding of the inverse


class Allocation:
    """Shares of the thrust of each motor.

    Args:
        motors: of the airframe, which can be turned about every axis (`config.vehicle.configuration`).
    """

    def __init__(self, motors: Sequence[Motor]) -> None:
        mix = np.linalg.pinv(np.array(effectiveness(motors)))
        size = np.abs(mix) > 1e-6
        scale = [float(np.sqrt(2.0 * (mix[:, i] ** 2).sum() / size[:, i].sum())) for i in (0, 1)]
        level = mix[:, :2] / max(scale)
        yaw, lift = mix[:, 2] / np.abs(mix[:, 2]).max(), mix[:, 3] / mix[:, 3].mean()
        largest = float(np.abs(level).max())
        self._largest = round(largest, _SCALE_DIGITS)
        shape = np.column_stack((level / largest, yaw, lift)).round(_SHAPE_DIGITS)
        self._rows = [(float(r), float(p), float(y), float(u)) for r, p, y, u in shape]
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
