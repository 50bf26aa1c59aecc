"""The recovery setpoint (paper, eq. 2, for a wall of any orientation).

    p_ref = p(t_c) + (A_n N - A_t T) force,   N = n n', T = t t'

Here t_c is the time of the peak normal force, n the wall's outward normal, t its tangent, A_n and A_t gains.
The normal force moves the setpoint away from the wall, and the friction force moves the setpoint onward along
the wall. The height is unchanged. The core uses the equation with the measured peaks, the planner with the
predicted peaks.
"""

from __future__ import annotations

from typing import Final

from dart_flight.base.arithmetic import Number
from dart_flight.base.geometry import Vec2

# Flight and planner regard the goal as passed once its distance has risen by `PASSED_RISE_M`, above noise.
# The first moments after a contact do not count, because the direction of the motion is not yet clear.
PASSED_RISE_M: Final = 0.03
PASSED_AFTER_S: Final = 0.25


def recovery_offset(force_n: tuple[Number, Number], alphas_m_per_n: Vec2) -> tuple[Number, Number]:
    """Return p_ref - p(t_c) along the wall's normal and its tangent (n_y, -n_x), metres.

    `force_n` is the peak normal force and the signed peak friction force, `alphas_m_per_n` is (A_n, A_t).
    """
    return alphas_m_per_n[0] * force_n[0], -alphas_m_per_n[1] * force_n[1]


def recovery_point(
    position: tuple[Number, Number], normal: Vec2, force_n: tuple[Number, Number], alphas_m_per_n: Vec2
) -> tuple[Number, Number]:
    """Return the horizontal recovery setpoint, mission frame, m, for the arguments of `recovery_offset`.

    `position` is p(t_c), `normal` the wall's outward unit normal.
    """
    away, onward = recovery_offset(force_n, alphas_m_per_n)
    nx, ny = normal
    return position[0] + away * nx + onward * ny, position[1] + away * ny - onward * nx
