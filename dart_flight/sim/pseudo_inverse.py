"""PX4's allocation pseudo-inverse, computed once per airframe with NumPy (`allocation` uses it).

PX4 builds the effectiveness matrix of the motors from their positions and yaw torques (CA_ROTOR*). It then
computes the pseudo-inverse and scales its columns (`ControlAllocationPseudoInverse`). For each of the columns
of roll and pitch, PX4 computes sqrt(2 mean(x^2)) of the nonzero entries x. Both columns are divided by the
larger of these two values. The column of yaw is divided by its largest entry, and the column of lift by its
mean.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dart_flight.config.vehicle import Motor, effectiveness

_SCALE_DIGITS = 4  # decimals of the largest entry: 0.7071 for a quadrotor, as in every recorded flight
_SHAPE_DIGITS = 9  # decimals of the shape; further decimals are rounding errors of the inverse


def scaled_mix(motors: Sequence[Motor]) -> tuple[float, list[tuple[float, float, float, float]]]:
    """Return the largest entry of the scaled roll and pitch columns, and one row per motor.

    A row contains roll, pitch, yaw and lift; its roll and pitch are divided by the returned largest entry.
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
