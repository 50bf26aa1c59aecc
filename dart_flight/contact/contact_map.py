"""The collision map in closed form, vectorised: from approach velocity to rebound, times, forces and impulse.

In contact the law (paper, Sec. IV-B) is a damped oscillator with a one-sided force. The plane of first touch
is the plane on which the vehicle's centre lies when the vehicle first touches the wall. x is the centre's
signed distance to this plane. a is the normal acceleration that other forces cause: gravity in a drop, the
controller's push in flight. v is the normal velocity at the onset, and V = |v| + |a|/omega is the speed
scale. With

    omega = sqrt(k/m),  zeta = f / (2 sqrt(k m)),  x = m a / k + (V/omega) xi(tau),  tau = omega t,

the force is lx = m V omega (phi - alpha), phi = xi'', alpha = a / (V omega), and phi, xi, xi' all solve
z'' + 2 zeta z' + z = 0. Every event (peak, deepest point, release) is therefore a zero of such a solution.

If a = 0, V is the approach speed and the contact depends on zeta alone. With theta = acos(zeta),
w = sqrt(1 - zeta^2) and A = theta / w,

                       onset lcp                     onset touch
    contact time       pi / w                        2 A
    restitution        exp(-zeta pi / w)             exp(-2 zeta A)
    deepest point      exp(-zeta (pi / w - A))       exp(-zeta A)
    peak force         exp(-zeta A)                  exp(-zeta (3 A - pi / w)); 2 zeta if zeta >= 1/2

The units of the four rows are 1/omega, 1, V/omega and m V omega. At and above critical damping an `lcp`
contact never ends: its contact time is infinite and its exit speed is 0. The peak of the friction force has
no elementary form. If a is not 0, the time of release has no elementary form either. A safeguarded Newton
iteration finds both to machine precision. If a = 0, this module uses the formulas of the table, which are six
times faster than the general solution in `oscillator.py`.

All arrays are float64. Frame: the wall's collision frame (`base/walls.py`); a negative normal velocity is
towards the wall.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.config.vehicle import Coefficients
from dart_flight.contact.coefficients import Array, CoefficientArrays, Rows
from dart_flight.contact.law import Onset
from dart_flight.contact.oscillator import (
    ContactTimes,
    Oscillation,
    begin_contact,
    falling_root,
    find_contact_times,
    first_zero,
    motion,
    oscillator,
    quarter_time,
)

T = TypeVar("T")

# Collisions per chunk: the temporaries of one chunk fit in the second-level cache.
_CHUNK = 4096
_NEWTON_STEPS = 60
_NEAR_CRITICAL = 1e-8  # limit of |1 - zeta^2|


class WallContact(NamedTuple, Generic[T]):
    """Outcome of a contact with the force (lx, ly, lz), collision frame. `T` is an array or a float.

    Attributes:
        normal_out_m_s, tangential_out_m_s: velocity when the force returns to zero.
        contact_time_s: time during which the force acts; infinite if the vehicle stays at the wall.
        penetration_m: largest distance of the vehicle's centre behind the plane of first touch.
        peak_normal_force_n: largest lx.
        peak_friction_force_n: largest |ly|.
        impulse_n_s: time integral of lx.
        peak_vertical_force_n: largest |lz|.
    """

    normal_out_m_s: T
    tangential_out_m_s: T
    contact_time_s: T
    penetration_m: T
    peak_normal_force_n: T
    peak_friction_force_n: T
    impulse_n_s: T
    peak_vertical_force_n: T


class Drop(NamedTuple, Generic[T]):
    """Result of a drop; `T` is an array or a float.

    Attributes:
        contact_time_s: time during which the force acts; infinite if the vehicle stays down.
        max_rebound_speed_m_s: largest upward speed, reached in contact at lx = m g.
        peak_force_n: largest contact force lx.
        penetration_m: largest distance of the vehicle's centre below the plane of first touch.
        impulse_n_s: time integral of lx.
        onset_s: time from the release to the first force.
        onset_speed_m_s: speed (positive) at the first force.
    """

    contact_time_s: T
    max_rebound_speed_m_s: T
    peak_force_n: T
    penetration_m: T
    impulse_n_s: T
    onset_s: T
    onset_speed_m_s: T


# --- without other acceleration: all results except the friction peak are linear in the speed ------------


class _Shape(NamedTuple):
    """Quantities that depend on coefficients and mass but not on speed, one value per coefficient set."""

    restitution: Array
    contact_time: Array
    depth_per_speed: Array
    force_per_speed: Array
    impulse_per_speed: Array
    friction_scale: Array  # m omega
    mu: Array
    nu: Array
    zeta: Array
    w: Array  # |1 - zeta^2|^(1/2), or 1 near critical damping, where other formulas hold
    late_decay: Array  # exp(-zeta tau) at the force peak of the lcp solution
    scale: Array  # a `touch` contact is the end of an `lcp` contact that is faster by this factor
    entry: Array  # r = phi'/phi at the onset, its largest value; infinite for lcp


def _shape(c: CoefficientArrays, mass: Array, onset: Onset) -> _Shape:
    omega, zeta, w2 = oscillator(c, mass)
    quarter = quarter_time(zeta, w2)
    late_decay = np.exp(-zeta * quarter)
    half = np.where(w2 > 0.0, math.pi / np.sqrt(np.where(w2 > 0.0, w2, 1.0)), math.inf)
    if onset is Onset.LCP:
        time = half
        depth = np.exp(-zeta * (half - quarter))
        peak = late_decay
        scale, entry = np.ones_like(zeta), np.full_like(zeta, math.inf)
    else:
        light = zeta < 0.5  # for larger zeta, the force is largest at the onset
        time = 2.0 * quarter
        depth = late_decay
        scale = np.exp(zeta * np.where(light, half - time, 0.0))
        peak = np.where(light, late_decay * scale, 2.0 * zeta)
        undamped = zeta < 1e-150
        entry = np.where(undamped, math.inf, (1.0 - 4.0 * zeta * zeta) / np.where(undamped, 1.0, 2.0 * zeta))
    restitution = np.exp(-zeta * time)
    return _Shape(
        restitution=restitution,
        contact_time=time / omega,
        depth_per_speed=depth / omega,
        force_per_speed=mass * omega * peak,
        impulse_per_speed=mass * (1.0 + restitution),
        friction_scale=mass * omega,
        mu=c.mu + 0.0 * zeta,
        nu=c.nu + 0.0 * zeta,
        zeta=zeta,
        w=np.where(w2 < _NEAR_CRITICAL, 1.0, np.sqrt(np.abs(w2))),
        late_decay=late_decay,
        scale=scale,
        entry=entry,
    )


def _friction_peak(mu_speed: Array, s: _Shape) -> Array:
    """Return the largest phi exp(-mu V (1 + xi')) of a contact, to machine precision.

    The maximum is at r = c phi, with r = phi'/phi and c = mu V. The unknown is r, which falls monotonically
    in time. phi and xi' are elementary functions of r:
        tau = acot((zeta + r)/w)/w,   Q = 1 + 2 zeta r + r^2,   phi = exp(-zeta tau)/sqrt(Q),
        xi' = -phi (r + 2 zeta).
    Newton's method solves r Q = c sqrt(Q) exp(-zeta tau) at any damping. A `touch` contact has the same
    solution, with c multiplied by `_Shape.scale`. That contact begins later, at r = `_Shape.entry`, and r
    never exceeds this value.
    """
    two_zeta = 2.0 * s.zeta
    rate = -s.zeta / s.w
    any_heavy = bool((s.w == 1.0).any() and (s.zeta > 0.5).any())

    def decay(r: Array) -> Array:
        y = s.zeta + r
        if any_heavy:
            return np.exp(-s.zeta * _acot(y, s.zeta))
        return np.exp(rate * np.arctan(s.w / y))

    c = mu_speed * s.scale
    # The first guess solves the undamped equation, a quadratic; `late_decay` adds the damping for small c.
    # 1e-150 keeps y above 0 without damping and friction.
    near = 0.5 * c
    guess = c * (s.late_decay + near) / (1.0 + near)
    r = math.sqrt(2.0) * guess / np.sqrt(1.0 + np.sqrt(1.0 + 4.0 * guess * guess)) + 1e-150
    for _ in range(_NEWTON_STEPS):
        q = 1.0 + r * (two_zeta + r)
        step = (r * q - c * np.sqrt(q) * decay(r)) / (q + r * r)
        r = np.maximum(r - step, 1e-150)
        # The value is stationary in r and Newton squares the error: a step of 1e-3 leaves an error of 1e-12.
        if bool((np.abs(step) <= 1e-3 * r).all()):
            break
    xi1 = two_zeta + r
    phi = s.scale * decay(r) / np.sqrt(1.0 + r * xi1)
    value = phi * np.exp(mu_speed * np.minimum(phi * xi1 - 1.0, 0.0))
    late = r >= s.entry
    return np.where(late, two_zeta, value) if bool(late.any()) else value


def _acot(y: Array, zeta: Array) -> Array:
    """Return acot(y/w)/w for y >= zeta, w^2 = 1 - zeta^2; acoth for negative w^2, a series for w^2 near 0."""
    w2 = (1.0 - zeta) * (1.0 + zeta)
    w = np.sqrt(np.maximum(np.abs(w2), 0.1 * _NEAR_CRITICAL))
    over = 0.5 * np.log1p(2.0 * w / np.maximum(y - w, 1e-300)) / w
    series = (1.0 - w2 / (3.0 * y * y)) / y
    return np.where(np.abs(w2) < _NEAR_CRITICAL, series, np.where(w2 < 0.0, over, np.arctan(w / y) / w))


def _solve_without_push(s: _Shape, normal: Array, tangential: Array) -> tuple[Array, ...]:
    speed = np.maximum(-normal, 0.0)
    hits = normal < 0.0
    mu_speed = s.mu * speed
    peak = s.force_per_speed * speed
    return (
        np.where(hits, s.restitution * speed, normal),
        tangential * np.exp(-(1.0 + s.restitution) * mu_speed),
        np.where(hits, s.contact_time, 0.0),
        s.depth_per_speed * speed,
        peak,
        _friction_peak(mu_speed, s) * (s.friction_scale * mu_speed * np.abs(tangential)),
        s.impulse_per_speed * speed,
        s.nu * peak / (1.0 + peak),
    )


# --- with a constant other acceleration along the normal ----------------------------------------------------


def _solve_with_push(
    c: CoefficientArrays, mass: Array, onset: Onset, state: tuple[Array, Array, Array]
) -> tuple[tuple[Array, ...], Array]:
    """Return the eight arrays of `WallContact`, and the largest outward speed during the contact.

    `state` is the normal velocity, the tangential velocity and the acceleration.
    """
    normal, tangential, acceleration = state
    course = begin_contact(c, mass, normal, onset, acceleration)
    events = find_contact_times(course)
    hits, v = course.hits, course.speed
    impulse = np.where(hits, course.impulse(events.end), 0.0)
    rubbed = np.where(c.mu > 0.0, impulse, 0.0)  # avoids 0 * inf
    deepest = np.minimum(first_zero(course, -course.u, course.phi0), events.end)
    peak = np.where(hits, course.at(events.peak).force_n, 0.0)
    rub = mass * v * course.omega * c.mu * np.abs(tangential)
    friction = _pushed_friction_peak(course, events, c.mu * v) * rub
    fastest = np.where(hits, np.maximum(course.at(events.turn).velocity_m_s, 0.0), 0.0)
    return (
        np.where(hits, course.at(events.end).velocity_m_s, normal),
        tangential * np.exp(-c.mu / mass * rubbed),
        np.where(hits, events.end / course.omega, 0.0),
        np.where(hits, np.maximum(-course.at(deepest).position_m, 0.0), 0.0),
        peak,
        np.where(hits, friction, 0.0),
        impulse,
        c.nu * peak / (1.0 + peak),
    ), fastest


def _pushed_friction_peak(c: Oscillation, events: ContactTimes, rub: Array) -> Array:
    """Return the peak normalised friction force: the maximum of l exp(-rub P) over the contact.

    Here l = phi - alpha, P is the integral of l, and rub = mu V. At the maximum, l' = rub l^2.
    """

    def excess(tau: Array) -> tuple[Array, Array]:
        phi, slope, _ = motion(c, tau)
        force = phi - c.alpha
        return slope - rub * force * force, -(2.0 * c.zeta * slope + phi) - 2.0 * rub * force * slope

    peak = np.where(np.isfinite(events.peak), events.peak, 0.0)
    start = np.zeros_like(peak)
    first = peak / (1.0 + np.sqrt(rub))
    tau = np.where(excess(start)[0] <= 0.0, start, falling_root(excess, start, peak, first))
    phi, _, xi1 = motion(c, tau)
    return (phi - c.alpha) * np.exp(-rub * np.maximum(xi1 + c.u - c.alpha * tau, 0.0))


# --- the public functions -------------------------------------------------------------------------------


def _validate(c: CoefficientArrays, mass: Array, *inputs: Array) -> None:
    if not all(bool(np.isfinite(v).all()) for v in (*c, mass, *inputs)):
        raise ValueError("velocities, accelerations, masses and coefficients must be finite")
    if bool((c.k <= 0.0).any()) or bool((mass <= 0.0).any()):
        raise ValueError("mass and k must be positive")
    if any(bool((v < 0.0).any()) for v in (c.f, c.mu, c.nu)):
        raise ValueError("f, mu and nu must not be negative")


class _Batch:
    """The inputs of a map, broadcast to one shape, flattened and divided into chunks."""

    def __init__(
        self, c: CoefficientArrays, mass: Array, rows: Rows | None, inputs: tuple[Array, ...]
    ) -> None:
        own = np.broadcast_shapes(mass.shape, *(v.shape for v in c))
        shapes = [v.shape for v in inputs]
        self.shape = np.broadcast_shapes(*shapes, own if rows is None else rows.shape)
        self.size = math.prod(self.shape)
        self.table = CoefficientArrays(*(np.broadcast_to(v, own).reshape(-1) for v in c))
        self.mass = np.broadcast_to(mass, own).reshape(-1)
        self.rows = None if rows is None else np.broadcast_to(rows, self.shape).reshape(-1)
        self.inputs = [np.broadcast_to(v, self.shape).reshape(-1) for v in inputs]
        if rows is None and self.mass.size != 1:  # each collision has its own coefficient set
            self.table = CoefficientArrays(*(np.broadcast_to(v, self.shape).reshape(-1) for v in c))
            self.mass = np.broadcast_to(mass, self.shape).reshape(-1)

    @property
    def is_table(self) -> bool:
        """Whether collisions may share a coefficient set, so that its `_Shape` is computed only once."""
        return self.rows is not None or self.mass.size == 1

    def parts(self) -> list[slice]:
        return [slice(i, min(i + _CHUNK, self.size)) for i in range(0, self.size, _CHUNK)]

    def coefficients(self, part: slice) -> tuple[CoefficientArrays, Array]:
        """Return the coefficient sets and masses (kg) of a chunk: one per impact, or one for all impacts."""
        if self.rows is not None:
            rows = self.rows[part]
            return self.table.select(rows), self.mass[rows]
        if self.mass.size == 1:
            return self.table, self.mass
        return CoefficientArrays(*(v[part] for v in self.table)), self.mass[part]


def contact_map(
    coefficients: CoefficientArrays,
    mass_kg: ArrayLike,
    normal_m_s: ArrayLike,
    tangential_m_s: ArrayLike,
    onset: Onset,
    *,
    rows: Rows | None = None,
    acceleration_m_s2: ArrayLike | None = None,
) -> WallContact[Array]:
    """Predict wall hits (paper, Sec. IV-B) in closed form; the results have the broadcast shape and no NaN.

    Args:
        coefficients: one set, or one set per collision (any shape that broadcasts with the velocities). With
            `rows`, they are a table of shape (n,), which `rows` indexes.
        mass_kg: broadcasts with `coefficients`.
        normal_m_s: velocity along the outward normal at the onset, collision frame. If the vehicle does not
            approach, it does not touch the wall: the velocity is unchanged, and force and contact time are 0.
        tangential_m_s: velocity along the wall at the onset.
        rows: index of the table's row for each collision; broadcasts with the velocities.
        acceleration_m_s2: constant acceleration along the normal by other forces during the contact, such as
            the controller's push. Negative values point into the wall; None is 0. If a pushed vehicle
            comes to rest at the wall, contact time and impulse are infinite and the speeds are 0.

    Raises:
        ValueError: an input is not finite, mass or k is not positive, or f, mu or nu is negative.
    """
    normal, tangential, mass = (np.asarray(v, dtype=float) for v in (normal_m_s, tangential_m_s, mass_kg))
    inputs: tuple[Array, ...] = (normal, tangential)
    if acceleration_m_s2 is not None:
        inputs = (normal, tangential, np.asarray(acceleration_m_s2, dtype=float))
    _validate(coefficients, mass, *inputs)
    batch = _Batch(coefficients, mass, rows, inputs)
    out = np.empty((len(WallContact._fields), batch.size))
    shape = _shape(batch.table, batch.mass, onset) if batch.is_table else None
    for part in batch.parts():
        values = [v[part] for v in batch.inputs]
        if acceleration_m_s2 is not None:
            c, m = batch.coefficients(part)
            results, _ = _solve_with_push(c, m, onset, (values[0], values[1], values[2]))
        elif shape is None:
            results = _solve_without_push(_shape(*batch.coefficients(part), onset), values[0], values[1])
        elif batch.rows is None:
            results = _solve_without_push(shape, values[0], values[1])
        else:
            results = _solve_without_push(_Shape(*(v[batch.rows[part]] for v in shape)), values[0], values[1])
        for target, result in zip(out, results, strict=True):
            target[part] = result
    return WallContact(*(v.reshape(batch.shape) for v in out))


def friction_per_speed(
    coefficients: CoefficientArrays, mass_kg: float, onset: Onset
) -> Callable[[Array], Array]:
    """Return a fast function of the normal velocity (m/s, any shape, < 0: approaching) for one coefficient
    set.

    The function returns the peak friction force per tangential speed, N s/m, as in `contact_map`.
    """
    shape = _shape(coefficients, np.asarray(mass_kg), onset)

    def peak(normal_m_s: Array) -> Array:
        mu_speed = shape.mu * np.maximum(-normal_m_s, 0.0)
        return _friction_peak(mu_speed, shape) * (shape.friction_scale * mu_speed)

    return peak


def collide(
    coefficients: Coefficients,
    mass_kg: float,
    normal_m_s: float,
    tangential_m_s: float,
    onset: Onset,
    *,
    acceleration_m_s2: float = 0.0,
) -> WallContact[float]:
    """Predict one wall hit; arguments, results and errors as in `contact_map`."""
    push = acceleration_m_s2 or None
    table = CoefficientArrays.from_table(coefficients)
    result = contact_map(table, mass_kg, normal_m_s, tangential_m_s, onset, acceleration_m_s2=push)
    return WallContact(*(float(v) for v in result))


def fall(
    coefficients: CoefficientArrays, mass_kg: ArrayLike, height_m: ArrayLike, onset: Onset
) -> tuple[Array, Array]:
    """Return the time (s) from the release at rest to the onset, and the speed (m/s, > 0) at the onset.

    With `lcp` the force begins above the plane, where k x = f |v|.
    """
    height = np.asarray(height_m, dtype=float)
    mass = np.asarray(mass_kg, dtype=float)
    g = GRAVITY_M_S2
    if onset is Onset.TOUCH:
        speed = np.sqrt(2.0 * g * height) + 0.0 * (coefficients.k + mass)
    else:
        # k (h - v^2 / 2g) = f v
        rate = coefficients.lead_s + 0.0 * mass
        speed = 2.0 * height / (rate + np.sqrt(rate * rate + 2.0 * height / g))
    return speed / g, speed


def drop_map(
    coefficients: CoefficientArrays, mass_kg: ArrayLike, height_m: ArrayLike, onset: Onset
) -> Drop[Array]:
    """Predict drops on the ground (paper, Sec. III and IV-B) in closed form, with gravity along the normal.

    Args:
        coefficients: one set, or one per drop (broadcasts with the heights).
        height_m: height, > 0, of the vehicle's centre above the plane of first touch at the release from
            rest.

    Raises:
        ValueError: as `contact_map`, or a height is not positive.
    """
    height, mass = np.asarray(height_m, dtype=float), np.asarray(mass_kg, dtype=float)
    _validate(coefficients, mass, height)
    if bool((height <= 0.0).any()):
        raise ValueError("the height of a drop must be positive")
    time, speed = fall(coefficients, mass, height, onset)
    batch = _Batch(coefficients, mass, None, (-speed,))
    out = tuple(np.empty(batch.size) for _ in range(5))
    for part in batch.parts():
        c, m = batch.coefficients(part)
        normal = batch.inputs[0][part]
        still, g = np.zeros_like(normal), np.full_like(normal, -GRAVITY_M_S2)
        hit, fastest = _solve_with_push(c, m, onset, (normal, still, g))
        r = WallContact(*hit)
        results = (r.contact_time_s, fastest, r.peak_normal_force_n, r.penetration_m, r.impulse_n_s)
        for target, result in zip(out, results, strict=True):
            target[part] = result
    return Drop(*(v.reshape(batch.shape) for v in (*out, np.ravel(time), np.ravel(speed))))


def drop(coefficients: Coefficients, mass_kg: float, height_m: float, onset: Onset) -> Drop[float]:
    """Predict one drop; arguments, results and errors as in `drop_map`."""
    result = drop_map(CoefficientArrays.from_table(coefficients), mass_kg, height_m, onset)
    return Drop(*(float(v) for v in result))
