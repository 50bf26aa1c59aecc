"""An independent rigid body with guards against one wall, integrated to 1e-10 by scipy.

It uses rotation matrices in the wall's frame (X outward, Y along, Z = X x Y), and nothing of `contact.body`.
The plant uses quaternions in NED.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]


class Body(NamedTuple):
    """A vehicle: SI units; guards and inertia along its own axes (forward, left, up)."""

    mass: float
    inertia: Array  # (3,)
    out: float
    along: float
    height: float
    friction_share: float
    vertical_lever: float


class Law(NamedTuple):
    """Coefficients of the point law and the sign of the vertical force."""

    k: float
    f: float
    mu: float
    nu: float
    vertical_sign: float


def _cross_matrix(w: Array) -> Array:
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def guards(body: Body) -> tuple[Array, Array]:
    """Return the guard points (8, 3) and the points at which friction acts, in the body's axes."""
    points = [
        (turn @ np.array([body.out, side * body.along]))
        for turn in (np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1)))
        for side in (1, -1)
    ]
    at = np.array([[x, y, body.height] for x, y in points])
    return at, body.friction_share * at


def wrench(body: Body, law: Law, x: Array, v: Array, r: Array, w: Array) -> tuple[Array, Array, float]:
    """Return force and torque about the centre of mass in the wall's frame, and the normal force.

    Args:
        body, law: constants.
        x: centre of mass; its first component is the distance to the surface.
        v: velocity.
        r: rotation matrix, body's axes to the wall's frame.
        w: angular velocity, wall's frame.
    """
    at, friction_at = guards(body)
    levers, rub_levers, turning = at @ r.T, friction_at @ r.T, _cross_matrix(w).T
    depth_rate = (v + levers @ turning)[:, 0]
    normal = np.maximum(0.0, -(0.5 * law.k * (x[0] + levers[:, 0]) + 0.5 * law.f * depth_rate))
    push, rub = np.zeros_like(levers), np.zeros_like(levers)
    push[:, 0] = normal
    rub[:, 1] = -law.mu * normal * (v + rub_levers @ turning)[:, 1]
    force = (push + rub).sum(axis=0)
    torque = (np.cross(levers, push) + np.cross(rub_levers, rub)).sum(axis=0)
    total = float(normal.sum())
    if total > 0.0:
        lift = np.array([0.0, 0.0, law.vertical_sign * law.nu * total / (1.0 + total)])
        force += lift
        torque += np.cross(np.array([-body.vertical_lever, 0.0, 0.0]), lift)
    return force, torque, total


def fly(
    body: Body, law: Law, x: Array, v: Array, r: Array, w_body: Array, duration_s: float
) -> tuple[Array, Array, Array, Array]:
    """Return position, velocity, rotation and body rate after `duration_s` without gravity or thrust."""

    def slope(_: float, state: Array) -> Array:
        x, v, r, w = state[:3], state[3:6], state[6:15].reshape(3, 3), state[15:]
        force, torque, _total = wrench(body, law, x, v, r, r @ w)
        turning = (r.T @ torque - np.cross(w, body.inertia * w)) / body.inertia
        return np.concatenate((v, force / body.mass, (r @ _cross_matrix(w)).ravel(), turning))

    start = np.concatenate((x, v, r.ravel(), w_body))
    end = solve_ivp(slope, (0.0, duration_s), start, method="DOP853", rtol=1e-10, atol=1e-12, max_step=1e-3)
    y = end.y[:, -1]
    return y[:3], y[3:6], y[6:15].reshape(3, 3), y[15:]
