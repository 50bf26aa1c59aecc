"""PX4's allocation pseudo-inverse, computed once per airframe with NumPy (`allocation` uses it).

PX4 builds the effectiveness matrix of the motors from their positions and yaw torques (CA_ROTOR*). It
computes the pseudo-inverse and scales its columns (`ControlAllocationPseudoInverse`). Roll and pitch share
one scale. For each of their columns the root of twice the mean square is computed, and the larger value is
the scale. Yaw is scaled by its largest entry, and lift to a mean of one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dart_flight.config.vehicle import Motor, effectiveness

_SCALE_DIGITS = 4  # a quadrotor's 0.7071, as in every recorded flight
_SHAPE_DIGITS = 9  # further digits are rounding errors of the inverse


def scaled_mix(motors: Sequence[Motor]) -> tuple[float, list[tuple[float, float, float, float]]]:
    """Return the largest entry of roll and pitch, and each motor's scaled (roll, pitch, yaw, lift).

    The returned roll and pitch are divided by that largest entry.
    """
    mix = np.linalg.pinv(np.array(effectiveness(motors)))
    size = np.abs(mix) > 1e-6
    scale = [float(np.sqrt(2.0 * (mix[:, i] ** 2).sum() / size[:, i].sum())) for i in (0, 1)]
    level = mix[:, :2] / max(scale)
    yaw, lift = mix[:, 2] / np.abs(mix[:, 2]).max(), mix[:, 3] / mix[:, 3].mean()
    largest = float(np.abs(level).max())
    shape = np.column_stack((level / largest, yaw, lift)).round(_SHAPE_DIGITS)
    rows = [(float(r), float(p), float(y), float(u)) for r, p, y, u in shape]
    return round(largest, _SCALE_DIGITS), rows
