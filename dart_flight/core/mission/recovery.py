"""The recovery setpoint (paper, eq. 2, for a wall of any orientation).

    p_ref = p(t_c) + (A_n N - A_t T) force,   N = n n', T = t t'

Here t_c is the time of the peak normal force, n the wall's outward normal, t its tangent, A_n and A_t gains.
The normal force moves the setpoint away from the wall, and the friction force moves it onward along the wall.
The height is unchanged.
"""

from __future__ import annotations

from typing import Final

from dart_flight.base.geometry import Vec2, Vec3

# Flight and planner count the goal as passed once the distance to it has risen by more than its noise. The
# first moments after a contact do not count, because the direction of the motion is not yet clear.
PASSED_RISE_M: Final = 0.03
PASSED_AFTER_S: Final = 0.25


def recovery_point(
    position: Vec3,
    normal: Vec2,
    force_n: Vec2,
    alphas_m_per_n: Vec2,
    altitude_m: float,
) -> Vec3:
    """Return the recovery setpoint in the mission frame, metres.

    Args:
        position: p(t_c), position at the peak of the normal force.
        normal: outward unit normal of the wall.
        force_n: peak normal force, at least zero, and peak friction force along the tangent (n_y, -n_x).
        alphas_m_per_n: gains (A_n, A_t).
        altitude_m: z of the setpoint.
    """
    away = alphas_m_per_n[0] * max(0.0, force_n[0])
    onward = -alphas_m_per_n[1] * force_n[1]
    nx, ny = normal
    return (position[0] + away * nx + onward * ny, position[1] + away * ny - onward * nx, altitude_m)
