"""The pseudo-inverse that PX4 allocates with: computed once per airframe, with NumPy (`allocation` uses it).

PX4 builds the effectiveness of the motors from their places and yaw torques (CA_ROTOR*), takes the
pseudo-inverse and scales its columns: roll and pitch by the larger of both (the root of twice the mean
square), yaw by its largest entry, lift to a mean of one (`ControlAllocationPseudoInverse`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dart_flight.config.vehicle import Motor, effectiveness

_SCALE_DIGITS = 4  # a quadrotor's 0.7071, with which every recorded flight has flown
_SHAPE_DIGITS = 9  # what is beyond is rounding of the inverse


def scaled_mix(motors: Sequence[Motor]) -> tuple[float, list[tuple[float, float, float, float]]]:
    """The largest entry of roll and pitch; each motor's (roll, pitch, yaw, lift), the first two over it."""
    mix = np.linalg.pinv(np.array(effectiveness(motors)))
    size = np.abs(mix) > 1e-6
    scale = [float(np.sqrt(2.0 * (mix[:, i] ** 2).sum() / size[:, i].sum())) for i in (0, 1)]
    level = mix[:, :2] / max(scale)
    yaw, lift = mix[:, 2] / np.abs(mix[:, 2]).max(), mix[:, 3] / mix[:, 3].mean()
    largest = float(np.abs(level).max())
    shape = np.column_stack((level / largest, yaw, lift)).round(_SHAPE_DIGITS)
    rows = [(float(r), float(p), float(y), float(u)) for r, p, y, u in shape]
    return round(largest, _SCALE_DIGITS), rows
