"""The contact law by time stepping, as in the paper: implicit Euler, complementarity at the end of a step.

With position x, velocity v, step h and the contact plane's normal n, the end of the step (marked +) satisfies

    v+ = v + h (a + sum lambda / m),   x+ = x + h v+,
    0 <= lx  complementary to  lx + k x+ + f vx+ >= 0,   ly = -mu lx vy+,   lz = -+ nu lx / (1 + lx)

(paper, Sec. IV-B). For one plane the scalar complementarity problem has the closed form
lx = max(0, -q)/(1 + g), q = k x + (k h + f)(vx + h ax), g = (k h + f) h / m. In a corner the two planes
couple, and the four cases (none, first, second, both) are enumerated.

The error is of first order in h; `contact_map` is exact. This model checks it independently, and simulates
trajectories over several contacts or under other laws of motion.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dart_flight.config.vehicle import Coefficients
from dart_flight.contact.coefficients import Array, CoefficientArrays, Rows
from dart_flight.contact.contact_map import WallContact
from dart_flight.contact.law import Onset

# Friction in a corner acts along the other plane's normal, so the normal forces are iterated until the
# sliding speeds settle.
_CORNER_ROUNDS = 60
_CORNER_TOLERANCE = 1e-13


class NormalStep(NamedTuple):
    """One step along the normal: position m, velocity m/s, force N at its end."""

    x: Array
    v: Array
    force: Array


def step_normal(
    c: CoefficientArrays, mass_kg: float, state: tuple[Array, Array], h_s: float, onset: Onset
) -> NormalStep:
    """Return one implicit Euler step along the normal of one plane.

    Args:
        c: coefficients.
        mass_kg: vehicle mass.
        state: signed distance m, and the normal velocity m/s at the end of the step without the plane,
            other accelerations included.
        h_s: step.
        onset: `touch` gives no force if the step without force would end before the plane.
    """
    x, free = state
    stiff = c.k * h_s + c.f
    force = np.maximum(-(c.k * x + stiff * free), 0.0) / (1.0 + stiff * (h_s / mass_kg))
    if onset is Onset.TOUCH:
        force = np.where(x + h_s * free < 0.0, force, 0.0)
    v = free + (h_s / mass_kg) * force
    return NormalStep(x + h_s * v, v, force)


def stepped_map(
    coefficients: CoefficientArrays,
    mass_kg: float,
    normal_m_s: ArrayLike,
    tangential_m_s: ArrayLike,
    onset: Onset,
    *,
    step_s: float,
    rows: Rows | None = None,
    acceleration_m_s2: float = 0.0,
    longest_s: float = 2.0,
) -> WallContact[Array]:
    """Return wall hits by time stepping; arguments and results as in `contact_map`, to first order.

    Every hit starts at its onset. A contact that has not ended after `longest_s` counts as never ending.

    Raises:
        ValueError: a velocity is not finite, or the step is not positive.
    """
    if not step_s > 0.0:
        raise ValueError("the step must be positive")
    c = coefficients if rows is None else coefficients.select(rows)
    vn, vt, *_ = np.broadcast_arrays(
        np.asarray(normal_m_s, dtype=float), np.asarray(tangential_m_s, dtype=float), *c
    )
    if not (np.isfinite(vn).all() and np.isfinite(vt).all()):
        raise ValueError("velocities must be finite")
    shape = vn.shape
    c = CoefficientArrays(*(np.broadcast_to(v, shape).reshape(-1) for v in c))
    v_in, slip_in = vn.reshape(-1), vt.reshape(-1)
    out = WallContact(*(np.zeros(v_in.size) for _ in WallContact._fields))
    out.normal_out_m_s[:], out.tangential_out_m_s[:] = v_in, slip_in

    index = np.flatnonzero(v_in < 0.0)  # the hits that are still in contact
    c = c.select(index)
    v, slip = v_in[index], slip_in[index]
    x = -c.f * v / c.k if onset is Onset.LCP else np.zeros_like(v)
    begun = np.zeros(index.size, dtype=bool)
    for step in range(1, math.ceil(longest_s / step_s) + 1):
        if index.size == 0:
            break
        x, v, force = step_normal(c, mass_kg, (x, v + step_s * acceleration_m_s2), step_s, onset)
        slip = slip / (1.0 + step_s * c.mu * force / mass_kg)
        begun |= force > 0.0
        ended = begun & (force == 0.0)
        _record(out, index, force, x, c.mu * force * np.abs(slip))
        out.impulse_n_s[index] += step_s * force
        out.contact_time_s[index] += np.where(force > 0.0, step_s, 0.0)
        out.normal_out_m_s[index], out.tangential_out_m_s[index] = v, slip
        # Pulled away before the first force: no contact.
        ended |= ~begun & ((v >= 0.0) | (step * step_s > longest_s))
        if ended.any():
            stays = ~ended
            index, x, v, slip, begun = index[stays], x[stays], v[stays], slip[stays], begun[stays]
            c = CoefficientArrays(*(values[stays] for values in c))
    out.contact_time_s[index] = math.inf
    peak = out.peak_normal_force_n
    nu = np.broadcast_to(coefficients.nu if rows is None else coefficients.nu[rows], shape).reshape(-1)
    out.peak_vertical_force_n[:] = nu * peak / (1.0 + peak)
    return WallContact(*(values.reshape(shape) for values in out))


def _record(out: WallContact[Array], index: Rows, force: Array, x: Array, friction: Array) -> None:
    for target, value in (
        (out.peak_normal_force_n, force),
        (out.penetration_m, -x),
        (out.peak_friction_force_n, friction),
    ):
        target[index] = np.maximum(target[index], value)


# --- trajectories ---------------------------------------------------------------------------------------


class SteppedTrajectory(NamedTuple):
    """A trajectory in the collision frame; time (n,), the others (n, 3) along X, Y, Z in SI units."""

    time_s: Array
    position_m: Array
    velocity_m_s: Array
    force_n: Array


def simulate(
    c: Coefficients,
    mass_kg: float,
    position_m: tuple[float, float, float],
    velocity_m_s: tuple[float, float, float],
    onset: Onset,
    *,
    step_s: float,
    duration_s: float,
    acceleration_m_s2: tuple[float, float, float] = (0.0, 0.0, 0.0),
    drag_per_s: tuple[float, float, float] = (0.0, 0.0, 0.0),
    vertical_sign: int = -1,
) -> SteppedTrajectory:
    """Step a point mass at one plane through any number of contacts (paper, eqs. of Sec. IV-B).

    Args:
        c: coefficients of material and mode.
        mass_kg: vehicle mass.
        position_m, velocity_m_s: at time 0, collision frame.
        onset: onset rule.
        step_s, duration_s: step and length.
        acceleration_m_s2: other acceleration, collision frame (gravity in a drop: (-9.81, 0, 0)).
        drag_per_s: deceleration per speed along the axes.
        vertical_sign: -1 as the paper writes lz, or 1.
    """
    table = CoefficientArrays.from_table(c)
    n = round(duration_s / step_s)
    p, v = np.array(position_m, dtype=float), np.array(velocity_m_s, dtype=float)
    a, b = np.array(acceleration_m_s2), 1.0 + step_s * np.array(drag_per_s)
    path = np.zeros((n + 1, 3, 3))
    path[0, 0], path[0, 1] = p, v
    # Drag at the end of the step: every velocity change is divided by 1 + h b, as if the mass were larger.
    drag_mass = mass_kg * float(b[0])
    for i in range(1, n + 1):
        along = (v[0] + step_s * a[0]) / b[0]
        end = step_normal(table, drag_mass, (p[0], np.asarray(along)), step_s, onset)
        force = float(end.force)
        vy = (v[1] + step_s * a[1]) / (b[1] + step_s * c.mu * force / mass_kg)
        lift = vertical_sign * c.nu * force / (1.0 + force)
        vz = (v[2] + step_s * (a[2] + lift / mass_kg)) / b[2]
        v = np.array([float(end.v), vy, vz])
        p = p + step_s * v
        path[i] = p, v, (force, -c.mu * force * vy, lift)
    time = np.asarray(step_s * np.arange(n + 1), dtype=float)
    return SteppedTrajectory(time, path[:, 0], path[:, 1], path[:, 2])


# --- two planes at once ---------------------------------------------------------------------------------


class Corner(NamedTuple):
    """Two vertical planes in the horizontal plane of the mission frame; arrays (2,) or (2, 2).

    Attributes:
        normals: outward unit normals, one per row.
        offsets_m: n . p at the planes of first touch.
        c: coefficients, one set per plane (fields of shape (2,) or (2, batch)).
    """

    normals: Array
    offsets_m: Array
    c: CoefficientArrays

    @property
    def tangents(self) -> Array:
        """Return Y of the collision frames: to the right when looking along the normal."""
        return np.stack((self.normals[:, 1], -self.normals[:, 0]), axis=1)


class CornerStep(NamedTuple):
    """The end of a step in a corner, for a batch.

    Attributes:
        position_m, velocity_m_s: (batch, 2), mission frame.
        normal_force_n: lx per plane, (batch, 2).
        complement_n: w = lx + k x + f vx per plane at the end of the step, (batch, 2).
        sliding_m_s: velocity along each plane at the end of the step, (batch, 2).
    """

    position_m: Array
    velocity_m_s: Array
    normal_force_n: Array
    complement_n: Array
    sliding_m_s: Array


def step_corner(
    corner: Corner,
    mass_kg: float,
    state: tuple[Array, Array],
    h_s: float,
    acceleration_m_s2: ArrayLike = (0.0, 0.0),
) -> CornerStep:
    """Return one implicit Euler step against two planes, by the paper's complementarity condition (`lcp`).

    The forces solve, with z the two normal forces, 0 <= z complementary to M z + q >= 0; all four
    cases are tried and the one that satisfies it is used. Friction, also implicit, acts along the other
    plane's normal and is part of M; its sliding speeds are iterated.

    Args:
        corner: the two planes.
        mass_kg: vehicle mass.
        state: positions and velocities (batch, 2), mission frame.
        h_s: step.
        acceleration_m_s2: other acceleration, (2,) or (batch, 2).
    """
    p, v = state
    free = v + h_s * np.asarray(acceleration_m_s2, dtype=float)
    n, t = corner.normals, corner.tangents
    c = CoefficientArrays(*(np.asarray(values).reshape(2, -1).T for values in corner.c))
    stiff = c.k * h_s + c.f
    q = c.k * (p @ n.T - corner.offsets_m) + stiff * (free @ n.T)
    per_force = h_s / mass_kg
    gain = stiff * per_force
    sliding = free @ t.T
    cosine = float(n[0] @ n[1])
    cross = np.array([float(n[0] @ t[1]), float(n[1] @ t[0])])  # of a plane's tangent on the other's normal
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for _ in range(_CORNER_ROUNDS):
            drag = c.mu * sliding  # friction per normal force
            m12 = gain[:, 0] * (cosine - cross[0] * drag[:, 1])
            m21 = gain[:, 1] * (cosine - cross[1] * drag[:, 0])
            z = _four_cases(1.0 + gain, m12, m21, q)
            # Each plane's sliding speed, with its own friction at the end of the step.
            pushed = free + per_force * (z @ n)
            other = per_force * (z * drag)[:, ::-1] * float(t[0] @ t[1])
            new = (pushed @ t.T - other) / (1.0 + per_force * c.mu * z)
            change = np.abs(new - sliding)
            sliding = new
            if not (change > _CORNER_TOLERANCE).any():
                break
    velocity = free + per_force * (z @ n - (c.mu * sliding * z) @ t)
    position = p + h_s * velocity
    complement = z + c.k * (position @ n.T - corner.offsets_m) + c.f * (velocity @ n.T)
    return CornerStep(position, velocity, z, complement, velocity @ t.T)


def _four_cases(diagonal: Array, m12: Array, m21: Array, q: Array) -> Array:
    """Solve z >= 0 complementary to M z + q >= 0 for 2 x 2 matrices; return z (batch, 2)."""
    q1, q2 = q[:, 0], q[:, 1]
    d1, d2 = diagonal[:, 0], diagonal[:, 1]
    zero = np.zeros_like(q1)
    determinant = d1 * d2 - m12 * m21
    cases = (
        (zero, zero),
        (-q1 / d1, zero),
        (zero, -q2 / d2),
        ((m12 * q2 - d2 * q1) / determinant, (m21 * q1 - d1 * q2) / determinant),
    )
    best = np.zeros_like(q)
    least = np.full_like(q1, math.inf)
    for z1, z2 in cases:
        # Violation of the inequalities: zero to rounding for the right case.
        w1, w2 = d1 * z1 + m12 * z2 + q1, m21 * z1 + d2 * z2 + q2
        violation = np.maximum.reduce(
            [-z1, -z2, np.where(z1 == 0.0, -w1, 0.0), np.where(z2 == 0.0, -w2, 0.0)]
        )
        better = violation < least
        least = np.where(better, violation, least)
        best = np.where(better[:, None], np.maximum(np.stack((z1, z2), axis=1), 0.0), best)
    return best
